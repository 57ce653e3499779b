"""Recurrent models whose free runs were fitted to data, what they say of their own errors, and ensembles of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.models.distributions import NormalMixture, normal
from harness.rng import stream
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory, residual
from identifiers.common.bands import Ahead, Bands, held_out_runs
from identifiers.common.observers import best_gain, riccati_gains, run_in_steps
from identifiers.common.reach import Reach
from identifiers.learned.ensemble import Ensemble, own_spread
from identifiers.learned.polynomial_pass import PolynomialTables
from identifiers.learned.recurrent_fit import FittedStart, Problem, Recurrence, fit_start
from identifiers.learned.recurrent_pass import Integrating, RecurrentLayout
from identifiers.learned.state_network import StateNetwork

_HORIZONS = (1, 2, 4, 8, 16, 32, 64, 128)
"""Steps ahead at which the spread of held-out errors is measured; between them it is interpolated."""

_START = 50
"""Samples that the unknown initial state is fitted to, as the public benchmarks allow (cascaded tanks, 2016)."""

_FAR = 1e3  # A state so many sizes away from those of the data has diverged.

_LOST = 0.05
"""Share of held-out states one step ahead that may lie beyond the edges of a member, which is left out otherwise."""

_LEAST_SPREAD = 1e-6
"""Standard deviation of a prediction, relative to the size of the output, that no model may claim to be below."""


@dataclass(frozen=True, eq=False)
class RecurrentModel(StateNetwork):
    """``x+ = f(x, u)``, ``y = g(x, u)`` in scaled signals: small networks or polynomials, as the layout says.

    The state is ``[x, steps, drift]``. ``steps`` counts those since an output was seen: predictions are as uncertain as
    those that many steps ahead were on held-out data. ``drift`` (ny,) is the standard deviation that a run has gathered
    beyond the data since then; it fades as fast as the slowest motion of the model.

    Parameters
    ----------
    spec : PlantSpec
    layout : Recurrence
        A network (:class:`~identifiers.learned.recurrent_pass.RecurrentLayout`) or polynomials
        (:class:`~identifiers.learned.polynomial_pass.PolynomialTables`).
    theta : array (p,)
    u_mean, u_std, y_mean, y_std : array
        Scaling of the signals.
    x_mean, x_std : array (nx,)
        Of the states in the estimation data: what is believed of an initial state.
    fit_error : float
        Rms of the free run in the estimation data, in scaled units.
    filter_gain : array (nx, ny)
        How a scaled output corrects the state.
    spread : array (8, ny)
        Standard deviation of held-out predictions 1, 2, 4, ... 128 steps ahead, in the units of the outputs.
    unseen : array (ny,)
        Share of the drift that a seen output leaves, from 0 to 1.
    reach : Reach or None
        Where the states and inputs of the data lie.
    fade : float
        Of the drift in a step, at most 1.
    bands : Bands, optional
        Factor of the standard deviation by the steps since an output was seen; 1 where there are none.
    edges : array (2, nx), optional
        Least and largest states: a run that leaves them is held there, as nothing is known beyond. Without, it goes on
        until it is NaN.
    """

    spec: PlantSpec
    layout: Recurrence
    theta: FloatArray
    u_mean: FloatArray
    u_std: FloatArray
    y_mean: FloatArray
    y_std: FloatArray
    x_mean: FloatArray
    x_std: FloatArray
    fit_error: float
    filter_gain: FloatArray
    spread: FloatArray
    unseen: FloatArray
    reach: Reach | None
    fade: float
    bands: Bands | None = None
    edges: FloatArray | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "recurrent"

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the likeliest state at the first sample (nx + 1 + ny,), from the first 50 and what is usual."""
        same_language(self.spec, data)
        few = data[: min(len(data), _START)]
        problem = Problem(self.spec.outputs, self._input(few.u), few.y, self.y_mean, self.y_std)
        start = fit_start(self.layout, self.theta, problem, self.x_mean, self.x_std, self.fit_error)
        return self.whole(start)

    def whole(self, start: FloatArray) -> FloatArray:
        """Return the state (nx + 1 + ny,) of a model state (nx,) at a sample that is about to be seen."""
        return np.concatenate([start, [1.0], np.zeros(self.spec.ny)])

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        x = np.asarray(x, dtype=float)
        inner = x[..., : self.layout.nx]
        return np.asarray(self.y_mean + self.y_std * self.layout.output(self.theta, inner, self._input(u)))

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., ny)."""
        x, nx = np.asarray(x, dtype=float), self.layout.nx
        steps = np.log(np.maximum(x[..., nx], 1.0))
        known = np.log(_HORIZONS)
        std = np.stack([np.interp(steps, known, column) for column in self.spread.T], axis=-1)
        std = np.hypot(std, x[..., nx + 1 :])
        return normal(self.output(x, u), std * self.band_factor(x), self.spec.outputs)

    def band_factor(self, x: FloatArray) -> FloatArray:
        """Return by what held-out data scaled the deviations (..., ny) at states (..., nx + 1 + ny)."""
        x = np.asarray(x, dtype=float)
        if self.bands is None:
            return np.ones((*x.shape[:-1], self.spec.ny))
        return self.bands.at(x[..., self.layout.nx])

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx + 1 + ny); held at the edges, or NaN once it is far outside the data."""
        x, nx = np.asarray(x, dtype=float), self.layout.nx
        scaled = self._input(u)
        new = self.layout.step(self.theta, x[..., :nx], scaled)
        if self.edges is not None:
            new = np.clip(np.where(np.isfinite(new), new, x[..., :nx]), *self.edges)
        near = (np.abs(new - self.x_mean) <= _FAR * self.x_std).all(axis=-1, keepdims=True)
        new = np.where(near, new, np.nan)
        drift = self.fade * x[..., nx + 1 :]
        if self.reach is not None:
            held = np.broadcast_to(scaled, (*x.shape[:-1], self.spec.nu))
            drift = drift + self.reach.std(np.concatenate([(x[..., :nx] - self.x_mean) / self.x_std, held], axis=-1))
        return np.concatenate([new, x[..., nx : nx + 1] + 1.0, drift], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state (..., nx + 1 + ny) moved by the error of the output just seen."""
        x, nx = np.asarray(x, dtype=float), self.layout.nx
        predicted = self.output(x, u)
        miss = residual(self.spec.outputs, np.broadcast_to(y, predicted.shape), predicted) / self.y_std
        seen = x[..., :nx] + miss @ self.filter_gain.T
        return np.concatenate([seen, 0.0 * x[..., nx : nx + 1], self.unseen * x[..., nx + 1 :]], axis=-1)

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx + 1 + ny) under inputs u (M, N, nu)."""
        x, scaled = np.asarray(x, dtype=float), self._input(u)
        if self.edges is not None and not self._stays_within(x[:, : self.layout.nx], scaled):
            return run_in_steps(self, x, u)
        outputs = np.empty((*u.shape[:2], self.spec.ny))
        for row, start, inputs in zip(outputs, x, scaled, strict=True):
            found, _ = self.layout.run(self.theta, start[: self.layout.nx], inputs, sensitivities=False)
            row[:] = self.y_mean + self.y_std * found
        return outputs

    def _stays_within(self, inner: FloatArray, scaled: FloatArray) -> bool:
        """Return whether runs from states (M, nx) under scaled inputs (M, N, nu) never meet an edge."""
        for k in range(scaled.shape[1] - 1):
            inner = self.layout.step(self.theta, inner, scaled[:, k])
            if not self.within(inner).all():
                return False
        return True

    def within(self, x: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether states (..., nx or more) lie strictly within the edges (...)."""
        inner = np.asarray(x)[..., : self.layout.nx]
        if self.edges is None:
            return np.asarray(np.isfinite(inner).all(axis=-1))
        return np.asarray(((inner > self.edges[0]) & (inner < self.edges[1])).all(axis=-1))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> RecurrentModel:
        """Return the model of a description."""
        return cls.read(content, layout=_layout_of(content["layout"]))


def _layout_of(sizes: Any) -> Recurrence:
    """Return the layout of a description."""
    if not isinstance(sizes, dict):
        return RecurrentLayout(*map(int, sizes))
    if "inner" in sizes:
        return Integrating(RecurrentLayout(*map(int, sizes["inner"])), tuple(map(float, sizes["size"])))
    return PolynomialTables.of(sizes)


@dataclass(frozen=True, eq=False)
class RecurrentEnsemble(Ensemble):
    """Recurrent models as one."""

    kind = "recurrent-ensemble"
    member = RecurrentModel


def vouched(
    spec: PlantSpec,
    layout: Recurrence,
    best: Sequence[FittedStart],
    problems: Sequence[Problem],
    records: Sequence[Trajectory],
    what: str,
    *,
    bounded: bool = False,
) -> RecurrentEnsemble:
    """Return the ensemble of some fits, its bands wide enough on what they hold out.

    Raises FitError if more than one in twenty held-out free runs leaves that range one step ahead.

    - ``best``: one for each member
    - ``problems, records``: the records, scaled and as they are
    - ``what``: name of the identifier, for messages
    - ``bounded``: hold free runs at three times the range of the states in the data
    """
    members = [own_member(spec, layout, fitted, problems, records, bounded=bounded) for fitted in best]
    cuts = [problem.cut for problem in problems]
    draft = RecurrentEnsemble(spec, tuple(members), {})
    runs = held_out_runs(draft, records, cuts)
    if bounded and runs:
        stay = [float(np.mean(~member.within(part))) <= _LOST for member, part in draft.parts(runs[0].x)]
        if any(stay) and not all(stay):  # the others vouch for themselves
            best = [fitted for fitted, fine in zip(best, stay, strict=True) if fine]
            members = [member for member, fine in zip(members, stay, strict=True) if fine]
            draft = RecurrentEnsemble(spec, tuple(members), {})
            runs = held_out_runs(draft, records, cuts)
    spread = _spread(draft, runs)
    reaches = [_reach(m, problems, records, fitted) for m, fitted in zip(members, best, strict=True)]
    notes: dict[str, Any] = {"held-out rms": [fitted.held_out for fitted in best], "parameters": layout.count}
    wide = [replace(m, spread=spread, reach=reach) for m, reach in zip(members, reaches, strict=True)]
    draft = RecurrentEnsemble(spec, tuple(wide), notes)
    runs = held_out_runs(draft, records, cuts)
    # At once beyond the edges a model is worth nothing; further ahead being held there is an error like others.
    runs[:1] = [_lost_outside(draft, one) for one in runs[:1]]
    bands = Bands.scaling(draft, runs, what) if runs else None
    if bands is not None:
        notes["bands"] = bands.note(spec.sample_time)
    return RecurrentEnsemble(spec, tuple(replace(m, bands=bands) for m in wide), notes)


def _lost_outside(model: RecurrentEnsemble, one: Ahead) -> Ahead:
    """Return held-out samples with NaN for the states of those that a member is held at an edge for."""
    fine = np.all([member.within(part) for member, part in model.parts(one.x)], axis=0)
    return replace(one, x=np.where(fine[:, None], one.x, np.nan))


def own_member(
    spec: PlantSpec,
    layout: Recurrence,
    fitted: FittedStart,
    problems: Sequence[Problem],
    records: Sequence[Trajectory],
    *,
    bounded: bool = False,
) -> RecurrentModel:
    """Return the model of one fit with its filter gain, and no spread yet."""
    states = np.concatenate([p.states(layout, fitted.theta, x) for p, x in zip(problems, fitted.starts, strict=True)])
    low, high = states.min(axis=0), states.max(axis=0)
    edges = np.array([low - (high - low), high + (high - low)]) if bounded else None
    if edges is not None and isinstance(layout, Integrating):  # where it stands does not matter to it
        edges[:, layout.inner.nx :] = [[-np.inf], [np.inf]]
    x_mean, x_std = states.mean(axis=0), np.maximum(states.std(axis=0), 1e-6)
    zero = np.zeros((layout.nx, spec.ny))
    wide = np.ones((len(_HORIZONS), spec.ny))
    u_mean, u_std = problems[0].u_scale
    y_std = problems[0].y_std
    signals = (u_mean, u_std, problems[0].y_mean, y_std, x_mean, x_std)
    draft = RecurrentModel(
        spec, layout, fitted.theta, *signals, fitted.error, zero, wide, np.ones(spec.ny), None, 1.0, edges=edges
    )
    a, c = layout.jacobians(fitted.theta, x_mean, np.zeros(spec.nu))
    gains = riccati_gains(a, c, x_std, np.ones(spec.ny))
    # best_gain moves whole states, counter included, by errors in units; the model's gain is for scaled ones.
    padded = np.concatenate([gains / y_std, np.zeros((len(gains), 1 + spec.ny, spec.ny))], axis=1)
    begin = [draft.whole(start) for start in fitted.starts]
    gain = best_gain(padded, draft.step, draft.output, begin, records)[: layout.nx] * y_std
    fade = min(float(np.abs(np.linalg.eigvals(a)).max()), 1.0)
    unseen = np.clip(1.0 - np.diag(c @ gain), 0.0, 1.0)
    return replace(draft, filter_gain=gain, fade=fade, unseen=unseen)


def _reach(
    member: RecurrentModel, problems: Sequence[Problem], records: Sequence[Trajectory], fitted: FittedStart
) -> Reach:
    """Return where the states and inputs of the data lie, and how the error of the next output grows beyond."""
    rows, targets = [], []
    for problem, record, start in zip(problems, records, fitted.starts, strict=True):
        states = problem.states(member.layout, fitted.theta, start)[: len(record) - 1]
        rows.append(np.hstack([(states - member.x_mean) / member.x_std, problem.u[: len(states)]]))
        targets.append(residual(record.spec.outputs, record.y[1:], record.y[:-1])[: len(states)])
    return Reach.of(np.concatenate(rows), np.concatenate(targets), rng=stream("reach"))


def _spread(draft: RecurrentEnsemble, runs: Sequence[Ahead]) -> FloatArray:
    """Return the standard deviation (8, ny) of each member at the horizons, on the held-out ends of the records."""
    size = draft.members[0].y_std
    rows = []
    for run in runs[: len(_HORIZONS)]:
        each = np.array([member.output(part, run.u) for member, part in draft.parts(run.x)])
        kept = np.isfinite(each).all(axis=(0, 2))
        if not kept.any():
            break
        miss = residual(draft.spec.outputs, run.y, each.mean(axis=0))
        rows.append(own_spread(miss[kept], each.var(axis=0)[kept]))
    rows = rows or [size]
    rows += [rows[-1]] * (len(_HORIZONS) - len(rows))
    return np.asarray(np.maximum(np.maximum.accumulate(rows, axis=0), _LEAST_SPREAD * size), dtype=np.float64)
