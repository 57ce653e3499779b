"""Lagrangian network: energies are learned, and the equations of motion follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from math import ceil
from typing import Any, ClassVar

import numpy as np

from harness.errors import FitError
from harness.physics.fitting.smoothing import smooth
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.bands import Bands, banded, refuse_share
from identifiers.common.observers import alpha_beta_gains, best_gain, fitted_start
from identifiers.common.records import learnable
from identifiers.learned.state_network import BandedNetwork
from identifiers.learned.training import Trained, need_torch, train_tables

NEEDS = ("torch",)

_RATE_SUFFIXES = ("_rate", "_dot")  # How the rate of a coordinate is called, as everywhere in this project.

_LEAST_MASS = 1e-3
"""Least eigenvalue of the mass matrix, relative to its size at first: it stays invertible whatever is learned."""

_FAR = 1e3  # A state so many sizes away from the data has diverged.


@dataclass(frozen=True)
class LagrangianForm:
    """What the equations look like: fixed, known before the fit."""

    names: tuple[str, ...]  # Coordinates
    periodic: tuple[bool, ...]  # Angles, which the energies see by sine and cosine
    size: tuple[float, ...]  # Size of each coordinate in the data; 1 for angles
    actuated: tuple[int, ...]  # Coordinate that each input is the generalised force of
    mass: tuple[float, ...]  # Size of each diagonal entry of the mass matrix

    def features(self, library: Any, q: Any) -> tuple[Any, Any]:
        """Return the features (..., 2 n) of q (..., n), and their derivatives by each coordinate (..., 2 n)."""
        values, derivatives = [], []
        for i, (angle, size) in enumerate(zip(self.periodic, self.size, strict=True)):
            x = q[..., i] / size
            values += [library.sin(x), library.cos(x)] if angle else [x, 0.0 * x]
            derivatives += [library.cos(x) / size, -library.sin(x) / size] if angle else [0.0 * x + 1.0 / size, 0.0 * x]
        return library.stack(values, -1), library.stack(derivatives, -1)

    def energies(self, library: Any, t: dict[str, Any], q: Any) -> tuple[Any, Any, Any, Any]:
        """Return mass matrix (..., n, n), its derivatives (..., n, n, n; last: by which), potential and gradient."""
        n = len(self.names)
        seen, seen_derivative = self.features(library, q)
        inner = library.tanh(seen @ t["mass_in"] + t["mass_bias"])
        entries = inner @ t["mass_out"] + t["mass_at"]
        well = library.tanh(seen @ t["well_in"] + t["well_bias"])
        entry_derivatives, pulls = [], []
        for i in range(n):
            own = slice(2 * i, 2 * i + 2)
            by_q = seen_derivative[..., own] @ t["mass_in"][own]
            entry_derivatives.append(((1.0 - inner**2) * by_q) @ t["mass_out"])
            by_q = seen_derivative[..., own] @ t["well_in"][own]
            pulls.append((((1.0 - well**2) * by_q) @ t["well_out"])[..., 0])
        zero = 0.0 * entries[..., 0]
        lower = self._triangle(library, entries, zero)
        turned = lower.swapaxes(-1, -2)
        scale = [value**0.5 for value in self.mass]
        weights = library.asarray([[a * b for b in scale] for a in scale])
        eye = library.asarray([[float(i == j) for j in range(n)] for i in range(n)])
        mass = weights * (lower @ turned + _LEAST_MASS * eye)
        derivatives = []
        for entry in entry_derivatives:
            moved = self._triangle(library, entry, zero)
            derivatives.append(weights * (moved @ turned + lower @ moved.swapaxes(-1, -2)))
        return mass, library.stack(derivatives, -1), (well @ t["well_out"])[..., 0], library.stack(pulls, -1)

    def accelerations(self, library: Any, t: dict[str, Any], q: Any, v: Any, u: Any) -> Any:
        """Return the accelerations (..., n): Lagrange's equations with viscous damping."""
        mass, derivatives, _, pull = self.energies(library, t, q)
        n = len(self.names)
        turning = (derivatives * v[..., None, None, :]).sum(-1) @ v[..., None]
        centrifugal = 0.5 * (derivatives * v[..., :, None, None] * v[..., None, :, None]).sum((-3, -2))
        forces = -(t["damping"] ** 2) * v - pull - turning[..., 0] + centrifugal
        zero = 0.0 * forces[..., 0]
        pushed = [zero] * n
        for column, i in enumerate(self.actuated):
            pushed[i] = pushed[i] + u[..., column]
        return library.linalg.solve(mass, (forces + library.stack(pushed, -1))[..., None])[..., 0]

    def step(self, library: Any, t: dict[str, Any], q: Any, v: Any, u: Any, dt: float) -> tuple[Any, Any]:
        """Return coordinates and rates one sample later (Runge and Kutta's fourth-order step, the input held)."""
        a1 = self.accelerations(library, t, q, v, u)
        q2, v2 = q + 0.5 * dt * v, v + 0.5 * dt * a1
        a2 = self.accelerations(library, t, q2, v2, u)
        q3, v3 = q + 0.5 * dt * v2, v + 0.5 * dt * a2
        a3 = self.accelerations(library, t, q3, v3, u)
        q4, v4 = q + dt * v3, v + dt * a3
        a4 = self.accelerations(library, t, q4, v4, u)
        return q + dt / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)

    def _triangle(self, library: Any, entries: Any, zero: Any) -> Any:
        """Return the lower triangle (..., n, n) of entries, row by row."""
        n, number, rows = len(self.names), 0, []
        for i in range(n):
            row = []
            for j in range(n):
                row.append(entries[..., number] if j <= i else zero)
                number += j <= i
            rows.append(library.stack(row, -1))
        return library.stack(rows, -2)


@dataclass(frozen=True, eq=False)
class LagrangianModel(BandedNetwork):
    """``d/dt dL/dv - dL/dq = tau - d^2 v`` with ``L = v' M(q) v / 2 - V(q)``, M and V networks; state [q, v].

    Parameters
    ----------
    spec : PlantSpec
    form : Form
    tables : dict of array
    columns : tuple of int
        Which entry of [q, v] each output is.
    scale : array (2 n,)
        Size of the states in the data.
    filter_gain : array (2 n, ny)
    bands : Bands, optional
        Standard deviation of predictions by the steps since an output was seen; the state counts them, last.
    """

    spec: PlantSpec
    form: LagrangianForm
    tables: dict[str, FloatArray]
    columns: tuple[int, ...]
    scale: FloatArray
    filter_gain: FloatArray
    bands: Bands | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "lagrangian"
    called: ClassVar[str] = "lagrangian-network"

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (2 n + 1,) whose free run fits the start of the record best."""
        same_language(self.spec, data)
        guess = _states(data, self.columns, len(self.form.names))[0]
        start = fitted_start(self.free_run, self.spec.outputs, data, guess, scale=self.scale, lengths=(15, 40))
        return np.append(start, 1.0)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return np.asarray(x, dtype=float)[..., list(self.columns)]

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., 2 n + 1); NaN once it is far outside the data."""
        n = len(self.form.names)
        whole = np.asarray(x, dtype=float)
        x, since = whole[..., : 2 * n], whole[..., 2 * n :] + 1.0
        u = np.broadcast_to(u, (*x.shape[:-1], self.spec.nu))
        with np.errstate(over="ignore", invalid="ignore"):
            near = (np.abs(x[..., n:]) <= _FAR * self.scale[n:]).all(axis=-1, keepdims=True)
            x = np.where(near, x, 0.0)
            q, v = self.form.step(np, self.tables, x[..., :n], x[..., n:], u, self.spec.sample_time)
            return np.concatenate([np.where(near, np.concatenate([q, v], axis=-1), np.nan), since], axis=-1)

    def energy(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return kinetic and potential energy (...) of states (..., 2 n or more), in the unit of input times way."""
        x = np.asarray(x, dtype=float)
        n = len(self.form.names)
        mass, _, potential, _ = self.form.energies(np, self.tables, x[..., :n])
        v = x[..., n : 2 * n]
        return 0.5 * np.einsum("...i,...ij,...j->...", v, mass, v), np.asarray(potential)

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the mass matrix (..., n, n) at coordinates q (..., n): positive definite everywhere."""
        return np.asarray(self.form.energies(np, self.tables, np.asarray(q, dtype=float))[0])


@dataclass(frozen=True)
class LagrangianNetwork(Trained):
    """Learns the energies of a mechanism: a mass matrix and a potential as networks, and viscous damping.

    The accelerations follow from Lagrange's equations (Lutter, Ritter and Peters 2019, *ICLR*, eq. 3 to 6: deep
    Lagrangian networks), so the learned plant cannot make energy, and needs fewer data than one without that form. It
    is trained on free runs over short windows. The outputs are the coordinates and, if wanted, their rates
    (``theta``, ``theta_rate``); each input is the generalised force of a coordinate. Dry friction is not in the form.
    The end of every record is held out, chooses the state of the training that is kept, and says how wide the
    bands are so many steps ahead (:class:`identifiers.common.bands.Bands`). Needs torch for the fit (extra
    ``learned``); the model runs with numpy.

    Parameters
    ----------
    actuated : tuple of str, optional
        Coordinate that each input drives; by default the first ones.
    hidden : int
        Units of each of the two networks.
    window : int
        Samples of a training window.
    held_out : float
        Share of every record, its end, that is not learned from and tells how wide the bands are.
    """

    actuated: tuple[str, ...] | None = None
    hidden: int = 16
    window: int = 8
    held_out: float = 0.2
    _: KW_ONLY
    steps: int = 800
    rate: float = 1e-2

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LagrangianModel:
        """Return the model; held-out losses stand in its notes."""
        what = "lagrangian-network"
        self.check_numbers(what, "hidden", "window")
        refuse_share(self.held_out, what)
        records, spec = learnable(trajectories, samples=ceil((self.window + 2) / self.held_out), what=what)
        records.sort(key=lambda record: (len(record), record.y.tobytes()))
        names, columns = _coordinates(spec, what)
        states = [_states(record, columns, len(names)) for record in records]
        form, scale, turns = self._form(spec, names, columns, states, records, what)
        need_torch(what)
        cuts = [len(record) - int(self.held_out * len(record)) for record in records]
        learn = _windows(records, states, [(0, cut) for cut in cuts], self.window, 1)
        held = _windows(
            records,
            states,
            [(cut, len(record)) for cut, record in zip(cuts, records, strict=True)],
            self.window,
            self.window,
        )
        n, m, h = len(names), len(names) * (len(names) + 1) // 2, self.hidden
        diagonal = np.zeros(m)
        diagonal[[i * (i + 1) // 2 + i for i in range(n)]] = 1.0
        start = {
            "mass_in": rng.normal(size=(2 * n, h)),
            "mass_bias": 0.5 * rng.normal(size=h),
            "mass_out": 0.05 * rng.normal(size=(h, m)),
            "mass_at": diagonal,
            "well_in": rng.normal(size=(2 * n, h)),
            "well_bias": 0.5 * rng.normal(size=h),
            "well_out": 0.05 * rng.normal(size=(h, 1)),
            "damping": np.full(n, 0.1),
        }
        seen = np.array(columns)
        size = scale[seen]
        # In training everything is about 1: energies in that of the usual force over the usual way, damping in that of
        # the usual force at the usual rate. Adam's steps have one size for all tables.
        push = float(np.mean(np.array(form.mass) * turns))
        well, drag = push * float(np.mean(form.size)), np.sqrt(push / scale[n:])

        def units(t: dict[str, Any]) -> dict[str, Any]:
            """Return tables in physical units."""
            drags = drag if isinstance(t["damping"], np.ndarray) else t["damping"].new_tensor(drag)
            return {**t, "well_out": t["well_out"] * well, "damping": t["damping"] * drags}

        def miss(library: Any, t: dict[str, Any], x: Any, u: Any, y: Any) -> Any:
            """Return the mean square of free runs from states x (w, 2 n), inputs and outputs (w, k, ...)."""
            q, v, total, sizes = x[:, :n], x[:, n:], 0.0, library.from_numpy(size)
            t = units(t)
            for k in range(u.shape[1] - 1):
                q, v = form.step(library, t, q, v, u[:, k], spec.sample_time)
                found = library.cat([q, v], dim=1)[:, seen]
                total = total + (((found - y[:, k + 1]) / sizes) ** 2).mean()
            return total / (u.shape[1] - 1)

        tables, losses = train_tables(what, start, miss, learn, held, self, rng=rng)
        notes = {"held-out loss": losses, "windows": len(learn[0])}
        ny = spec.ny
        draft = LagrangianModel(spec, form, units(tables), columns, scale, np.zeros((2 * n, ny)), notes=notes)
        gains = _gains(columns, n, spec.sample_time)
        begin = [state[0] for state in states]
        draft = replace(draft, filter_gain=best_gain(gains, draft.step, draft.output, begin, records))

        def guessed(stretch: Trajectory) -> FloatArray:
            return np.append(_states(stretch, columns, n)[0], 0.0)

        return banded(draft, records, cuts, size, what, guessed)

    def _form(
        self,
        spec: PlantSpec,
        names: tuple[str, ...],
        columns: tuple[int, ...],
        states: Sequence[FloatArray],
        records: Sequence[Trajectory],
        what: str,
    ) -> tuple[LagrangianForm, FloatArray, FloatArray]:
        """Return the form of the equations, the size of the states and that of the accelerations."""
        n = len(names)
        wanted = tuple(self.actuated) if self.actuated is not None else names[: spec.nu]
        if len(wanted) != spec.nu or not set(wanted) <= set(names):
            raise FitError(
                f"{what}: inputs",
                expected=f"a coordinate among {', '.join(names)} for each of {spec.nu} inputs",
                got=", ".join(wanted) or "none",
                remedy="give actuated=(COORDINATE, ...)",
            )
        every = np.concatenate(states)
        scale = np.where(every.std(axis=0) > 0, every.std(axis=0), 1.0)
        channels = {column: channel for column, channel in zip(columns, spec.outputs, strict=True)}
        periodic = tuple(channels[i].period is not None for i in range(n))
        size = tuple(1.0 if angle else float(scale[i]) for i, angle in enumerate(periodic))
        turn = np.concatenate([np.diff(state[:, n:], axis=0) for state in states]) / spec.sample_time
        push = float(np.concatenate([record.u for record in records]).std()) if spec.nu else 1.0
        turns = np.maximum(turn.std(axis=0), 1e-12)
        mass = tuple((push / turns).tolist())
        for i, angle in enumerate(periodic):
            period = float(channels[i].period or 0.0)
            if angle and abs(period - 2 * np.pi) > 1e-9:
                raise FitError(
                    f"{what}: angle {names[i]}", expected="a period of 2 pi rad", got=f"{period:g}", remedy="use rad"
                )
        return LagrangianForm(names, periodic, size, tuple(names.index(name) for name in wanted), mass), scale, turns


def _coordinates(spec: PlantSpec, what: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the coordinates by name, and which entry of [q, v] each output is."""
    labels = [channel.name for channel in spec.outputs]
    rates = {f"{name}{suffix}": name for name in labels for suffix in _RATE_SUFFIXES}
    names = tuple(name for name in labels if name not in rates)
    if not names:
        raise FitError(f"{what}: outputs", expected="coordinates", got=", ".join(labels), remedy="measure positions")
    columns = tuple(names.index(rates[name]) + len(names) if name in rates else names.index(name) for name in labels)
    return names, columns


def _states(data: Trajectory, columns: tuple[int, ...], n: int) -> FloatArray:
    """Return coordinates and rates (N, 2 n) as smoothed measurements tell them."""
    x = np.zeros((len(data), 2 * n))
    given = dict(zip(columns, range(len(columns)), strict=True))
    for i in range(n):
        values = data.y[:, given[i]]
        period = data.spec.outputs[given[i]].period
        if len(data) < 5:
            x[:, i] = values
        else:
            found = smooth(values, data.spec.sample_time, period=period)
            x[:, i], x[:, n + i] = found.value, found.rate
        if n + i in given:
            x[:, n + i] = data.y[:, given[n + i]]
    return x


def _windows(
    records: Sequence[Trajectory],
    states: Sequence[FloatArray],
    ranges: Sequence[tuple[int, int]],
    length: int,
    every: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return starts (w, 2 n), inputs (w, k, nu) and outputs (w, k, ny) of windows within ranges; angles unwrapped."""
    x, u, y = [], [], []
    for record, state, (low, high) in zip(records, states, ranges, strict=True):
        outputs = record.y.copy()
        for i, channel in enumerate(record.spec.outputs):
            if channel.period is not None:
                outputs[:, i] = np.unwrap(outputs[:, i], period=channel.period)
        for k in range(low, high - length, every):
            x.append(state[k])
            u.append(record.u[k : k + length + 1])
            y.append(outputs[k : k + length + 1])
    return np.array(x), np.array(u), np.array(y)


def _gains(columns: tuple[int, ...], n: int, dt: float) -> FloatArray:
    """Return filter gains (G, 2 n, ny): alpha-beta for coordinates, a share of a measured rate's error for itself."""
    plain = alpha_beta_gains(n, dt)
    gains = np.zeros((len(plain), 2 * n, len(columns)))
    for output, column in enumerate(columns):
        gains[:, :, output] = plain[:, :, column] if column < n else 0.0
        if column >= n:
            gains[:, column, output] = plain[:, column - n, column - n]
    return gains
