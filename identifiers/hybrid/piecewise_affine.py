"""Piecewise-affine models: the next output is affine in the past, with other coefficients in each polyhedral region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from harness.errors import FitError
from harness.judgement import refuse_undetermined
from harness.options import check_options
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.excitation import Columns, law_of_part
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.lag_state import LagModel, Standardisation, regression_data
from identifiers.common.neighbours import edges
from identifiers.common.records import learnable
from identifiers.learned.trees import Tree, grow_tree

Labels = npt.NDArray[np.intp]

_LOCAL = 2  # Neighbours of a local affine fit, in multiples of its coefficients.
_LOCAL_POINTS = 1500  # Samples whose local fits are clustered for a start; more do not change the clusters.

_OUTSIDE = 4.0
"""Samples further than so many robust standard deviations from every mode lie in none: they switch within a sample."""

_BRIEF = 10  # Iterations of the classifier between two reassignments, each begun where the last one ended.
_MOST = 6  # Where the number of modes is asked of the data, more are not tried.
_TRIAL_ROUNDS, _ROUNDS = 12, 60  # Reassignments at most, of every start and of the best one; they settle in about ten.


@dataclass(frozen=True, eq=False)
class PiecewiseAffineModel(LagModel):
    """Affine models and the regions in which they hold.

    Parameters
    ----------
    coefficients : array (M, ny, p + 1)
        Of the regressors ``[y lags, u lags, 1]`` in the units of the data, for each mode.
    regions : array (M, p + 1)
        The mode of regressors r (scaled) is the one with the largest ``regions @ [r, 1]``.
    variance : array (M, ny)
        Of the one-step error in each mode.
    tree : Tree, optional
        A decision tree on scaled regressors instead of the regions; its values are shares of the modes.
    """

    coefficients: FloatArray
    regions: FloatArray
    variance: FloatArray
    tree: Tree | None = None
    kind = "piecewise-affine"

    @property
    def findings(self) -> tuple[str, ...]:
        """How many modes, by what choice, and where the second of two begins."""
        counts = ", ".join(map(str, self.notes.get("samples", ())))
        tried = self.notes.get("criteria", ())
        key = "bic" if self.notes.get("chosen by") == "bic" else "held-out log score"
        each = ", ".join("{}: {:.4g}".format(one["modes"], one[key]) for one in tried)
        why = f", chosen by {key} ({each})" if tried else ""
        said = [f"{len(self.coefficients)} modes{why}, in which {counts} samples lie"]
        if len(self.regions) == 2 and self.tree is None:
            apart = self.regions[1] - self.regions[0]
            weights = apart[:-1] / self.scaling.x_std
            whole = np.append(weights, apart[-1] - weights @ self.scaling.x_mean)
            whole /= np.abs(weights[int(np.argmax(np.abs(apart[:-1])))])  # the one that decides most counts 1
            said.append(f"the second where {affine(whole, self._regressors)} > 0")
        return tuple(said)

    @property
    def _regressors(self) -> list[str]:
        """Names of the regressors, as they stand in the rows."""
        outputs, inputs = ([channel.name for channel in part] for part in (self.spec.outputs, self.spec.inputs))
        lags = ["", *(f"[k-{lag}]" for lag in range(1, self.lags))]
        return [name + lag for part in (outputs, inputs) for lag in lags for name in part]

    def mode(self, rows: FloatArray) -> Labels:
        """Return the mode (...) of regressors (..., p) in the units of the data."""
        scaled = self.scaling.rows(np.asarray(rows, dtype=float))
        if self.tree is not None:
            shares = self.tree(scaled.reshape(-1, scaled.shape[-1]))
            return np.asarray(np.argmax(shares, axis=1).reshape(scaled.shape[:-1]), dtype=np.intp)
        best: Labels = np.argmax(scaled @ self.regions[:, :-1].T + self.regions[:, -1], axis=-1)
        return best

    def ahead(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance (..., ny) of the next output."""
        chosen = self.mode(rows)
        mean = np.zeros((*chosen.shape, self.spec.ny))
        for number, table in enumerate(self.coefficients):
            here = chosen == number
            mean[here] = rows[here] @ table[:, :-1].T + table[:, -1]
        return mean, self.variance[chosen]


def affine(weights: FloatArray, names: Sequence[str]) -> str:
    """Return ``weights @ [names, 1]`` in words, terms of weight 0 left out.

    Examples
    --------
    >>> affine(np.array([0.0, -0.8, 0.001]), ["z", "z_rate"])
    '-0.8 z_rate + 0.001'
    >>> affine(np.array([1.0, -1.0, 0.0]), ["z", "u"])
    'z - u'
    """
    terms = []
    for value, name in zip(weights, [*names, ""], strict=True):
        size = f"{abs(value):.4g}"
        number = name if name and size == "1" else f"{size} {name}".rstrip()
        terms += [f"{'-' if value < 0 else '+'} {number}"] if value != 0.0 else []
    text = " ".join(terms).removeprefix("+ ")
    return text.replace("- ", "-", 1) if text.startswith("- ") else text or "0"


@dataclass(frozen=True)
class PiecewiseAffine(Excited):
    """Piecewise-affine regression on lagged outputs and inputs.

    Samples are assigned to modes, affine models fitted to each mode, a linear classifier to the assignment, and samples
    assigned anew to the mode that explains them best and in whose region they lie (Bemporad 2023, *IEEE Trans.
    Automatic Control* 68:3194). Starts are clusters of local affine fits (Ferrari-Trecate et al. 2003, *Automatica*
    39:205) and random ones. In the end every mode is fitted again to the samples that clearly belong to it: a sample in
    which the plant switches belongs to none.

    Parameters
    ----------
    modes : int, optional
        Number of affine models. Without it 1, 2, ... are tried, and the last one is kept that still gains.
    choose : {"held-out", "bic"}
        What the number of modes must gain: log score of one step on stretches that were left out (two standard errors
        of the gain), or the Bayesian information criterion of the fit. Both stand in the notes.
    guards : {"polyhedra", "tree"}
        Where a mode holds: polyhedra (a linear classifier), or boxes of a decision tree, for modes whose regions no
        hyperplanes part.
    order : int
        Past outputs and inputs; 1 where the state is measured.
    starts : int
        Random starts besides the clustered one.
    region_weight : float
        What a place outside a region costs, in units of a squared standard deviation of the residual.
    """

    modes: int | None = 2
    choose: Literal["held-out", "bic"] = "held-out"
    guards: Literal["polyhedra", "tree"] = "polyhedra"
    order: int = 1
    starts: int = 5
    region_weight: float = 1.0

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> PiecewiseAffineModel:
        """Return the model; share of samples in each mode and of those in none stand in its notes."""
        what = "piecewise-affine"
        check_options(self, what, modes=">= 1", order=">= 1")
        records, spec = learnable(trajectories, samples=self.order + 2, what=what, inputs=False)
        refuse_undetermined(records, what, self.least_excitation)
        rows, targets = regression_data(records, self.order)
        if self.modes is None:
            model, table = self._chosen(rows, targets, spec, rng)
            return replace(model, notes={**model.notes, "criteria": table, "chosen by": self.choose})
        return self._of_rows(rows, targets, spec, rng)

    def _chosen(
        self, rows: FloatArray, targets: FloatArray, spec: PlantSpec, rng: np.random.Generator
    ) -> tuple[PiecewiseAffineModel, list[dict[str, float]]]:
        """Return the model, and for each number of modes its log score on held-out samples and its BIC.

        A number with which a mode is left without samples is none that was found.
        """
        held = np.zeros(len(rows), dtype=bool)
        for low, high in edges(len(rows))[1::3]:
            held[low:high] = True
        table: list[dict[str, float]] = []
        scores: list[FloatArray] = []
        models: list[PiecewiseAffineModel] = []
        best = 1
        for modes in range(1, _MOST + 1):
            one = replace(self, modes=modes)
            try:
                part = one._of_rows(rows[~held], targets[~held], spec, rng)
                whole = one._of_rows(rows, targets, spec, rng)
            except FitError:
                if modes == 1:
                    raise
                break
            models.append(whole)
            scores.append(_log_density(part, rows[held], targets[held]))
            fitted = float(_log_density(whole, rows, targets).sum())
            free = whole.coefficients.size + (modes - 1) * (rows.shape[1] + 1)
            bic = 0.5 * free * float(np.log(len(rows))) - fitted
            table.append({"modes": modes, "held-out log score": float(scores[-1].mean()), "bic": bic})
            gain = scores[-1] - scores[best - 1]
            sure = 2.0 * float(gain.std()) / float(np.sqrt(len(gain)))
            better = gain.mean() > sure if self.choose == "held-out" else bic < table[best - 1]["bic"]
            if modes > 1 and better and min(whole.notes["samples"]) > 0:
                best = modes
            elif modes > best + 1:  # two in a row that gain nothing: a single one may only lack a good start
                break
        return models[best - 1], table

    def _of_rows(
        self, rows: FloatArray, targets: FloatArray, spec: PlantSpec, rng: np.random.Generator
    ) -> PiecewiseAffineModel:
        """Return the model of regressors (n, p) and next outputs (n, ny)."""
        assert self.modes is not None
        what = "piecewise-affine"
        least = 2 * self.modes * (rows.shape[1] + 1)
        if len(rows) < least:
            raise FitError(
                f"{what}: too few samples",
                expected=f"{least}, two for each coefficient of every mode",
                got=str(len(rows)),
                remedy="record longer, or lower modes or order",
            )
        scaling = Standardisation.of(rows, targets)
        r = np.hstack([scaling.rows(rows), np.ones((len(rows), 1))])
        y = scaling.targets(targets)
        starts = [_clustered(r, y, self.modes, rng)]
        starts += [_grown(r, self.modes, rng) for _ in range(self.starts if self.modes > 1 else 0)]
        found = [self._settled(r, y, start, _TRIAL_ROUNDS) for start in starts]
        theta, regions, labels, _ = self._settled(r, y, min(found, key=lambda result: result[3])[2], _ROUNDS)
        inside = np.ones(len(r), dtype=bool)
        if self.modes > 1:
            theta, labels, inside = _trimmed(r, y, theta, labels)
        regions = _regions(r[inside], labels[inside], self.modes, regions)
        tree = None
        chosen = np.argmax(r @ regions.T, axis=1)
        if self.guards == "tree" and self.modes > 1:
            x = r[:, :-1]
            tree = grow_tree(x[inside], np.eye(self.modes)[labels[inside]], leaf=5, features=x.shape[1], rng=rng)
            chosen = np.argmax(tree(x), axis=1)
        wrong = y - np.einsum("np,npk->nk", r, theta[chosen])
        variance = np.array([_mean_square(wrong[chosen == j], wrong) for j in range(self.modes)])
        order = np.argsort([r[chosen == j, 0].mean() if (chosen == j).any() else np.inf for j in range(self.modes)])
        parts = [inside & (labels == j) for j in order] if self.modes > 1 else []
        samples = [int((chosen == j).sum()) for j in order]
        notes = {
            "modes": self.modes,
            "samples": samples,
            "in none": float(1.0 - inside.mean()),
            **self._laws_in_modes(rows, targets, parts, spec),
        }
        if 0 in samples:
            notes["warning"] = (
                f"no sample lies in {samples.count(0)} of {self.modes} modes: what switches was not found "
                "(more starts, modes = null, or a record that switches more often)"
            )
        return PiecewiseAffineModel(
            spec,
            self.order,
            scaling,
            np.array([_unscaled(theta[j], scaling) for j in order]),
            regions[order],
            variance[order] * scaling.y_std**2,
            None if tree is None else replace(tree, value=tree.value[:, order]),
            notes=notes,
        )

    def _laws_in_modes(
        self, rows: FloatArray, targets: FloatArray, parts: Sequence[npt.NDArray[np.bool_]], spec: PlantSpec
    ) -> dict[str, str]:
        """Return a warning for the notes where the inputs follow the outputs by a law within the samples of a mode."""
        columns = Columns(spec, self.order)
        laws = [law_of_part(rows[part], targets[part], columns, self.least_excitation) for part in parts]
        said = [f"mode {number + 1}: {law}" for number, law in enumerate(laws) if law is not None]
        if not said:
            return {}
        return {
            "warning": "within a mode the inputs follow the outputs, so that what they do there is not determined by "
            f"its samples and taken from all: {'; '.join(said)}"
        }

    def _settled(
        self, r: FloatArray, y: FloatArray, labels: Labels, rounds: int
    ) -> tuple[FloatArray, FloatArray, Labels, float]:
        """Return coefficients (M, p + 1, ny), regions, labels and the cost once no sample changes its mode."""
        assert self.modes is not None
        regions = np.zeros((self.modes, r.shape[1]))
        whole = _solved(r, y)
        theta = np.tile(whole, (self.modes, 1, 1))
        for _ in range(rounds):
            for j in range(self.modes):
                if (labels == j).sum() > r.shape[1]:
                    theta[j] = _solved(r[labels == j], y[labels == j], toward=whole)
            regions = _regions(r, labels, self.modes, regions, iterations=_BRIEF)
            squared = ((y[:, None] - (r @ theta).transpose(1, 0, 2)) ** 2).sum(axis=2)
            now = squared[np.arange(len(r)), labels]
            # The residual's size from the middle of the samples, so that those between modes do not set it.
            size = max(float(np.median(now)) / 0.455, 1e-20)
            score = r @ regions.T
            outside = np.logaddexp.reduce(score, axis=1)[:, None] - score
            costs = np.minimum(squared / size, _OUTSIDE**2) + self.region_weight * outside
            new = np.argmin(costs, axis=1)
            if np.array_equal(new, labels):
                break
            labels = new
        chosen = np.einsum("np,npk->nk", r, theta[np.argmax(r @ regions.T, axis=1)])
        return theta, regions, labels, float(np.mean(np.abs(y - chosen)))


def _clustered(r: FloatArray, y: FloatArray, modes: int, rng: np.random.Generator) -> Labels:
    """Return labels from clusters of local affine fits, each sample with its nearest one."""
    from scipy.cluster.vq import ClusterError, kmeans2
    from scipy.spatial import cKDTree

    if modes == 1:
        return np.zeros(len(r), dtype=np.intp)
    x = r[:, :-1]
    tree = cKDTree(x)
    points = rng.choice(len(r), size=min(len(r), _LOCAL_POINTS), replace=False)
    count = min(_LOCAL * r.shape[1] + 2, len(r))
    _, near = tree.query(x[points], k=count)
    features = np.empty((len(points), r.shape[1] * y.shape[1] + x.shape[1]))
    for i, index in enumerate(np.reshape(near, (len(points), count))):
        theta = _solved(r[index], y[index], ridge=1e-3)
        features[i] = np.concatenate([theta.ravel(), 0.3 * x[index].mean(axis=0)])
    # Medians, because fits of samples on both sides of a border are far off.
    middle = np.median(features, axis=0)
    spread = np.median(np.abs(features - middle), axis=0)
    features = np.clip((features - middle) / np.where(spread > 0, spread, 1.0), -10, 10)
    try:
        _, labels = kmeans2(features, modes, rng=rng, minit="++", missing="raise")
    except ClusterError:  # a cluster without a point: fewer kinds of local fits than modes
        return _grown(r, modes, rng)
    _, nearest = cKDTree(x[points]).query(x)
    found: Labels = labels.astype(np.intp)[nearest]
    return found


def _grown(r: FloatArray, modes: int, rng: np.random.Generator) -> Labels:
    """Return labels by the nearest of some samples drawn."""
    centres = r[rng.choice(len(r), size=modes, replace=False)]
    nearest: Labels = np.argmin(((r[:, None] - centres[None]) ** 2).sum(axis=2), axis=1)
    return nearest


def _solved(r: FloatArray, y: FloatArray, ridge: float = 1e-10, toward: FloatArray | None = None) -> FloatArray:
    """Return the coefficients (p + 1, ny) of a ridge regression on scaled regressors.

    What the samples do not determine stays what it is in ``toward``: zero, or the fit of all samples.
    """
    gram, left = r.T @ r, y if toward is None else y - r @ toward
    found = np.asarray(np.linalg.solve(gram + ridge * len(r) * np.eye(len(gram)), r.T @ left))
    return found if toward is None else toward + found


def _trimmed(
    r: FloatArray, y: FloatArray, theta: FloatArray, labels: Labels
) -> tuple[FloatArray, Labels, npt.NDArray[np.bool_]]:
    """Fit every mode again to the samples that it explains; returns coefficients, labels, and which lie in a mode."""
    theta, inside, whole = theta.copy(), np.ones(len(r), dtype=bool), _solved(r, y)
    for _ in range(10):
        squared = ((y[:, None] - (r @ theta).transpose(1, 0, 2)) ** 2).sum(axis=2)
        own = squared[np.arange(len(r)), labels]
        size = np.array(
            [np.median(own[labels == j]) / 0.455 if (labels == j).any() else 1.0 for j in range(len(theta))]
        )
        inside = own <= _OUTSIDE**2 * np.maximum(size, 1e-24)[labels]
        for j in range(len(theta)):
            mine = inside & (labels == j)
            if mine.sum() > r.shape[1]:
                theta[j] = _solved(r[mine], y[mine], toward=whole)
    return theta, labels, inside


def _regions(r: FloatArray, labels: Labels, modes: int, start: FloatArray, iterations: int = 200) -> FloatArray:
    """Return the weights (M, p + 1) of a multinomial logistic classifier, with a small ridge."""
    from scipy.optimize import minimize

    if modes == 1:
        return np.zeros((1, r.shape[1]))
    target = np.eye(modes)[labels]

    def value(flat: FloatArray) -> tuple[float, FloatArray]:
        weights = flat.reshape(modes, -1)
        score = r @ weights.T
        top = np.logaddexp.reduce(score, axis=1)
        loss = float(np.mean(top - (score * target).sum(axis=1)) + 0.5e-6 * (flat @ flat))
        gradient = (np.exp(score - top[:, None]) - target).T @ r / len(r) + 1e-6 * weights
        return loss, gradient.ravel()

    found = minimize(value, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    return np.asarray(found.x, dtype=float).reshape(modes, -1)


def _log_density(model: PiecewiseAffineModel, rows: FloatArray, targets: FloatArray) -> FloatArray:
    """Return the log density (n,) that a model gave to next outputs; errors beyond what it knows count as outliers.

    A step in which the plant switches follows none of the modes; its error would hide what all others say.
    """
    mean, variance = model.ahead(rows)
    squared = np.minimum((targets - mean) ** 2 / variance, _OUTSIDE**2)
    return np.asarray(-0.5 * (squared + np.log(2.0 * np.pi * variance)).sum(axis=1))


def _mean_square(wrong: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return the mean square of a mode's errors; of all where the mode has none; never 0."""
    return np.asarray(np.mean((wrong if len(wrong) else otherwise) ** 2, axis=0) + 1e-18)


def _unscaled(theta: FloatArray, scaling: Standardisation) -> FloatArray:
    """Return coefficients (ny, p + 1) in the units of the data."""
    slopes = theta[:-1].T * scaling.y_std[:, None] / scaling.x_std
    offset = scaling.y_mean + theta[-1] * scaling.y_std - slopes @ scaling.x_mean
    return np.column_stack([slopes, offset])
