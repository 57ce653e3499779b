"""The experiment that would separate a tie: a scenario that can be run, its options computed from the fitted model."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.diagnosis.policy import DATA_POLICY, PLAN_POLICY
from harness.diagnosis.systems import AnySystem, by_equations
from harness.effects.effect import Placed
from harness.signals import Dataset, FloatArray
from harness.units import base_units

SPEEDS = ({"rad": 1.0, "s": -1.0}, {"m": 1.0, "s": -1.0})
"""Units of what may be the speed of a motion, in base units."""


def undeclared_motion(system: AnySystem) -> str:
    """Return which speeds that inputs drive are declared as no motion, in words; nothing where there are none.

    Examples
    --------
    >>> from harness.physics import Ode
    >>> o = Ode("motor", x="i w", u="v", p="R L K J", units={"i": "A", "w": "rad/s"})
    >>> (i, w), (v,), (R, L, K, J) = o.x, o.u, o.p
    >>> o.rhs = [(v - R * i - K * w) / L, K * i / J]
    >>> undeclared_motion(o.system())[:37]
    'w [rad/s] is driven as a speed is, bu'
    """
    if not by_equations(system):
        return ""
    import casadi as ca

    first = 2 * len(system.coordinates)
    own, pushed = (np.array(ca.DM(ca.jacobian(system.rates, by).sparsity(), 1)) for by in (system.x, system.u))
    driven = np.any(pushed, axis=1)
    for _ in range(driven.size):
        driven |= np.any(own[:, first:] * driven, axis=1)
    states = zip(system.states[first:], driven, strict=True)
    found = [c for c, moved in states if moved and c.name not in system.process and base_units(c.unit)[0] in SPEEDS]
    if not found:
        return ""
    return (
        f"{', '.join(f'{c.name} [{c.unit}]' for c in found)} {'is' if len(found) == 1 else 'are'} driven as a speed "
        "is, but declared as no motion, so that no law of a joint (friction, backlash, a payload) was tried there: "
        f'declare motions={{"NAME": ("{found[0].name}", INERTIA)}}, in equations as text \'motion NAME: '
        f"{found[0].name}, INERTIA'"
    )


@dataclass(frozen=True)
class Bench:
    """What is known of the plant when an experiment is planned: the fitted model, and the data it was fitted to."""

    nominal: AnySystem
    system: AnySystem
    values: Mapping[str, float]
    dataset: Dataset

    @property
    def sample_time(self) -> float:
        """Of the data [s]."""
        return self.dataset.spec.sample_time

    @property
    def peaks(self) -> FloatArray:
        """Return the largest excursion of each input about its mean in the data (nu,)."""
        u = np.concatenate([run.u for run in self.dataset.estimation])
        return np.asarray(np.abs(u - u.mean(axis=0)).max(axis=0), dtype=float)

    @functools.cached_property
    def poles(self) -> list[FloatArray]:
        """Return the poles of the nominal model [1/s] at some states along the data.

        Of the nominal model: dry friction near standstill hides the resonance.
        """
        import casadi as ca

        from harness.physics.compiled.windows import data_states

        system = self.nominal
        assert by_equations(system)
        p = system.vector({name: self.values[name] for name in system.parameter_names})
        simulator = system.simulator(self.sample_time, intersample=self.dataset.intersample, backend="casadi")
        states = np.concatenate([data_states(simulator, run, p)[0] for run in self.dataset.estimation])
        states = states[np.isfinite(states).all(axis=1)]
        u = np.mean(np.concatenate([run.u for run in self.dataset.estimation]), axis=0)
        jacobian = ca.Function("A", [system.x, system.u, system.p, system.t], [ca.jacobian(system.f, system.x)])
        some = states[:: max(len(states) // 60, 1)]
        return [np.linalg.eigvals(np.array(jacobian(point, u, p, 0.0), dtype=float)) for point in some]

    def resonance(self) -> float:
        """Return the fastest oscillation of the nominal model, typical for where it was operated [Hz]."""
        fastest = []
        for poles in self.poles:
            swinging = np.abs(poles[np.abs(poles.imag) > 0.3 * np.abs(poles)])
            fastest.append(swinging.max() if swinging.size else np.abs(poles).max())
        rates = [rate for rate in fastest if 0 < rate < 0.5 * np.pi / self.sample_time]
        return float(np.median(rates)) / (2 * np.pi) if rates else 0.02 / self.sample_time

    def slowest(self) -> float:
        """Return the longest time constant of the nominal model, typical for where it was operated [s]; 0 if none.

        What integrates has none: a pole of next to nothing.
        """
        sizes = [np.abs(poles) for poles in self.poles]
        rates = [size[size > DATA_POLICY.integrates * size.max()].min() for size in sizes if size.max(initial=0.0) > 0]
        return 1.0 / float(np.median(rates)) if rates else 0.0

    def moves(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the largest and the rms excursion of the coordinates, and of their rates, under an input (N, nu).

        Both are arrays (2, n): largest, rms. Infinite where the model cannot follow. The model starts at rest.
        """
        system = self.system
        assert by_equations(system)
        with np.errstate(all="ignore"):
            x = self._simulator.states(system.vector(self.values), np.zeros(system.nx), u)
        sizes = []
        for names in (
            [coordinate.q for coordinate in system.coordinates],
            [coordinate.v for coordinate in system.coordinates],
        ):
            z = x[:, names] if names else x
            z = z if np.isfinite(z).all() else np.full_like(z, np.inf)
            sizes.append(np.stack([np.abs(z).max(axis=0), np.sqrt(np.mean(z**2, axis=0))]))
        return sizes[0], sizes[1]

    @functools.cached_property
    def seen(self) -> tuple[FloatArray, FloatArray]:
        """The same for the inputs of the data."""
        return self.moves(max(self.dataset.estimation, key=len).u)

    @functools.cached_property
    def _simulator(self) -> Any:
        """What simulates the fitted model: planning asks for many runs of it."""
        assert by_equations(self.system)
        return self.system.simulator(self.sample_time, intersample=self.dataset.intersample)


def separating(members: Sequence[Placed]) -> list[str]:
    """Return in words the experiments that would separate the members of a tie set, each once."""
    texts = [f"{placed.effect.name}: {placed.effect.experiment}" for placed in members if placed.effect.experiment]
    return list(dict.fromkeys(texts))


def separate_with(bench: Bench, members: Sequence[Sequence[Placed]]) -> list[dict[str, Any]]:
    """Return the experiments that would tell the members of a tie set apart.

    - ``members`` sequence of (effects): the tie set, the answer first
    - returns ``separates`` (names of the members), ``why``; and either ``scenario``, ``options`` and ``command``, or an
      ``instruction`` where no input can do it
    """
    laws = {placed.effect.name: placed.effect for member in members for placed in member}
    if len(members) < 2:
        return []
    rows = []
    for experiment, why, plan in _RULES:
        apart = [name for name, law in laws.items() if experiment in law.told_by]
        if len(apart) < 2:
            continue
        row: dict[str, Any] = {"separates": apart, "why": why, "scenario": None, "options": {}, "command": None,
                               "instruction": None}  # fmt: skip
        if isinstance(plan, str):
            row["instruction"] = plan
        elif not bench.dataset.spec.inputs:
            row["instruction"] = "no input of this plant is recorded: move it by hand as said"
        elif not by_equations(bench.nominal):
            row["instruction"] = "the model has no equations to plan with: choose the amplitudes by hand"
        else:
            scenario, options, more = plan(bench, members)
            row.update(scenario=scenario, options=options, command=_command(scenario, options), instruction=more)
        rows.append(row)
    return rows


_Plan = Callable[[Bench, Sequence[Sequence[Placed]]], tuple[str, dict[str, Any], str | None]]


def _slow_triangle(bench: Bench, members: Sequence[Sequence[Placed]]) -> tuple[str, dict[str, Any], str | None]:
    """Plan a triangle of an eighth of the resonance at three amplitudes, its swing within what the data show."""
    seen, _ = bench.seen
    angles = np.array([coordinate.unit == "rad" for coordinate in bench.system.coordinates], dtype=bool)
    most = np.where(angles, np.minimum(seen[0], PLAN_POLICY.upright), seen[0]) if angles.size else seen[0]
    frequency = bench.resonance() / 8
    wave = _triangle(int(PLAN_POLICY.periods / frequency / bench.sample_time), bench.sample_time, frequency)
    peaks = bench.peaks
    for _ in range(12):
        if np.all(bench.moves(wave * peaks)[0][0] <= most):
            break
        peaks = 0.75 * peaks
    options = {**_amplitude(bench, peaks), "frequency": _two(frequency), "levels": 3}
    return "triangle", {**options, "duration": _duration(bench, PLAN_POLICY.periods / frequency)}, None


def _chirp(bench: Bench, members: Sequence[Sequence[Placed]]) -> tuple[str, dict[str, Any], str | None]:
    """Plan a chirp up to 5/tau, tau being the longest delay or time constant of the tie set that was fitted.

    So far above its resonance a plant hardly moves, so that four times the data's amplitude does no harm.
    """
    times = [
        abs(bench.values[name])
        for member in members
        for placed in member
        for parameter in placed.effect.parameters
        if parameter.unit == "s" and (name := placed.name(parameter.name)) in bench.values
    ]
    tau = max([time for time in times if time > 0], default=2 * bench.sample_time)
    top = float(np.clip(5 / (2 * np.pi * tau), 2 * bench.resonance(), 0.4 / bench.sample_time))
    options = {**_amplitude(bench, 4 * bench.peaks), "band": [_two(0.1 * top), _two(top)], "law": "logarithmic"}
    return "chirp", {**options, "duration": _duration(bench)}, None


def _swing(target: float) -> _Plan:
    """Plan sweeps about the resonance, just strong enough to reach an angle (or twice the data's range)."""

    def plan(bench: Bench, members: Sequence[Sequence[Placed]]) -> tuple[str, dict[str, Any], str | None]:
        seen, _ = bench.seen
        angles = np.array([coordinate.unit == "rad" for coordinate in bench.system.coordinates], dtype=bool)
        wanted = np.where(angles, target, 2 * seen[0]) if angles.size else 2 * seen[0]
        centre, dt = bench.resonance(), bench.sample_time
        band = [_two(0.3 * centre), _two(1.5 * centre)]
        seconds = _duration(bench)
        t = np.arange(round(seconds / dt)) * dt
        sweep = np.sin(2 * np.pi * (band[0] * t + 0.5 * (band[1] - band[0]) / seconds * t**2))
        for factor in np.geomspace(0.5, PLAN_POLICY.stronger, 19):
            reached, _ = bench.moves(sweep[:, None] * factor * bench.peaks)
            if np.all(reached[0] >= wanted):
                break
        options = {**_amplitude(bench, factor * bench.peaks), "band": band, "duration": _duration(bench)}
        return "chirp", options, f"the swing must pass {np.degrees(target):.0f} deg" if angles.any() else None

    return plan


def _reversals(bench: Bench, members: Sequence[Sequence[Placed]]) -> tuple[str, dict[str, Any], str | None]:
    """Plan small reversals: a triangle at a quarter of the resonance, a third of the data's amplitude at most."""
    frequency = bench.resonance() / 4
    options = {**_amplitude(bench, bench.peaks / 3), "frequency": _two(frequency), "levels": 3}
    return (
        "triangle",
        {**options, "duration": _duration(bench, 15 / frequency)},
        "add a sensor on the load's side if you can",
    )


def _rest(bench: Bench, members: Sequence[Sequence[Placed]]) -> tuple[str, dict[str, Any], str | None]:
    """Plan a run without excitation."""
    return "free-swing", {"duration": _duration(bench), "spread": 0.0}, None


_RULES: tuple[tuple[str, str, _Plan | str], ...] = (
    ("slow motion", "slow motion through standstill: the laws of friction differ there, at speed they are alike",
     _slow_triangle),
    ("chirp", "a lag loses amplitude at 5/tau, a delay does not; a rate limit grows with amplitude", _chirp),
    ("turned base", "gravity turns with the base, a zero of a sensor does not",
     "turn the base by a known angle and record again: no input of the joint can do this"),
    ("large swing", "gravity makes a constant force differ from a turned zero only at large angles",
     _swing(np.radians(75.0))),
    ("full swing", "springs are alike at small angles; beyond 90 deg gravity turns back and a spring does not",
     _swing(np.radians(100.0))),
    ("small reversals", "small reversals: play opens, an elastic joint does not", _reversals),
    ("fast swing", "the decay of large swings: drag needs speed", _swing(np.radians(75.0))),
    ("rest", "without excitation a line in time stays, one in the angle goes", _rest),
    ("added mass", "a mass is known on a scale only", "record again with a known added mass"),
)  # fmt: skip
"""For each kind of experiment (``Effect.told_by``) why it tells laws apart, and how it is planned."""


def _triangle(n: int, dt: float, frequency: float) -> FloatArray:
    """Return a plain triangle (n, 1) from 0, of peak 1."""
    phase = np.arange(n) * dt * frequency
    return np.asarray((np.abs((4 * phase - 1) % 4 - 2) - 1)[:, None], dtype=float)


def _amplitude(bench: Bench, sizes: FloatArray) -> dict[str, Any]:
    """Return the option ``amplitude``, within the declared limits of the inputs; a table where there are several."""
    channels = bench.dataset.spec.inputs
    limits = [0.5 * (channel.maximum - channel.minimum) for channel in channels]
    kept = [_two(float(min(size, limit))) for size, limit in zip(sizes, limits, strict=True)]
    if len(kept) == 1:
        return {"amplitude": kept[0]}
    return {"amplitude": {channel.name: size for channel, size in zip(channels, kept, strict=True)}}


def _duration(bench: Bench, seconds: float = 0.0) -> float:
    """Return whole seconds, between the shortest and the longest of a plant that is sampled and answers so fast."""
    plan = PLAN_POLICY
    needed = max(plan.rows * bench.sample_time, plan.settled * bench.slowest())
    least = max(plan.shortest, float(np.ceil(needed)))
    return float(np.clip(np.ceil(seconds), least, max(plan.longest, 3 * least)))


def _two(value: float) -> float:
    """Return a number in two digits, as a person would set it."""
    return float(f"{value:.2g}")


def _command(scenario: str, options: Mapping[str, Any]) -> str:
    """Return the command line that runs the scenario on a plant."""
    words = [f"sysid simulate PLANT --scenario {scenario}"]
    for key, value in options.items():
        if isinstance(value, Mapping):
            words += [f"-S {key}.{name}={number:g}" for name, number in value.items()]
        elif isinstance(value, list):
            words.append(f"-S '{key}=[{', '.join(f'{number:g}' for number in value)}]'")
        else:
            words.append(f"-S {key}={value if isinstance(value, str) else format(value, 'g')}")
    return " ".join([*words, "-o separate.csv"])
