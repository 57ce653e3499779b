"""Embed to control: a small latent state with locally linear dynamics, learned from many outputs (keypoints)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.scoring import same_language
from harness.signals import FloatArray, PlantSpec, Trajectory
from identifiers.common.judge.excited import Excited
from identifiers.common.judge.told import told
from identifiers.common.observers import best_gain, fitted_start, riccati_gains
from identifiers.common.scaling import centred
from identifiers.learned.state_network import StateNetwork
from identifiers.learned.training import Trained, need_torch, train_tables

NEEDS = ("torch",)

_TABLES = (
    "encoder",
    "encode_in",
    "encode_bias",
    "encode_out",
    "A",
    "B",
    "offset",
    "local_in",
    "local_bias",
    "turn",
    "look",
    "push",
    "drift",
    "C",
    "centre",
    "decode_in",
    "decode_bias",
    "decode_out",
)
"""Trained, in this order."""

_NETWORK = 0.01  # Size of the networks' last layers at first: a training begins at the linear latent model.

_CONSISTENCY = 0.1
"""Weight of the distance between predicted and encoded latent states, in that of the outputs' errors."""

_FAR = 1e3  # A latent state beyond it has diverged; they have the size 1.
_HELD_OUT = 5  # One record in so many is held out, or the end of the only ones.


@dataclass(frozen=True, eq=False)
class LatentModel(StateNetwork):
    """``z+ = z + z A + (z . look(z)) turn(z) + u B(z) + drift(z)``, ``y = decoder(z)``, in scaled signals.

    Parameters
    ----------
    spec : PlantSpec
    tables : dict of array
    lags : int
        Samples that the encoder looks at.
    u_mean, u_std, y_mean, y_std : array
        Scaling of the signals.
    rest : array (nz,)
        Latent state about which ``a_matrix`` to ``d_matrix`` are linearised: where the data are on average.
    filter_gain : array (nz, ny)
        How a scaled output corrects the latent state.
    """

    spec: PlantSpec
    tables: dict[str, FloatArray]
    lags: int
    u_mean: FloatArray
    u_std: FloatArray
    y_mean: FloatArray
    y_std: FloatArray
    rest: FloatArray
    filter_gain: FloatArray
    notes: dict[str, Any] = field(default_factory=dict)
    kind = "embed-to-control"

    @property
    def a_matrix(self) -> FloatArray:
        """Dynamics (nz, nz) linearised at rest."""
        return self._jacobian(lambda z: _ahead(np, self.tables, z, np.zeros((len(z), self.spec.nu))), self.rest)

    @property
    def b_matrix(self) -> FloatArray:
        """Effect (nz, nu) of an input in its unit."""
        rest = np.tile(self.rest, (2 * max(self.spec.nu, 1), 1))
        jacobian = self._jacobian(lambda u: _ahead(np, self.tables, rest, u), np.zeros(self.spec.nu))
        return np.asarray(jacobian / self.u_std)

    @property
    def c_matrix(self) -> FloatArray:
        """Outputs in their units by latent state (ny, nz)."""
        return np.asarray(self._jacobian(lambda z: _decoded(np, self.tables, z), self.rest) * self.y_std[:, None])

    @property
    def d_matrix(self) -> FloatArray:
        """Zero (ny, nu): an input is seen one sample later."""
        return np.zeros((self.spec.ny, self.spec.nu))

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the latent state (nz,) whose free run fits the start of the record best."""
        same_language(self.spec, data)
        y, u = (data.y[0] - self.y_mean) / self.y_std, (data.u[0] - self.u_mean) / self.u_std
        past = np.concatenate([np.tile(y, self.lags), np.tile(u, self.lags - 1)])
        guess = _encoded(np, self.tables, past[None])[0]
        scale = np.ones(len(guess))
        return fitted_start(self.free_run, self.spec.outputs, data, guess, scale=scale, lengths=(10, 40))

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output (..., ny)."""
        return np.asarray(self.y_mean + self.y_std * _decoded(np, self.tables, np.asarray(x, dtype=float)))

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next latent state (..., nz); NaN once it is far outside the data."""
        x = np.asarray(x, dtype=float)
        v = self._input(np.broadcast_to(u, (*x.shape[:-1], self.spec.nu)))
        with np.errstate(over="ignore", invalid="ignore"):
            new = _ahead(np, self.tables, x, v)
            return np.where(np.abs(new).max(axis=-1, keepdims=True) <= _FAR, new, np.nan)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description, with the shapes of the tables, of which some may be empty."""
        return {**super().to_dict(), "shapes": {name: list(table.shape) for name, table in self.tables.items()}}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> LatentModel:
        """Return the model of a description."""
        shapes = content["shapes"]
        tables = {name: np.array(table, float).reshape(shapes[name]) for name, table in content["tables"].items()}
        return cls.read(content, tables=tables)

    def _jacobian(self, function: Any, at: FloatArray) -> FloatArray:
        """Return the derivative (m, n) of a function of rows by central differences."""
        steps = 1e-5 * np.eye(len(at))
        values = function(np.concatenate([at + steps, at - steps]))[: 2 * len(at)]
        up, down = np.split(values, 2) if len(at) else (values[:0], values[:0])
        return np.asarray((up - down).T / 2e-5)


@dataclass(frozen=True)
class EmbedToControl(Excited, Trained):
    """A latent state of few numbers for many outputs, whose dynamics are linear about every point.

    After Watter, Springenberg, Boedecker and Riedmiller 2015 (*NeurIPS*, sec. 2): an encoder, locally linear dynamics
    with ``A(z) = A + turn(z) look(z)'`` and a decoder are trained together, so that predictions decode to what is seen
    and agree with what is encoded. Their covariances are fixed here, so the bound becomes squared distances. Training
    begins at a linear latent model (principal components of a few past samples), and prediction is over a window
    instead of one step. The model gives ``a_matrix`` to ``d_matrix`` at rest: the regulator designed on it has a
    control score (:func:`harness.scoring.control_score`), and ``predictive-control`` acts on the model itself. Needs
    torch for the fit (extra ``learned``); the model runs with numpy.

    Parameters
    ----------
    latent : int
        Numbers of the latent state.
    lags : int
        Samples that the encoder looks at: two at least where outputs are positions.
    hidden : int
        Units of each network.
    window : int
        Samples of a training window.
    """

    latent: int = 4
    lags: int = 4
    hidden: int = 16
    window: int = 15
    _: KW_ONLY
    steps: int = 1000
    rate: float = 3e-3
    batch: int = 96

    @told
    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> LatentModel:
        """Return the model; held-out losses stand in its notes."""
        what = "embed-to-control"
        self.check_numbers(what, "latent", "lags", "hidden", "window")
        records, spec = self.asked(trajectories, samples=self.lags + 3 * self.window, what=what, inputs=True)
        if spec.feedthrough:
            raise FitError(
                f"{what}: feedthrough",
                expected="outputs that an input changes one sample later",
                got=str(spec),
                remedy="use neural-state-space or neural-output-error",
            )
        need_torch(what)
        (u_mean, u_std), (y_mean, y_std) = (
            centred([record.u for record in records]),
            centred([record.y for record in records]),
        )
        scaled = [((record.y - y_mean) / y_std, (record.u - u_mean) / u_std) for record in records]
        learn, held = _split(scaled)
        start = self._start(learn, spec, rng)
        parts, held_parts = _windows(learn, self.lags, self.window), _windows(held, self.lags, self.window)

        def miss(library: Any, t: dict[str, Any], past: Any, u: Any, y: Any) -> Any:
            """Return the loss of windows: pasts (w, k, p), inputs (w, k, nu) and outputs (w, k, ny)."""
            seen = _encoded(library, t, past)
            total = ((_decoded(library, t, seen) - y) ** 2).mean()
            z, far = seen[:, 0], 0.0
            for k in range(u.shape[1] - 1):
                z = _ahead(library, t, z, u[:, k])
                far = far + ((_decoded(library, t, z) - y[:, k + 1]) ** 2).mean()
                far = far + _CONSISTENCY * ((z - seen[:, k + 1]) ** 2).mean()
            return total + far / (u.shape[1] - 1)

        first = {name: start[name] for name in _TABLES}
        tables, losses = train_tables(what, first, miss, parts, held_parts, self, rng=rng)
        rest = np.mean([_encoded(np, tables, _pasts(y, u, self.lags)).mean(axis=0) for y, u in scaled], axis=0)
        notes = {"held-out loss": losses, "windows": len(parts[0])}
        gain = np.zeros((self.latent, spec.ny))
        draft = LatentModel(spec, tables, self.lags, u_mean, u_std, y_mean, y_std, rest, gain, notes)
        c = draft.c_matrix / y_std[:, None]
        gains = riccati_gains(draft.a_matrix, c, np.ones(self.latent), np.ones(spec.ny))
        begin = [draft.initial_state(record[:40]) for record in records]
        gain = best_gain(gains / y_std, draft.step, draft.output, begin, records) * y_std
        return replace(draft, filter_gain=gain)

    def _start(
        self, learn: Sequence[tuple[FloatArray, FloatArray]], spec: PlantSpec, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """Return the tables of the linear latent model, and networks that add next to nothing."""
        ny, nu, nz, h = spec.ny, spec.nu, self.latent, self.hidden
        pasts = [_pasts(y, u, self.lags) for y, u in learn]
        # Directions of the past that foretell what comes: those of the regression of the future, not of its power.
        ahead = [np.hstack([y[self.lags + i : len(y) - 3 + i] for i in range(3)]) for y, _ in learn]
        rows = np.concatenate([past[: len(future)] for past, future in zip(pasts, ahead, strict=True)])
        future = np.concatenate(ahead)
        gram = rows.T @ rows + 1e-6 * len(rows) * np.eye(rows.shape[1])
        weights = np.linalg.solve(gram, rows.T @ future)
        _, values, vectors = np.linalg.svd(rows @ weights, full_matrices=False)
        if values[min(nz, len(values)) - 1] <= 1e-9 * values[0] or len(values) < nz:
            raise FitError(
                "embed-to-control: latent state",
                expected=f"records in which {nz} directions move",
                got=f"{int(np.sum(values > 1e-9 * values[0]))}",
                remedy="lower latent, or raise lags",
            )
        encoder = weights @ vectors[:nz].T
        z = [past @ encoder for past in pasts]
        encoder /= np.concatenate(z).std(axis=0)
        z = [past @ encoder for past in pasts]
        now = np.concatenate([np.hstack([s[:-1], u[self.lags - 1 : -1]]) for s, (_, u) in zip(z, learn, strict=True)])
        change = np.concatenate([np.diff(s, axis=0) for s in z])
        both = np.linalg.lstsq(now, change, rcond=None)[0]
        seen = np.concatenate([y[self.lags - 1 :] for y, _ in learn])
        tables = {
            "encoder": encoder,
            "A": both[:nz],
            "B": both[nz:],
            "offset": np.zeros(nz),
            "C": np.linalg.lstsq(np.concatenate(z), seen, rcond=None)[0],
            "centre": np.zeros(ny),
        }
        shapes = {"encode": (rows.shape[1], nz), "decode": (nz, ny)}
        for name, (inside, outside) in shapes.items():
            tables[f"{name}_in"] = rng.normal(size=(inside, h)) / np.sqrt(inside)
            tables[f"{name}_bias"] = np.zeros(h)
            tables[f"{name}_out"] = _NETWORK * rng.normal(size=(h, outside))
        tables["local_in"], tables["local_bias"] = rng.normal(size=(nz, h)) / np.sqrt(nz), np.zeros(h)
        for name, width in (("turn", nz), ("look", nz), ("push", nu * nz), ("drift", nz)):
            tables[name] = _NETWORK * rng.normal(size=(h, width))
        return tables


# ---- one definition for numpy, which runs, and torch, which trains ---------------------------------------------------


def _encoded(library: Any, t: dict[str, Any], past: Any) -> Any:
    """Return the latent states (..., nz) of past outputs and inputs (..., p)."""
    hidden = library.tanh(past @ t["encode_in"] + t["encode_bias"])
    return past @ t["encoder"] + hidden @ t["encode_out"]


def _decoded(library: Any, t: dict[str, Any], z: Any) -> Any:
    """Return the outputs (..., ny)."""
    return z @ t["C"] + t["centre"] + library.tanh(z @ t["decode_in"] + t["decode_bias"]) @ t["decode_out"]


def _ahead(library: Any, t: dict[str, Any], z: Any, u: Any) -> Any:
    """Return the next latent states (..., nz)."""
    hidden = library.tanh(z @ t["local_in"] + t["local_bias"])
    turned = (z * (hidden @ t["look"])).sum(-1)[..., None] * (hidden @ t["turn"])
    pushes = (hidden @ t["push"]).reshape(*z.shape[:-1], u.shape[-1], z.shape[-1])
    pushed = u @ t["B"] + (u[..., None] * pushes).sum(-2)
    return z + z @ t["A"] + turned + pushed + t["offset"] + hidden @ t["drift"]


# ---- windows ---------------------------------------------------------------------------------------------------------


def _pasts(y: FloatArray, u: FloatArray, lags: int) -> FloatArray:
    """Return the rows [y[k], ..., y[k-lags+1], u[k-1], ..., u[k-lags+1]] for k = lags - 1 .. N - 1."""
    n = len(y) - lags + 1
    outputs = [y[lags - 1 - j : lags - 1 - j + n] for j in range(lags)]
    inputs = [u[lags - 1 - j : lags - 1 - j + n] for j in range(1, lags)]
    return np.hstack([*outputs, *inputs])


def _split(
    scaled: Sequence[tuple[FloatArray, FloatArray]],
) -> tuple[list[tuple[FloatArray, FloatArray]], list[tuple[FloatArray, FloatArray]]]:
    """Return records to learn from and held out: every fifth record, or the ends where there are fewer than five."""
    if len(scaled) >= _HELD_OUT:
        held = [pair for number, pair in enumerate(scaled) if number % _HELD_OUT == _HELD_OUT - 1]
        return [pair for number, pair in enumerate(scaled) if number % _HELD_OUT != _HELD_OUT - 1], held
    cuts = [len(y) - len(y) // 3 for y, _ in scaled]
    learn = [(y[:cut], u[:cut]) for (y, u), cut in zip(scaled, cuts, strict=True)]
    return learn, [(y[cut:], u[cut:]) for (y, u), cut in zip(scaled, cuts, strict=True)]


def _windows(
    parts: Sequence[tuple[FloatArray, FloatArray]], lags: int, length: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pasts (w, k, p), inputs (w, k, nu) and outputs (w, k, ny) of windows within records."""
    k = min(length, min(len(y) for y, _ in parts) - lags)
    pasts, inputs, outputs = [], [], []
    for y, u in parts:
        past = _pasts(y, u, lags)
        for low in range(len(past) - k):
            pasts.append(past[low : low + k])
            inputs.append(u[low + lags - 1 : low + lags - 1 + k])
            outputs.append(y[low + lags - 1 : low + lags - 1 + k])
    return np.array(pasts), np.array(inputs), np.array(outputs)
