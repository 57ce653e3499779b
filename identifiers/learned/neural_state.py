"""Recurrent state-space network: a linear model and a tanh network in its state, trained on free runs of windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np

from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.bands import Bands, banded, refuse_share
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.observers import best_gain, fitted_start, riccati_gains
from identifiers.common.scaling import centred
from identifiers.learned.state_network import BandedNetwork
from identifiers.learned.training import Trained, draw_layers, need_torch, train_tables
from identifiers.linear.least_squares import Arx

NEEDS = ("torch",)

_TABLES = ("A", "B", "drift", "C", "D", "offset", "W1", "b1", "W2", "encoder")
"""Trained; the tables of a model in the order of its description."""

_LONG = 4  # Length of held-out windows, in those of training: a model must not drift beyond what it was trained on.
_FAR = 1e3  # A scaled state beyond it has diverged.


@dataclass(frozen=True, eq=False)
class NeuralStateModel(BandedNetwork):
    """``x+ = A x + B u + drift + tanh([x, u] W1 + b1) W2``, ``y = C x + D u + offset``, in scaled signals.

    Parameters
    ----------
    spec : PlantSpec
    tables : dict of array
        A (nx, nx), B (nx, nu), drift (nx,), C (ny, nx), D (ny, nu), offset (ny,), W1 (nx + nu, h), b1 (h,),
        W2 (h, nx), encoder (lags (ny + nu), nx): the state from past outputs and inputs, newest first.
    u_mean, u_std, y_mean, y_std : array
        Scaling of the signals.
    filter_gain : array (nx, ny)
        How a scaled output corrects the state.
    lags : int
    bands : Bands, optional
        Standard deviation of predictions by the steps since an output was seen; the state counts them, last.
    """

    spec: PlantSpec
    tables: dict[str, FloatArray]
    u_mean: FloatArray
    u_std: FloatArray
    y_mean: FloatArray
    y_std: FloatArray
    filter_gain: FloatArray
    lags: int
    bands: Bands | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    kind = called = "neural-state-space"

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state (nx + 1,) whose free run fits the start of the record best."""
        same_language(self.spec, data)
        y, u = (data.y[0] - self.y_mean) / self.y_std, (data.u[0] - self.u_mean) / self.u_std
        guess = np.concatenate([np.tile(y, self.lags), np.tile(u, self.lags)]) @ self.tables["encoder"]
        scale = np.ones(len(guess))
        start = fitted_start(self.free_run, self.spec.outputs, data, guess, scale=scale, lengths=(30, 120))
        return np.append(start, 1.0)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        t = self.tables
        scaled = np.asarray(x)[..., : len(t["A"])] @ t["C"].T + self._input(u) @ t["D"].T + t["offset"]
        return np.asarray(self.y_mean + self.y_std * scaled)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (..., nx + 1); NaN once it is far outside the data."""
        t = self.tables
        nx = len(t["A"])
        whole = np.asarray(x, dtype=float)
        x, since = whole[..., :nx], whole[..., nx:] + 1.0
        v = np.broadcast_to(self._input(u), (*x.shape[:-1], self.spec.nu))
        with np.errstate(over="ignore", invalid="ignore"):
            hidden = np.tanh(x @ t["W1"][:nx] + v @ t["W1"][nx:] + t["b1"])
            new = x @ t["A"].T + v @ t["B"].T + t["drift"] + hidden @ t["W2"]
            near = np.abs(new).max(axis=-1, keepdims=True) <= _FAR
            return np.concatenate([np.where(near, new, np.nan), since], axis=-1)


@dataclass(frozen=True)
class NeuralStateSpace(Excited, Trained):
    """Neural state-space model, trained by the simulation error of many short windows.

    The state of every window comes from past outputs and inputs through an encoder that is trained too (Beintema, Toth
    and Schoukens 2021, *L4DC*: the subspace encoder). Training begins at an ARX model, so that a network that learns
    nothing is one. The end of every record is held out, chooses the state of the training that is kept, and says
    how wide the bands are so many steps ahead (:class:`identifiers.common.bands.Bands`); they do not widen outside the
    data.
    Needs torch for the fit (extra ``learned``); the model runs with numpy.

    Parameters
    ----------
    order : int
        Lags of the ARX model; the state has ``order ny + (order - 1) nu`` entries.
    hidden : int
        Units of the network.
    window : int
        Samples of a training window.
    direct : bool
        Let y[k] depend on u[k]; always so for a plant with feedthrough.
    held_out : float
        Share of every record, its end, that is not learned from and tells how wide the bands are.
    """

    order: int = 3
    hidden: int = 24
    window: int = 60
    direct: bool = False
    held_out: float = 0.2
    _: KW_ONLY
    rate: float = 3e-3

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> NeuralStateModel:
        """Return the model; held-out losses stand in its notes."""
        what = "neural-state-space"
        self.check_numbers(what, "order", "hidden", "window")
        refuse_share(self.held_out, what)
        lags = self.order
        records, spec = self.asked(trajectories, samples=2 * lags + 20, what=what)
        need_torch(what)
        (u_mean, u_std), (y_mean, y_std) = (
            centred([record.u for record in records]),
            centred([record.y for record in records]),
        )
        scaled = [
            Trajectory(record.t, (record.u - u_mean) / u_std, (record.y - y_mean) / y_std, record.spec)
            for record in records
        ]
        cuts = [len(record) - max(int(self.held_out * len(record)), lags + 6) for record in scaled]
        learn = [record[:cut] for record, cut in zip(scaled, cuts, strict=True)]
        held = [record[cut:] for record, cut in zip(scaled, cuts, strict=True)]
        start = _start(learn, spec, lags, self.hidden, rng)
        direct = self.direct or spec.feedthrough
        parts = _windows(learn, lags, self.window, 1)
        long = _windows(held, lags, _LONG * self.window, self.window)

        def miss(library: Any, t: dict[str, Any], z: Any, u: Any, y: Any) -> Any:
            """Return the mean square of free runs from past (w, p), inputs (w, n, nu), outputs (w, n, ny)."""
            x = z @ t["encoder"]
            nx = x.shape[1]
            inside = u @ t["W1"][nx:] + t["b1"]
            push = u @ t["B"].T + t["drift"]
            free = u @ t["D"].T + t["offset"]
            from_x, turn, look = t["W1"][:nx], t["A"].T, t["C"].T
            total = 0.0
            for k in range(u.shape[1]):
                total = total + ((x @ look + free[:, k] - y[:, k]) ** 2).mean()
                x = x @ turn + push[:, k] + library.tanh(x @ from_x + inside[:, k]) @ t["W2"]
            return total / u.shape[1]

        first, fixed = {name: start[name] for name in _TABLES}, () if direct else ("D",)
        tables, losses = train_tables(what, first, miss, parts, long, self, rng=rng, fixed=fixed)
        nx = len(tables["A"])
        notes = {"held-out rms": [float(np.sqrt(loss)) for loss in losses], "states": nx, "windows": len(parts[0])}
        signals = (u_mean, u_std, y_mean, y_std)
        draft = NeuralStateModel(spec, tables, *signals, np.zeros((nx, spec.ny)), lags, notes=notes)
        gains = riccati_gains(tables["A"], tables["C"], np.ones(nx), np.ones(spec.ny))
        begin = [draft.initial_state(record) for record in records]
        # best_gain moves states by errors in units; the model's gain is for scaled ones.
        padded = np.concatenate([gains / y_std, np.zeros((len(gains), 1, spec.ny))], axis=1)
        gain = best_gain(padded, draft.step, draft.output, begin, records)[:nx] * y_std
        return banded(replace(draft, filter_gain=gain), records, cuts, y_std, what)


def _start(
    learn: Sequence[Trajectory], spec: PlantSpec, lags: int, hidden: int, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Return the tables of the ARX model of the scaled signals, and a network that adds next to nothing."""
    arx = Arx(order=lags, ridge=1e-8).fit(learn, rng=rng)
    ny, nu = spec.ny, spec.nu
    nx = arx.a_matrix.shape[0]
    # The state is [y lags, u lags but the newest]: the encoder picks it out of [y lags, u lags of before].
    encoder = np.zeros((lags * (ny + nu), nx))
    encoder[: lags * ny, : lags * ny] = np.eye(lags * ny)
    encoder[lags * ny : lags * ny + (lags - 1) * nu, lags * ny :] = np.eye((lags - 1) * nu)
    (w1, b1), (w2, _) = draw_layers((nx + nu, hidden, nx), rng, 1)
    network = {"b1": b1[0, 0] + 0.1 * rng.normal(size=hidden), "W1": w1[0], "W2": 0.01 * w2[0]}
    return {
        "A": np.array(arx.a_matrix),
        "B": np.array(arx.b_matrix),
        "drift": np.array(arx.state_offset),
        "C": np.array(arx.c_matrix),
        "D": np.zeros((ny, nu)),
        "offset": np.zeros(ny),
        "encoder": encoder,
        **network,
    }


def _windows(
    records: Sequence[Trajectory], lags: int, length: int, every: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the past (w, lags (ny + nu)), inputs (w, n, nu) and outputs (w, n, ny) of windows within records.

    Outputs of the past reach up to the first sample of the window, inputs up to the one before; a window is shorter
    where every record is.
    """
    n = min(length, max(len(record) for record in records) - lags)
    past, inputs, outputs = [], [], []
    for record in records:
        for k in range(lags, len(record) - n + 1, every):
            newest_y, newest_u = record.y[k - lags + 1 : k + 1][::-1], record.u[k - lags : k][::-1]
            past.append(np.concatenate([newest_y.ravel(), newest_u.ravel()]))
            inputs.append(record.u[k : k + n])
            outputs.append(record.y[k : k + n])
    return np.array(past), np.array(inputs), np.array(outputs)
