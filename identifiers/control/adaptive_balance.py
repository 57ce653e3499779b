"""An underactuated plant that is balanced or moved while its parameters are learned, against fixed controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from harness.algebra import runge_kutta
from harness.errors import FitError, InputError, PlantError
from harness.models.analysis import Findings, Takes
from harness.models.lqr import lqr_gain
from harness.signals import FloatArray, PlantSpec
from identifiers.online.filters_online import FilterState, OnlineGreyBox, Stepper, ekf

ADAPTIVE, FIXED, INFORMED = "adaptive", "fixed", "informed"

_SHORTEST = 50  # Samples of a run at least.

_SAID = {0: "neither", 1: "fixed only", 2: "adaptive only", 3: "both"}
"""What stays up at a place of the map: fixed counts 1, adaptive 2."""


@dataclass(frozen=True)
class AdaptiveBalance:
    """A mechanism with fewer motors than joints, balanced by an LQR that is designed anew while parameters are learned.

    Positions are measured with noise. An extended Kalman filter estimates states and parameters together (Ljung 1979,
    *IEEE Trans. Autom. Control* 24:36); every few samples the mechanism with the parameters of that moment is
    linearised at the target, and its LQR acts on the estimated state as if both were true (certainty equivalence:
    Astrom & Wittenmark 1995, *Adaptive Control*, sec. 1.4). Beside it, with the same noise: ``fixed``, the same filter
    and LQR with the parameters that are believed, which learn nothing; and ``informed``, with the true parameters. The
    cost is ``sum (x - x*)' q (x - x*) + u' r u`` of the true state. A map says from which starts and for how large a
    part of the error in the parameters each stays up.

    Parameters
    ----------
    model : str
        Name of the mechanism, with the outputs of the plant.
    believed : mapping
        Parameters that are believed; needed. Where one is positive the map interpolates its logarithm.
    learn : sequence of str, optional
        Parameters that are learned; by default those that are believed.
    target : mapping
        State to be held, by name, 0 for the others; an equilibrium under zero input.
    move : mapping
        States of the target that change after half of the run, by name.
    lean : str
        State that departs from the target at the start; also the one by which a fall is told.
    start : float
        Its departure.
    fall : float
        Departure at which the run counts as fallen.
    leans, shares : sequence of float
        Of the map: departures at the start, and parts of the error in the parameters (1: what is believed).
    duration : float
        Of a run [s].
    every : int
        Samples between two designs.
    noise : float
        Standard deviation of the sensors, in the unit of each output.
    doubt : float
        Relative standard deviation of the parameters at the start.
    q, r : float or sequence
        Weights of states and inputs: one number, or one each.
    """

    takes: ClassVar[Takes] = "maker"
    model: str = "cart-pole"
    believed: dict[str, float] = field(default_factory=dict)
    learn: Sequence[str] = ()
    target: dict[str, float] = field(default_factory=dict)
    move: dict[str, float] = field(default_factory=dict)
    lean: str = "theta"
    start: float = 0.1
    fall: float = 1.2
    leans: Sequence[float] = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
    shares: Sequence[float] = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    duration: float = 6.0
    every: int = 5
    noise: float = 1e-3
    doubt: float = 0.5
    q: float | Sequence[float] = 1.0
    r: float | Sequence[float] = 1.0

    def of(self, subject: Any, *, rng: np.random.Generator) -> Findings:
        """Return what every controller costs, where the parameters go, and the map of what stays up."""
        if not self.believed or min(self.duration, self.fall, self.doubt) <= 0 or self.every < 1 or self.noise < 0:
            raise InputError(
                "adaptive-balance",
                expected="believed parameters, duration, fall and doubt above 0, every of at least 1, noise at least 0",
                got=f"believed={self.believed}, duration={self.duration}, fall={self.fall}, doubt={self.doubt}, "
                f"every={self.every}, noise={self.noise}",
                remedy="say what is believed, such as -O 'believed={l=0.3}'",
            )
        with subject() as plant:
            bench = _Bench(self, plant, int(rng.integers(2**62)))
            runs = {name: bench.run(name, 1.0, self.start) for name in (FIXED, ADAPTIVE, INFORMED)}
            maps = {name: np.array([[bench.run(name, share, lean).stayed for share in self.shares]
                                    for lean in self.leans]) for name in (FIXED, ADAPTIVE)}  # fmt: skip
        return _findings(self, bench, runs, maps)


@dataclass(frozen=True, eq=False)
class _Run:
    """States (n, nx), inputs (n, nu), estimated parameters (n, k), cost; shorter where it fell."""

    states: FloatArray
    inputs: FloatArray
    parameters: FloatArray
    cost: float
    stayed: bool


class _Bench:
    """The plant, and controllers of it that know more or less."""

    def __init__(self, options: AdaptiveBalance, plant: Any, seed: int) -> None:
        from harness.physics.models.catalogue import load_model

        self.options, self.plant, self.spec, self.seed = options, plant, plant.spec, seed
        self.system = load_model(options.model)
        names = [channel.name for channel in self.system.states]
        known = self.system.parameter_names
        self.learned = tuple(options.learn or options.believed)
        outputs, own = ([channel.name for channel in side] for side in (self.spec.outputs, self.system.outputs))
        seen = [channel.name for channel in self.spec.states][: len(names)]
        wrong = sorted({*options.target, *options.move, options.lean} - set(names))
        wrong += sorted({*options.believed, *self.learned} - set(known))
        if wrong or outputs != own or seen != names or "truth" not in plant.abilities:
            raise InputError(
                "adaptive-balance: model and plant",
                expected=f"states among {', '.join(names)}, parameters among {', '.join(known)}, outputs "
                f"{', '.join(own)}, and a plant that tells its true states",
                got=f"{', '.join(wrong) or 'known names'}; outputs {', '.join(outputs)}; states {', '.join(seen)}",
                remedy="give the model of this plant",
            )
        self.count = round(options.duration / self.spec.sample_time)
        if self.count < _SHORTEST:
            raise InputError(
                "adaptive-balance", expected=f"at least {_SHORTEST} samples", got=str(self.count), remedy="run longer"
            )
        self.names, self.place = names, names.index(options.lean)
        self.true = {name: float(plant.true_parameters[name]) for name in known}
        target = np.array([float(options.target.get(name, 0.0)) for name in names])
        moved = np.array([float({**options.target, **options.move}.get(name, 0.0)) for name in names])
        late = np.arange(self.count)[:, None] >= self.count // 2
        self.targets = np.where(late, moved, target)
        self.q = np.diag(np.broadcast_to(np.asarray(options.q, dtype=float), (len(names),)))
        self.r = np.diag(np.broadcast_to(np.asarray(options.r, dtype=float), (self.spec.nu,)))
        self.low = np.array([channel.minimum for channel in self.spec.inputs])
        self.high = np.array([channel.maximum for channel in self.spec.inputs])
        self.fixed = tuple(name for name in known if name not in self.learned)
        self.filters: dict[tuple[str, float], tuple[OnlineGreyBox, FilterState]] = {}
        self.slopes = self._slopes()

    def believed(self, share: float) -> dict[str, float]:
        """Return the parameters with a part of the error: 0 are the true ones, 1 those that are believed."""
        found = dict(self.true)
        for name, value in self.options.believed.items():
            true = self.true[name]
            ratio = value / true if true else -1.0
            found[name] = true * ratio**share if ratio > 0 else true + share * (value - true)
        return found

    def run(self, kind: str, share: float, lean: float) -> _Run:
        """Return a run of one controller."""
        options, n = self.options, len(self.names)
        values = self.true if kind == INFORMED else self.believed(share)
        online, begun = self._filter(kind, share, values)
        rng = np.random.default_rng([self.seed, round(1e6 * abs(lean))])
        x0 = dict(zip(self.names, self.targets[0].tolist(), strict=True))
        x0[options.lean] += lean
        y = np.asarray(self.plant.reset(rng=rng, x0=x0), dtype=float)
        gain = self._gain(values, self.targets[0])
        state: Any = None
        states, inputs, estimates = [], [], []
        cost, stayed = 0.0, True
        if gain is None:
            raise FitError(
                "adaptive-balance: no controller", expected="parameters that can be balanced", got="none",
                remedy="believe others",
            )  # fmt: skip
        u = np.zeros(self.spec.nu)
        for k in range(self.count):
            seen = y + options.noise * rng.normal(size=y.shape)
            if state is None:
                state = online.start(begun, seen)
            else:
                state = online.update(state, u, seen)
            if kind == ADAPTIVE and k % options.every == 0:
                new = self._gain(state.parameters, self.targets[k])
                gain = gain if new is None else new
            u = np.clip(-gain @ (state.mean[:n] - self.targets[k]), self.low, self.high)
            true = np.asarray(self.plant.truth(), dtype=float)[:n]
            away = true - self.targets[k]
            cost += float(away @ self.q @ away + u @ self.r @ u)
            states.append(true)
            inputs.append(u)
            estimates.append([state.parameters[name] for name in self.learned])
            if not (np.isfinite(u).all() and abs(away[self.place]) < options.fall):
                cost, stayed = np.inf, False
                break
            try:
                y = np.asarray(self.plant.step(u), dtype=float)
            except PlantError:
                cost, stayed = np.inf, False
                break
        return _Run(np.array(states), np.array(inputs), np.array(estimates), cost, stayed)

    def _filter(self, kind: str, share: float, values: Mapping[str, float]) -> tuple[OnlineGreyBox, FilterState]:
        """Return the filter of a controller before any data; what it compiled is kept for other starts."""
        if (kind, share) not in self.filters:
            fixed = self.fixed if kind == ADAPTIVE else tuple(self.true)
            online = ekf(self.options.model, start=values, fixed=fixed, doubt=self.options.doubt)
            spec = PlantSpec(self.spec.inputs, self.spec.outputs, self.spec.sample_time)
            self.filters[kind, share] = online, online.init(spec, rng=np.random.default_rng(0))
        return self.filters[kind, share]

    def _slopes(self) -> Any:
        """Return a function of state and parameters: slopes of a sample by state and input."""
        import casadi as ca

        system, steps = self.system, Stepper(self.system, self.spec.sample_time, tuple(self.true)).steps
        x, u, p = ca.SX.sym("x", system.nx), ca.SX.sym("u", system.nu), ca.SX.sym("p", len(self.true))
        f = ca.Function("f", [system.x, system.u, system.p, system.t], [system.upright(system.f)])
        h, now = self.spec.sample_time / steps, x
        for _ in range(steps):
            now = runge_kutta(lambda state: f(state, u, p, 0.0), now, h)
        return ca.Function("slopes", [x, u, p], [ca.jacobian(now, x), ca.jacobian(now, u)], {"cse": True})

    def _gain(self, parameters: Mapping[str, float], target: FloatArray) -> FloatArray | None:
        values = self.system.vector(dict(parameters))
        a, b = (one.full() for one in self.slopes(target, np.zeros(self.spec.nu), values))
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return None
        return lqr_gain(a, b, self.q, self.r)


def _findings(
    options: AdaptiveBalance, bench: _Bench, runs: Mapping[str, _Run], maps: Mapping[str, npt.NDArray[np.bool_]]
) -> Findings:
    """Return the table, what it means, and its picture."""
    true = np.array([bench.true[name] for name in bench.learned])
    scale = np.where(true != 0, np.abs(true), 1.0)
    rows = []
    for name, run in runs.items():
        off = np.sqrt(np.mean(((run.parameters[[0, -1]] - true) / scale) ** 2, axis=1))
        rows.append(
            {"controller": name, "stays": "yes" if run.stayed else "falls", "seconds": len(run.states) *
             bench.spec.sample_time, "cost": run.cost, "over informed": run.cost / runs[INFORMED].cost,
             "parameters off at first": float(off[0]), "at last": float(off[1]),
             **{f"{one} at last": float(value) for one, value in zip(bench.learned, run.parameters[-1], strict=True)}}
        )  # fmt: skip
    area = {name: float(np.mean(found)) for name, found in maps.items()}
    lost = int(np.sum(maps[FIXED] & ~maps[ADAPTIVE]))
    words = [
        f"cost {runs[ADAPTIVE].cost:.4g} adaptive, {runs[FIXED].cost:.4g} with what is believed, "
        f"{runs[INFORMED].cost:.4g} with the true parameters",
        f"of {maps[FIXED].size} starts and errors {maps[ADAPTIVE].sum()} stay up adaptive, {maps[FIXED].sum()} fixed; "
        f"{lost} only fixed",
    ]

    def draw() -> Any:
        from matplotlib.colors import BoundaryNorm, ListedColormap
        from matplotlib.figure import Figure

        figure = Figure(figsize=(12, 3.8), layout="constrained")
        motion, learned, region = figure.subplots(1, 3)
        colours = {FIXED: "C3", ADAPTIVE: "C2", INFORMED: "0.4"}
        times = np.arange(bench.count) * bench.spec.sample_time
        channel = bench.system.states[bench.place]
        for name, run in runs.items():
            away = run.states[:, bench.place] - bench.targets[: len(run.states), bench.place]
            motion.plot(times[: len(away)], away, color=colours[name], label=name)
        motion.set(xlabel="time [s]", ylabel=f"{channel.name} from target [{channel.unit}]", title="from one start")
        motion.legend(fontsize=8)
        found = runs[ADAPTIVE].parameters
        for column, one in enumerate(bench.learned):
            learned.plot(times[: len(found)], found[:, column] / scale[column], label=one)
        learned.axhline(1.0, color="k", lw=0.8, ls="--")
        learned.set(xlabel="time [s]", ylabel="estimate / true value", title="what is learned")
        learned.legend(fontsize=8)
        both = maps[FIXED].astype(int) + 2 * maps[ADAPTIVE].astype(int)
        shades = ListedColormap(["0.85", "C3", "C2", "C0"])
        drawn = region.imshow(both, origin="lower", aspect="auto", cmap=shades, norm=BoundaryNorm([0, 1, 2, 3, 4], 4))
        region.set(xticks=range(len(options.shares)), yticks=range(len(options.leans)), xlabel="part of the error in "
                   "the parameters", ylabel=f"{channel.name} at the start [{channel.unit}]",
                   title="what stays up")  # fmt: skip
        region.set_xticklabels([f"{one:g}" for one in options.shares])
        region.set_yticklabels([f"{one:g}" for one in options.leans])
        bar = figure.colorbar(drawn, ax=region, ticks=[0.5, 1.5, 2.5, 3.5])
        bar.ax.set_yticklabels([_SAID[k] for k in range(4)])
        return figure

    stays = {name: run.stayed for name, run in runs.items()}
    details = {
        "costs": {name: run.cost for name, run in runs.items()}, "stays": stays,
        "maps": {name: found.tolist() for name, found in maps.items()}, "area": area,
        "parameters": runs[ADAPTIVE].parameters, "states": {name: run.states.tolist() for name, run in runs.items()},
    }  # fmt: skip
    return Findings("balance while parameters are learned", rows, words, details, draw)
