"""The law of a controller that an input follows with nothing beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from harness.algebra import unit_columns
from harness.judgement.feedback import FORETOLD, FOUND, SHORT, THIN, first_rows, granger, jumps
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

# Samples before and after the window of a law that bear witness against it.
_REACH = 3
# Probability of calling a record of pure feedback excited, and of an open loop that is asked about laws at all.
_DOUBT = 1e-5
# A law that leaves less than this share of what an input's own past leaves is exact: nothing else moved the input. So
# is one of the same sample that leaves of the input itself but rounding, whatever the past foretells: then outputs and
# input of one sample are dependent columns of any model.
_EXACT, _ROUNDED = 1e-3, 1e-10
# What a law leaves of its input at most: it explains half of it.
_HALF = 0.7
# A filter follows whatever is slow, an excitation too: its law has to leave less, twice a noise of a tenth.
_SLOW = 0.2
# Outputs beyond so many are seen through as many principal directions.
_MOST = 16
# Terms of a dependence that are named: those above this share of the largest.
_SHOWN = 1e-3
# Probability, in a law without an integral or a filter, of one that is taken to have it.
_NEEDED = 0.05
# Estimates between two-stage least squares and limited-information maximum likelihood that are tried.
_TRIED = 21
# Windows of a motion that depend on others up to this share have that dimension in common.
_NOTHING = 1e-11
# Regressors that depend on others up to this share are left out.
_RANK = 1e-6


@dataclass(frozen=True)
class Law:
    """A controller that explains an input.

    Parameters
    ----------
    column : int
        Of the input.
    text : str
        The law, as far as it is known: ``u = -0.5 v - 0.3 q``.
    departure : float
        What it leaves of the input, relative to the input's standard deviation.
    probability : float
        Of so much correlation of that departure with the other samples, were it only noise of the sensors.
    """

    column: int
    text: str
    departure: float
    probability: float


@dataclass(frozen=True)
class _Form:
    """Controllers of one form: an input, or its change, from the outputs of so many samples.

    Filtered ones also hold that input, or change, of the sample before: one real pole.
    """

    lags: int
    change: bool
    filtered: bool = False

    def coefficients(self, outputs: int) -> int:
        """Return how many numbers such a law has, its constant included."""
        return 1 + outputs * (self.lags + 1) + int(self.filtered)


# Proportional; with a derivative; with an integral; with both; and each behind a filter. A law of two free poles would
# follow a sine that moves the loop from outside as well, and is none of these.
_PLAIN = (_Form(0, False), _Form(1, False), _Form(1, True), _Form(2, True))
_FORMS = (*_PLAIN, *(replace(form, filtered=True) for form in _PLAIN))


def law_of(records: Sequence[Trajectory], *, held: bool = False) -> Law | None:
    """Return the law that an input follows with nothing beside it, None where something else moves every input.

    Asked only where outputs foretell an input beyond its own past (:func:`feedback_of`), or its own past foretells it
    wholly. A controller ``u = K x`` seen through sensors ``y = x + e`` leaves ``v = u - K y = -K e``: nothing that the
    plant ever felt. So v must be uncorrelated with the inputs of all samples, the present one too, and with the outputs
    of all samples that the law does not use, before and after. What truly moves the plant is not: the present input
    contains it, and later outputs answer it. The gains are found by the generalised method of moments with these
    samples as instruments, and Hansen's statistic (1982, Econometrica 50:1029, lemma 4.2) tests them all at once, for
    the proportional, derivative and integral controllers, each behind a filter of one pole too. The size of the noise
    decides nothing.

    An input that its own past foretells wholly is a sum of lines, or part of a motion from a start alone. Lines obey
    any law of as many coefficients as they have dimensions; a law of fewer that holds to rounding is a controller's.

    An output that holds a part of the input of the same sample (crosstalk, or a direct path that is not declared)
    obeys a law too, the plant turned round. An input that is held and jumps (:func:`jumps`) is no controller's:
    ``held`` asks such inputs alone, which are else left out.

    Examples
    --------
    >>> spec, rng = PlantSpec((Channel("u"),), (Channel("y"),), 1.0), np.random.default_rng(0)
    >>> u, y = np.zeros((500, 1)), np.zeros((500, 1))
    >>> for k in range(500):
    ...     u[k] = -0.5 * y[k]
    ...     y[k + 1 : k + 2] = 0.9 * y[k] + u[k] + rng.normal()
    >>> law_of([Trajectory(np.arange(500.0), u, y + 0.1 * rng.normal(size=y.shape), spec)]).text
    'u = -0.4964 y'
    """
    spec = records[0].spec
    if spec.nu == 0 or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
        return None
    some = first_rows(records)
    asked = [j for j in range(spec.nu) if np.ptp(np.concatenate([record.u[:, j] for record in some])) > 0]
    asked = [j for j in asked if jumps(some, j) == held]  # a constant is no answer
    if not asked:
        return None
    some = _seen_through_few(some)
    shares, chances, alone, _ = granger(some, 4)
    for column in asked:
        found = _law_of_input(some, column, (shares[column], chances[column], alone[column]))
        if found is not None:
            return found
    return None


def _law_of_input(records: Sequence[Trajectory], column: int, told: tuple[float, float, float]) -> Law | None:
    """Return the law that one input follows; ``told`` is what outputs and its own past foretell of it."""
    (share, chance, alone), spec = told, records[0].spec
    sure = chance < _DOUBT and share > FOUND
    if not sure and alone > FORETOLD:
        return None
    exact = _EXACT * alone
    for form in _FORMS:
        departure, probability, text = _tested(records, column, form)
        noise = probability > _DOUBT and departure < (_SLOW if form.filtered else _HALF)
        least = max(exact, _ROUNDED) if form == _PLAIN[0] else exact
        if (noise or departure < least) and (sure or form == _PLAIN[0]):
            return Law(column, text, departure, probability)
        if not sure and departure < _ROUNDED and form.coefficients(spec.ny) < _dimension(records):
            return Law(column, text, departure, probability)
    if not sure and (found := _weakly_told(records, column)) is not None:
        return found
    if sure and share > 1.0 - _EXACT**2 and granger(_before(records), 4)[0][column] > 1.0 - _EXACT**2:
        left = float(alone * np.sqrt(max(1.0 - share, 0.0)))
        return Law(column, f"{spec.inputs[column].name} follows from the last 4 samples", left, 1.0)
    return None


def dependence_text(direction: FloatArray, size: FloatArray, names: Sequence[str]) -> str:
    """Return ``u = -0.5 x - 0.1 v`` for coefficients of regressors whose sum stays zero.

    Parameters
    ----------
    direction : array (p,)
    size : array (p,)
        Sizes of the regressors: terms that move little are left out.
    names : sequence of str
        The last of those that count most stands on the left.

    Examples
    --------
    >>> dependence_text(np.array([0.5, 0.1, 1.0]), np.ones(3), ("x", "v", "u"))
    'u = -0.5 x - 0.1 v'
    """
    weight = np.abs(direction * size)
    counted = [j for j in range(direction.size) if weight[j] > _SHOWN * weight.max()]
    lead = max(j for j in counted if weight[j] >= 0.1 * weight.max())
    terms = sorted((j for j in counted if j != lead), key=lambda j: -weight[j])[:6]
    text = f"{names[lead]} ="
    for number, j in enumerate(terms):
        value = -direction[j] / direction[lead]
        sign = "-" if value < 0 else "+"
        text += (
            f" {sign} {abs(value):.4g} {names[j]}"
            if number
            else f" {'-' if value < 0 else ''}{abs(value):.4g} {names[j]}"
        )
    return text if terms else f"{text} 0"


def _tested(records: Sequence[Trajectory], column: int, form: _Form) -> tuple[float, float, str]:
    """Return what the best law of a form leaves of an input, Hansen's probability that it is noise, and the law."""
    from scipy.stats import chi2

    spec = records[0].spec
    lags, first = form.lags, int(spec.feedthrough)
    targets, laws, witnesses = [], [], []
    for record in records:
        k = np.arange(lags + _REACH + 1, len(record) - _REACH)
        if not k.size:
            continue
        one, u, y = np.ones((k.size, 1)), record.u, record.y
        own = np.diff(u[:, column], prepend=u[:1, column]) if form.change else u[:, column]
        targets.append(own[k])
        filtered = [own[k - 1, None]] if form.filtered else []
        laws.append(np.hstack([one, *(y[k - j] for j in range(first, lags + first + 1)), *filtered]))
        around = [u[k - j] for j in range(-_REACH, lags + _REACH + 1)]
        before = [y[k - j] for j in range(lags + first + 1, lags + _REACH + 1)]
        witnesses.append(np.hstack([one, *around, *before, *(y[k + j] for j in range(1, _REACH + 1))]))
    if not targets or sum(map(len, targets)) < 3 * witnesses[0].shape[1]:
        return 1.0, 0.0, ""
    target, law, lengths = np.concatenate(targets), np.concatenate(laws), [len(part) for part in targets]
    if not np.ptp(target) > 0:
        return 1.0, 0.0, ""  # a pulse before the rows that are tested: what rests is no answer
    size = float(np.concatenate([record.u[:, column] for record in records]).std())
    if _by_itself(target, law[:, [0, *range(1 + spec.ny * (lags + 1), law.shape[1])]]) < _ROUNDED * size:
        return 1.0, 0.0, ""  # a ramp, or one mode that dies away: no output has a part in it
    witness = unit_columns(np.concatenate(witnesses))
    gains, covariance, statistic, free = _moments(target, law, witness, lengths, lags)
    # Without an integral, or a filter, the law is that of the other forms, which bear sharper witness. The pole of a
    # filter lies between 0 and 1: a negative one is a controller that acts late, seen through the plant.
    if form.filtered and gains[-1] <= 0:
        return 1.0, 0.0, ""
    checks: list[FloatArray] = []
    if form.change:
        checks.append(np.hstack([np.zeros((spec.ny, 1)), np.tile(np.eye(spec.ny), lags + 1)]))
    if form.filtered:
        checks.append(np.eye(gains.size)[-1:])
    for part in checks:
        part = np.pad(part, ((0, 0), (0, gains.size - part.shape[1])))
        total, among = part @ gains, part @ covariance @ part.T
        if chi2.sf(float(total @ np.linalg.lstsq(among, total, rcond=1e-9)[0]), len(part)) > _NEEDED:
            return 1.0, 0.0, ""
    departure = float(np.std(target - law @ gains)) / (size if size > 0 else 1.0)
    text = _text(spec, column, form, -gains[1:], law.std(axis=0)[1:], float(target.std()))
    return departure, float(chi2.sf(statistic, free)), text


def _by_itself(target: FloatArray, own: FloatArray) -> float:
    """Return what a constant and the sample before leave of an input, or of its change."""
    scaled = unit_columns(own)
    return float(np.std(target - scaled @ np.linalg.lstsq(scaled, target, rcond=THIN)[0]))


def _moments(
    target: FloatArray, law: FloatArray, witness: FloatArray, lengths: Sequence[int], lags: int
) -> tuple[FloatArray, FloatArray, float, int]:
    """Return gains, their covariance, Hansen's statistic and its freedom, by two steps of the method of moments."""
    rows, length = target.size, np.linalg.norm(law, axis=0)
    left, values, _ = np.linalg.svd(witness, full_matrices=False)
    z, law = left[:, values > THIN * values[0]] * np.sqrt(rows), unit_columns(law) * np.sqrt(rows)
    moments, slopes = z.T @ target / rows, z.T @ law / rows
    gains = np.linalg.lstsq(slopes, moments, rcond=_RANK)[0]
    weight, turned = np.linalg.eigh(_spread(z, target - law @ gains, lengths, lags))
    if not weight[-1] > 0:  # nothing is left at all
        return np.sqrt(rows) * gains / np.where(length > 0, length, 1.0), np.eye(length.size), 0.0, 1
    root = (turned / np.sqrt(np.maximum(weight, 1e-10 * weight[-1]))).T
    gains, _, rank, _ = np.linalg.lstsq(root @ slopes, root @ moments, rcond=_RANK)
    wrong = root @ (moments - slopes @ gains)
    unit = np.sqrt(rows) / np.where(length > 0, length, 1.0)
    inverse = np.linalg.pinv(root @ slopes, rcond=_RANK)
    covariance = inverse @ inverse.T / rows * np.outer(unit, unit)
    return unit * gains, covariance, float(rows * (wrong @ wrong)), max(z.shape[1] - int(rank), 1)


def _dimension(records: Sequence[Trajectory]) -> int:
    """Return how many dimensions windows of inputs and outputs span, a constant included."""
    rows = []
    for record in records:
        both, last = np.hstack([record.u, record.y]), len(record) - SHORT
        if last > 0:
            rows.append(np.hstack([both[j : last + j] for j in range(SHORT)]))
    if not rows:
        return 0
    together = np.concatenate(rows)
    values = np.linalg.svd(unit_columns(np.hstack([np.ones((len(together), 1)), together])), compute_uv=False)
    return int(np.sum(values > _NOTHING * values[0]))


def _weakly_told(records: Sequence[Trajectory], column: int) -> Law | None:
    """Return the proportional law that a motion from a start shows although hardly more than one mode of it is seen.

    Two-stage estimates then lie anywhere along what the data do not tell, and their test rejects them. The least of
    ``v' P v / v' v`` over all laws, P the projection on the witnesses, is chi-square whatever is told (Anderson & Rubin
    1949, Ann. Math. Stat. 20:46, sec. 5): limited-information maximum likelihood. Of the estimates between both (those
    of the k-class: Theil 1958, *Economic Forecasts and Policy*, sec. 6.2) the first that the test bears out counts.
    """
    from scipy.linalg import eigh
    from scipy.stats import chi2

    spec, first = records[0].spec, int(records[0].spec.feedthrough)
    sides, witnesses = [], []
    for record in records:
        k = np.arange(_REACH + 1, len(record) - _REACH)
        u, y = record.u, record.y
        sides.append(np.hstack([u[k, column, None], y[k - first]]))
        around = [u[k - j] for j in range(-_REACH, _REACH + 1)]
        before = [y[k - j] for j in range(first + 1, _REACH + 1)]
        witnesses.append(np.hstack([*around, *before, *(y[k + j] for j in range(1, _REACH + 1))]))
    if sum(map(len, sides)) < 3 * witnesses[0].shape[1]:
        return None
    side, witness = np.concatenate(sides), np.concatenate(witnesses)
    side, witness = side - side.mean(axis=0), unit_columns(witness - witness.mean(axis=0))
    size = np.where(side.std(axis=0) > 0, side.std(axis=0), 1.0)
    left, values, _ = np.linalg.svd(witness, full_matrices=False)
    z = left[:, values > THIN * values[0]]
    seen = z.T @ (side / size)
    rows, whole = len(side), (side / size).T @ (side / size)
    if np.linalg.eigvalsh(whole)[0] <= THIN * rows:
        return None  # a law to rounding is found without
    explained = seen.T @ seen
    least = float(eigh(explained, whole, eigvals_only=True)[0])
    free, law, probability = max(z.shape[1] - spec.ny, 1), np.zeros(0), 0.0
    for part in np.linspace(0.0, 1.0, _TRIED):  # from two stages to limited information: the first that is borne out
        inner = explained - part * least * whole
        law = np.append(1.0, -np.linalg.lstsq(inner[1:, 1:], inner[1:, 0], rcond=1e-12)[0])
        share = float(law @ explained @ law) / float(law @ whole @ law)
        probability = float(chi2.sf(rows * share, free))
        if probability > _DOUBT:
            break
    law = law * size[0] / size
    own = float(np.concatenate([record.u[:, column] for record in records]).std())
    departure = float(np.std(side @ law)) / (own if own > 0 else 1.0)
    if probability <= _DOUBT or departure > _HALF:
        return None
    text = _text(spec, column, _PLAIN[0], law[1:], size[1:], float(size[0]))
    return Law(column, text, departure, probability)


def _text(spec: PlantSpec, column: int, form: _Form, gains: FloatArray, spread: FloatArray, own: float) -> str:
    """Return a law in words, without its constant; ``gains`` are those of ``u + gains y = 0``."""
    name = spec.inputs[column].name
    lags = range(int(spec.feedthrough), form.lags + int(spec.feedthrough) + 1)
    seen = [c.name if j == 0 else f"{c.name}[k-{j}]" for j in lags for c in spec.outputs]
    lead = f"the change of {name}" if form.change else name
    if form.filtered:
        seen.append(f"{lead}[k-1]" if not form.change else f"{lead} before")
    if not np.any(np.abs(gains * spread) >= _SHOWN * own):
        return f"{lead} = 0"
    # the input stands on the left, however large one of the outputs' terms may be
    direction, size = np.append(gains, 1.0), np.append(spread, max(own, float(np.abs(gains * spread).max())))
    return dependence_text(direction, size, [*seen, lead])


def _spread(z: FloatArray, departure: FloatArray, lengths: Sequence[int], lags: int) -> FloatArray:
    """Return the covariance of ``sqrt(N) mean(z v)`` for a v that is independent of z and remembers so many lags.

    Autocovariances under Bartlett's window of twice the memory, which keep the sum positive (Newey & West 1987).
    """
    rows = departure.size
    total = np.mean(departure**2) * np.eye(z.shape[1])
    edges = np.concatenate([[0], np.cumsum(lengths)])
    for j in range(1, 2 * lags + 1):
        own, crossed = 0.0, np.zeros((z.shape[1],) * 2)
        for start, stop in pairwise(edges):
            if stop - start > j:
                own += float(departure[start + j : stop] @ departure[start : stop - j])
                crossed += z[start + j : stop].T @ z[start : stop - j]
        total += (1.0 - j / (2 * lags + 1)) * own / rows * (crossed + crossed.T) / rows
    return np.asarray(total, dtype=np.float64)


def _before(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records of which only outputs before an input count: outputs that answer at once hold the input itself."""
    return [replace(record, spec=replace(record.spec, feedthrough=True)) for record in records]


def _seen_through_few(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records whose many outputs are replaced by their leading directions, each output counted by its size."""
    spec = records[0].spec
    if spec.ny <= _MOST:
        return list(records)
    together = np.concatenate([record.y for record in records])
    middle, size = together.mean(axis=0), together.std(axis=0)
    weight = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    turn = np.linalg.eigh(np.cov(((together - middle) * weight).T))[1][:, -_MOST:]
    outputs = tuple(Channel(f"direction {j + 1}") for j in range(_MOST))
    few = PlantSpec(spec.inputs, outputs, spec.sample_time, (), spec.feedthrough)
    return [Trajectory(record.t, record.u, (record.y - middle) * weight @ turn, few) for record in records]
