"""Linear dynamics with Prandtl-Ishlinskii hysteresis inside: weighted stop operators of a signal that the fit finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_undetermined
from harness.models.damped import Damping
from harness.models.distributions import NormalMixture, normal
from harness.options import check_options
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.blocks.hysteresis_fit import HysteresisPoint, Pair, descended, started
from identifiers.blocks.hysteresis_pass import HysteresisLayout, HysteresisRun, played
from identifiers.common.described import Described
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.observers import likeliest_start
from identifiers.common.records import learnable
from identifiers.common.scaling import centred

_SEEN = 400  # Samples from which an initial state is estimated at most.
_LEAST, _MOST = 0.1, 4.0
"""Radii of the smallest and the largest stop, in standard deviations of the signal that draws them at first."""
_PROBE = 8  # Rounds of the descent after which what draws the hysteresis is chosen.
_LOOP = 400  # Points of a hysteresis loop that is drawn.


@dataclass(frozen=True, eq=False)
class PrandtlIshlinskiiModel(Described):
    """``x+ = A x + B u + E w``, ``y = C x + D u + F w``, ``w`` hysteresis of ``z = G x + H u``, in scaled signals.

    ``w_i = sum_j W_ij (z_i - p_ij)`` with plays ``p_ij`` of radius ``r_ij``. A stop ``z - p`` is never beyond its
    radius, so that a free run is bounded where A is stable. The state is ``[x, p]``. Outputs correct nothing: the
    model is fitted to free runs.

    Parameters
    ----------
    spec : PlantSpec
    layout : Layout
    theta : array (p,)
        All coefficients.
    radii : array (nz, m)
    u_scale, y_scale : array (2, nu), (2, ny)
        Mean and size of the signals.
    state_mean : array (nx + nz m,)
        Of the states in the estimation data: what is believed of an initial state.
    state_root : array (nx + nz m, nx + nz m)
        Square root R of their covariance R R'.
    std : array (ny,)
        Of the free-run error in the estimation data, in the outputs' units.
    """

    spec: PlantSpec
    layout: HysteresisLayout
    theta: FloatArray
    radii: FloatArray
    u_scale: FloatArray
    y_scale: FloatArray
    state_mean: FloatArray
    state_root: FloatArray
    std: FloatArray
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "prandtl-ishlinskii"
    burn_in: ClassVar[int] = 0  # None: the initial state is estimated from the record.

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the likeliest state (nx + nz m,) by those of the estimation data and the first samples of the record.

        The states of the estimation data are taken for normal, with all their correlations: plays that the first
        samples do not move are where they usually are when the others are where these samples put them.
        """
        same_language(self.spec, data)
        u, y = data.u[:_SEEN], data.y[:_SEEN]
        level = np.maximum(self.std, 1e-9 * self.y_scale[1])

        def state(whitened: FloatArray) -> FloatArray:
            return self.state_mean + whitened @ self.state_root.T

        def residuals(whitened: FloatArray) -> FloatArray:
            """Return what is wrong (M, N ny + n) with some states (M, n)."""
            runs = self.free_run(state(whitened), np.broadcast_to(u, (len(whitened), *u.shape)))
            return np.hstack([((runs - y) / level).reshape(len(whitened), -1), whitened])

        start = np.zeros(self.state_root.shape[1])
        rule = Damping(rounds=10, enough=1e-4)
        return state(likeliest_start(residuals, [start], np.full(start.shape, 1e-4), rule))

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        inner, _, v, w = self._inside(x, u)
        t = self.layout.tables(self.theta)
        return np.asarray(self.y_scale[0] + self.y_scale[1] * (inner @ t["C"].T + v @ t["D"].T + w @ t["F"].T))

    def predictive(self, x: FloatArray, u: FloatArray) -> NormalMixture:
        """Return the normal distribution of the output (..., ny), with the error of free runs."""
        return normal(self.output(x, u), self.std, self.spec.outputs)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx + nz m)."""
        inner, memory, v, w = self._inside(x, u)
        t = self.layout.tables(self.theta)
        ahead = inner @ self.layout.a_matrix(self.theta).T + v @ t["B"].T + w @ t["E"].T
        return np.concatenate([ahead, memory.reshape(*memory.shape[:-2], -1)], axis=-1)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the same state (..., nx + nz m)."""
        return x

    def free_run(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the outputs (M, N, ny) from states x (M, nx + nz m) under inputs u (M, N, nu)."""
        out = np.full((*u.shape[:2], self.spec.ny), np.nan)
        for row, start, inputs in zip(out, np.asarray(x, dtype=float), u, strict=True):
            run = self._run(start, inputs)
            if run is not None:
                row[:] = self.y_scale[0] + self.y_scale[1] * run.y
        return out

    def hysteresis_loop(self, number: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return input and output (400,), (400,) of a hysteresis over one cycle of its usual size, after a first one.

        Parameters
        ----------
        number : int
            Which one.

        Returns
        -------
        z : array (400,)
            A sine whose amplitude is that of the estimation data (``notes["amplitudes"]``).
        w : array (400,)
            The weighted stops. Both in scaled signals.
        """
        amplitude = float(self.notes["amplitudes"][number])
        z = amplitude * np.sin(2.0 * np.pi * np.arange(2 * _LOOP) / _LOOP)
        memory, w = np.zeros(self.radii[number : number + 1].shape), np.empty(len(z))
        weights = self.layout.tables(self.theta)["W"][number]
        for k, now in enumerate(z):
            memory, _ = played(memory, np.array([now]), self.radii[number : number + 1])
            w[k] = float(weights @ (now - memory[0]))
        return z[_LOOP:], w[_LOOP:]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description, the sizes of the layout in a row."""
        size = self.layout
        return {**super().to_dict(), "layout": [size.nx, size.nu, size.ny, size.nz, size.stops]}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> PrandtlIshlinskiiModel:
        """Return the model of a description."""
        return cls.read(content, layout=HysteresisLayout(*map(int, content["layout"])))

    def _run(self, x: FloatArray, u: FloatArray) -> HysteresisRun | None:
        """Return the free run from a state, or None where it diverges."""
        nx = self.layout.nx
        return self.layout.run(self.theta, self.radii, x[:nx], x[nx:].reshape(self.radii.shape), self._input(u))

    def _input(self, u: FloatArray) -> FloatArray:
        """Return inputs (..., nu) as the layout takes them: scaled, with a one behind where it has constants."""
        return _with_one((np.asarray(u, dtype=float) - self.u_scale[0]) / self.u_scale[1], self.layout.nu)

    def _inside(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the inner state, the plays after this sample (..., nz, m), the scaled input and the hystereses."""
        x, nx = np.asarray(x, dtype=float), self.layout.nx
        t = self.layout.tables(self.theta)
        inner, v = x[..., :nx], self._input(u)
        z = inner @ t["G"].T + v @ t["H"].T
        memory, _ = played(x[..., nx:].reshape(*x.shape[:-1], *self.radii.shape), z, self.radii)
        return inner, memory, v, np.sum(t["W"] * (z[..., None] - memory), axis=-1)


@dataclass(frozen=True)
class PrandtlIshlinskii(Excited):
    """Linear state-space model with rate-independent hysteresis inside, fitted to free runs.

    Every hysteresis is a Prandtl-Ishlinskii operator: a weighted sum of stops of given radii (Visintin 1994,
    *Differential Models of Hysteresis*, ch. III), drawn by a signal ``z = G x + H u`` that the fit finds, and it acts
    on the dynamics and the outputs: on the input side (a piezo's voltage, a valve) as in a loop (joints, bristles, a
    piezo's charge, by which resonances sink with the amplitude). The start is a linear regression on stops of measured
    signals; all coefficients then descend by Levenberg and Marquardt's method, with exact derivatives that compiled
    code carries along and the initial state of every record among the unknowns. A play that a record moves once or
    twice remembers it for good: beyond the amplitudes of the data such memory is a guess.

    Parameters
    ----------
    order : int
        States of the linear part.
    hystereses : int, optional
        How many; by default one for each signal that draws them.
    stops : int
        Stops of each; their radii are spread geometrically from 0.1 to 4 standard deviations of the signal that draws
        them at first, and the fit scales them together.
    drawn_by : {"auto", "inputs", "outputs"}
        Signals by which the hystereses are drawn at first; ``"auto"`` tries both.
    direct : bool
        Outputs answer the input of the same sample; always so for a plant with feedthrough.
    offset : bool
        Fit constants too: a hysteresis remembers on which side a record began, and no mean tells it.
    positive : bool
        Keep the weights of the stops at 0 and above: every loop then turns one way and only loses energy.
    rounds : int
        Steps of the descent, at most.

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> u, y, play = np.random.default_rng(0).uniform(-2, 2, (1200, 1)), np.zeros((1200, 1)), 0.0
    >>> for k in range(1199):
    ...     play = min(max(play, u[k, 0] - 0.7), u[k, 0] + 0.7)
    ...     y[k + 1] = 0.7 * y[k] + 0.2 * u[k] + 0.3 * play
    >>> data = Trajectory(np.arange(1200.0), u, y, spec)
    >>> model = PrandtlIshlinskii(order=1, drawn_by="inputs").fit([data], rng=np.random.default_rng(0))
    >>> bool(model.std[0] < 0.05 * y.std()), model.layout.a_matrix(model.theta).round(1).tolist()
    (True, [[0.7]])
    """

    order: int = 2
    hystereses: int | None = None
    stops: int = 8
    drawn_by: Literal["auto", "inputs", "outputs"] = "auto"
    direct: bool = False
    offset: bool = True
    positive: bool = False
    rounds: int = 60
    expected_failures: ClassVar[Mapping[str, str]] = {}

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> PrandtlIshlinskiiModel:
        """Return the model; what draws its hystereses, their weights and amplitudes stand in its notes."""
        what = "prandtl-ishlinskii"
        check_options(self, what, order=">= 1", hystereses=">= 1", stops=">= 1", rounds=">= 1")
        records, spec = learnable(trajectories, samples=20 * (self.order + self.stops), what=what)
        refuse_undetermined(records, what, self.least_excitation)
        u_scale, y_scale = (np.array(centred([getattr(one, name) for one in records])) for name in "uy")
        width = spec.nu + self.offset
        pairs = [
            (_with_one((one.u - u_scale[0]) / u_scale[1], width), (one.y - y_scale[0]) / y_scale[1]) for one in records
        ]
        layout, radii, point, error, by = self._descended(spec, pairs)
        model = PrandtlIshlinskiiModel(
            spec, layout, point.theta, radii, u_scale, y_scale, np.zeros(0), np.zeros((0, 0)), np.zeros(spec.ny)
        )
        return _finished(model, point, pairs, {"order": self.order, "drawn_by": by, "fit_error": error})

    def _descended(
        self, spec: PlantSpec, pairs: Sequence[Pair]
    ) -> tuple[HysteresisLayout, FloatArray, HysteresisPoint, float, Literal["inputs", "outputs"]]:
        """Return where the better start ends: layout, radii, point, error, and what drew its hystereses at first."""
        direct = self.direct or spec.feedthrough
        ways: tuple[Literal["inputs", "outputs"], ...] = ("inputs", "outputs")
        ways = ways if self.drawn_by == "auto" else (self.drawn_by,)
        rounds = min(_PROBE, self.rounds) if len(ways) > 1 else self.rounds
        found = []
        for by in ways:
            loops = self.hystereses or (spec.nu if by == "inputs" else spec.ny)
            layout = HysteresisLayout(self.order, spec.nu + self.offset, spec.ny, loops, self.stops)
            radii = np.tile(np.geomspace(_LEAST, _MOST, self.stops) if self.stops > 1 else [0.5], (loops, 1))
            theta = started(layout, pairs, radii, by=by, direct=direct)
            begin = HysteresisPoint(theta, np.zeros((len(pairs), self.order)))
            end, error = descended(layout, begin, pairs, radii, rounds, direct=direct, positive=self.positive)
            found.append((error, layout, radii, end, by))
        error, layout, radii, point, by = min(found, key=lambda one: one[0])
        if rounds < self.rounds:
            rest = self.rounds - rounds
            point, error = descended(layout, point, pairs, radii, rest, direct=direct, positive=self.positive)
        return layout, radii, point, error, by


def _with_one(u: FloatArray, width: int) -> FloatArray:
    """Return scaled inputs (..., nu), with a one behind them where so many are wanted."""
    return u if u.shape[-1] == width else np.concatenate([u, np.ones((*u.shape[:-1], 1))], axis=-1)


def _finished(
    draft: PrandtlIshlinskiiModel, point: HysteresisPoint, pairs: Sequence[Pair], notes: dict[str, Any]
) -> PrandtlIshlinskiiModel:
    """Return the model with what its runs over the estimation data say of its states, errors and loops."""
    layout, t = draft.layout, draft.layout.tables(point.theta)
    states, errors, signals = [], [], []
    for (u, y), x in zip(pairs, point.starts, strict=True):
        run = layout.run(point.theta, draft.radii, x, np.zeros(draft.radii.shape), u)
        if run is None:
            raise FitError(
                "prandtl-ishlinskii: a free run diverges", expected="bounded runs", got="states without bound",
                remedy="lower the order",
            )  # fmt: skip
        z = run.states @ t["G"].T + u @ t["H"].T
        plays = (z[..., None] - run.stops).reshape(len(u), -1)
        states.append(np.hstack([run.states, np.vstack([np.zeros((1, plays.shape[1])), plays[:-1]])]))
        errors.append(run.y - y)
        signals.append(z)
    whole, wrong, drawing = (np.concatenate(one) for one in (states, errors, signals))
    values, vectors = np.linalg.eigh(np.cov(whole.T).reshape(whole.shape[1], -1))
    notes |= {
        "weights": t["W"].tolist(),
        "radii": draft.radii.tolist(),
        "amplitudes": np.abs(drawing).max(axis=0).tolist(),
        "parameters": layout.count,
    }
    return PrandtlIshlinskiiModel(
        draft.spec, layout, point.theta, draft.radii, draft.u_scale, draft.y_scale,
        state_mean=whole.mean(axis=0), state_root=vectors * np.sqrt(np.maximum(values, 0.0)),
        std=np.sqrt(np.mean(wrong**2, axis=0)) * draft.y_scale[1], notes=notes,
    )  # fmt: skip
