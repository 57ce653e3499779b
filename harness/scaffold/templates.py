"""Sources of new plug-ins: each is whole, works, and passes ``sysid check``; NAME, CLASS and MODULE are filled in."""

from __future__ import annotations

IDENTIFIER = '''"""CLASS: an identifier for sysid-harness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from harness.errors import FitError
from harness.judgement import refuse_law
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory


@dataclass(frozen=True)
class CLASS:
    """Least squares on the present output and input: y+ = A y + B u + c (replace this by your method).

    Parameters
    ----------
    ridge : float
        Added to the diagonal of the normal equations, relative to their mean.
    """

    ridge: float = 1e-9

    def fit(self, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> CLASSModel:
        """Return a model; nothing is paired across two records."""
        if not trajectories:
            raise FitError("no records", expected="at least one", got="none", remedy="record something")
        spec = trajectories[0].spec
        if any(one.spec != spec for one in trajectories):
            raise FitError("records of different plants", expected=str(spec), got="another", remedy="separate them")
        if any(channel.kind != "real" for channel in (*spec.inputs, *spec.outputs)):
            raise FitError("categories", expected="real signals", got="others", remedy="choose mdp-counting")
        refuse_law(trajectories, "NAME")  # under a controller alone many plants give the same records
        rows = [np.hstack([one.y[:-1], one.u[:-1], np.ones((len(one) - 1, 1))]) for one in trajectories if len(one) > 1]
        needed = spec.ny + spec.nu + 2
        if sum(map(len, rows)) < needed:
            raise FitError("too few samples", expected=f"{needed} or more", got="fewer", remedy="record longer")
        past = np.vstack(rows)
        following = np.vstack([one.y[1:] for one in trajectories if len(one) > 1])
        scale = np.maximum(np.abs(past).max(axis=0), 1e-300)  # units must not matter
        scaled = past / scale
        gram = scaled.T @ scaled
        gram += self.ridge * np.trace(gram) / len(gram) * np.eye(len(gram))
        solution = np.linalg.solve(gram, scaled.T @ following) / scale[:, None]
        return CLASSModel(PlantSpec(spec.inputs, spec.outputs, spec.sample_time), solution)


@dataclass(frozen=True, eq=False)
class CLASSModel:
    """What CLASS learned; its state is the output."""

    spec: PlantSpec
    solution: FloatArray
    burn_in: int = 1

    def initial_state(self, data: Trajectory) -> FloatArray:
        """Return the state at the first sample."""
        return np.array(data.y[0], dtype=float)

    def output(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the output of a state."""
        return np.array(x, dtype=float)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state; axes in front are a batch."""
        x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        one = np.ones((*x.shape[:-1], 1))
        return np.asarray(np.concatenate([x, u, one], axis=-1) @ self.solution)

    def correct(self, x: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
        """Return the state after an output was seen."""
        return np.broadcast_to(np.asarray(y, dtype=float), np.shape(x)).copy()

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON has it (infinite limits are null)."""

        def told(channel: Channel) -> dict[str, Any]:
            return {k: None if v in (np.inf, -np.inf) else v for k, v in asdict(channel).items()}

        return {
            "kind": "NAME",
            "inputs": [told(one) for one in self.spec.inputs],
            "outputs": [told(one) for one in self.spec.outputs],
            "sample_time": self.spec.sample_time,
            "solution": self.solution.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Return the model of a dictionary."""

        def channel(told: dict[str, Any]) -> Channel:
            low, high = told["minimum"], told["maximum"]
            limits = {"minimum": -np.inf if low is None else low, "maximum": np.inf if high is None else high}
            return Channel(**{**told, **limits})

        groups = [tuple(channel(one) for one in content[key]) for key in ("inputs", "outputs")]
        return cls(PlantSpec(groups[0], groups[1], content["sample_time"]), np.array(content["solution"]))
'''

PLANT = '''"""CLASS: a plant for sysid-harness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import numpy as np

from harness.errors import InputError, PlantError
from harness.protocols import Ability
from harness.signals import Channel, FloatArray, PlantSpec


class CLASS:
    """A mass on a spring, exactly discretized (replace this by your simulation).

    Parameters
    ----------
    mass, damping, stiffness : float
        In kg, N s/m, N/m.
    sample_time : float
        In s.
    """

    abilities: frozenset[Ability] = frozenset({"snapshots", "truth"})

    def __init__(
        self, *, mass: float = 1.0, damping: float = 0.4, stiffness: float = 9.0, sample_time: float = 0.02
    ) -> None:
        if min(mass, damping, stiffness, sample_time) <= 0:
            raise InputError("options", expected="positive numbers", got="others", remedy="correct them")
        self.spec = PlantSpec(
            (Channel("u", "N"),), (Channel("q", "m"),), sample_time, states=(Channel("q", "m"), Channel("v", "m/s"))
        )
        rates = np.array([[0.0, 1.0, 0.0], [-stiffness / mass, -damping / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
        whole = _exponential(rates * sample_time)  # with the input as a constant state: exact for a held input
        self._a, self._b = whole[:2, :2], whole[:2, 2:]
        self._x = np.zeros(2)

    def reset(self, *, rng: np.random.Generator, x0: Mapping[str, float] | None = None) -> FloatArray:
        """Start anew; returns y[0]."""
        start = dict(x0 or {})
        self._x = np.array([start.pop("q", 0.0), start.pop("v", 0.0)], dtype=float)
        if start:
            raise InputError("initial state", expected="q, v", got=", ".join(start), remedy="correct the names")
        return self._x[:1].copy()

    def step(self, u: FloatArray) -> FloatArray:
        """Hold u (1,) for one sample time; returns the next output (1,)."""
        u = np.asarray(u, dtype=float)
        if u.shape != (1,) or not np.isfinite(u).all():
            raise InputError("input", expected="shape (1,), finite", got=str(u), remedy="give one number")
        self._x = self._a @ self._x + self._b @ u
        if not np.isfinite(self._x).all():
            raise PlantError("the state is not finite", status="diverged")
        return self._x[:1].copy()

    def truth(self) -> FloatArray:
        """Return the true state (2,)."""
        return self._x.copy()

    def get_state(self) -> FloatArray:
        """Return a state that stays valid."""
        return self._x.copy()

    def set_state(self, state: FloatArray) -> None:
        """Go back to a state."""
        self._x = np.array(state, dtype=float)

    def close(self) -> None:
        """Release nothing: there is no engine."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _exponential(m: FloatArray) -> FloatArray:
    """Return the exponential of a small matrix: Taylor of a halved one, squared back."""
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(m).sum(axis=1).max(), 1e-12)))) + 4)
    small, result, term = m / 2.0**halvings, np.eye(len(m)), np.eye(len(m))
    for k in range(1, 14):
        term = term @ small / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return np.asarray(result)
'''

SCENARIO = '''"""CLASS: a scenario for sysid-harness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.errors import InputError
from harness.protocols import Experiment
from harness.rng import Streams
from harness.signals import PlantSpec


@dataclass(frozen=True, kw_only=True)
class CLASS:
    """Random steps on every input (replace this by your excitation).

    Parameters
    ----------
    duration : float
        Seconds.
    amplitude : float
        Half width of the steps, in the unit of each input.
    hold : float
        Seconds from step to step.
    """

    duration: float = 20.0
    amplitude: float = 0.5
    hold: float = 0.5

    def __post_init__(self) -> None:
        if min(self.duration, self.hold) <= 0:
            raise InputError("duration and hold", expected="positive", got="others", remedy="correct them")

    def prepare(self, spec: PlantSpec, *, streams: Streams, role: str) -> Experiment:
        """Return the experiment of one role; other roles draw other steps."""
        if any(channel.kind != "real" for channel in spec.inputs):
            raise InputError("inputs", expected="real inputs", got="others", remedy="choose random-policy")
        samples = max(2, round(self.duration / spec.sample_time))
        every = max(1, round(self.hold / spec.sample_time))
        rng = streams(f"{role}/excitation")
        levels = self.amplitude * rng.uniform(-1.0, 1.0, size=(samples // every + 1, spec.nu))
        low = np.array([channel.minimum for channel in spec.inputs])
        high = np.array([channel.maximum for channel in spec.inputs])
        return Experiment(np.clip(np.repeat(levels, every, axis=0)[:samples], low, high))
'''

EFFECT = '''"""FUNCTION: an effect for sysid-harness."""

from __future__ import annotations

from typing import Any

from harness.effects import effect, par
from harness.effects.functions import tanh


@effect(
    "coordinate",
    [
        # F, q, v, a in units and scales stand for force, position, rate and acceleration of the coordinate
        par("c", "F", scale="0.05 F", sign="+", main=True, neutral=0.0, linear=True, meaning="largest force"),
        par("w", "v", scale="0.3 v", sign="+", minimum=1e-9, nuisance=True, meaning="rate that nearly reaches it"),
    ],
    formula="F = -c tanh(v / w)",
    family=("coulomb_friction", "viscous_friction"),
    experiment="slow and fast motion in both directions",
)
def FUNCTION(f: Any, s: Any, p: Any, q: Any, v: Any) -> Any:
    """Friction that saturates with the rate (replace this by your law)."""
    return -p.c * tanh(v / p.w)
'''

MODEL = '''"""FUNCTION: a nominal model for sysid-harness."""

from __future__ import annotations

from sympy import cos, sin

from harness.physics import Mechanism


def FUNCTION() -> Mechanism:
    """Pendulum on a cart that a force pushes (replace this by your mechanism)."""
    made = Mechanism(
        "NAME",
        q="x theta",
        u="f",
        p="M m l b",
        parameters={"M": ("kg", 1.0), "m": ("kg", 0.2), "l": ("m", 0.5), "b": ("N s/m", 0.1)},
    )
    (x, theta), (v, _), (f,), (cart, bob, length, damping) = made.q, made.v, made.u, made.p
    made.body(cart, (x, 0))
    made.body(bob, (x + length * sin(theta), -length * cos(theta)))
    made.Q = [f - damping * v, 0]
    return made
'''

SOURCES = {"identifier": IDENTIFIER, "plant": PLANT, "scenario": SCENARIO, "effect": EFFECT, "model": MODEL}
"""Source of a plug-in by its kind."""
