"""What nobody modelled: unknown forces of several kinds, and nominal structures that are a little wrong.

Every force has an rms of 1 and is scaled by the record. Gauss-Markov noise is what the likelihood assumes; the others
are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from harness.signals import FloatArray
from sysid_lab.truths.context import rms

GAUSS_MARKOV = "gauss-markov"
STRUCTURES = {
    "uneven-damping": "the viscous damping changes along the motion, by 1 % of the rms torque",
    "drooping-drive": "the drive's gain falls with its command, by 1 % of the rms command",
    "eccentric-encoder": "the angle reads with an error of 2 mrad, twice a turn",
    "heavy-rod": "the pole has 3 % more inertia than its point mass (the model holds it all the same: as a lighter "
    "point mass farther out)",
    "bent-scale": "the angle reads with an error that grows with its square, 2 mrad at 1 rad",
    "warming-damper": "the viscous damping falls along a record, by 1 % of the rms torque",
    "sagging-supply": "the drive's gain falls along a record, by 1 % of the rms command",
    "tiring-drive": "the drive's gain falls with the speed, by 1 % of the rms torque",
    "rippling-drive": "the drive's gain ripples with the position, by 1 % of the rms torque",
}
"""How the nominal structure is a little wrong: what is in every such truth and in no model."""
TRUTH_ONLY = ("heavy-rod",)  # Structures that only our own truth can have.
UNNAMED = ("tiring-drive",)  # Structures that no model holds and the dictionary has no name for.
_NAMED = {
    "eccentric-encoder": "sensor_cyclic_error@theta",
    "bent-scale": "sensor_nonlinearity@theta",
    "drooping-drive": "input_compression@u",
    "uneven-damping": "position_dependent_damping",
    "warming-damper": "drifting_damping",
    "sagging-supply": "drifting_gain@u",
    "rippling-drive": "torque_ripple",
}


def named(structure: str, plant: str) -> str:
    """Return the effect of the dictionary that a wrong structure is, at its place; empty where there is none.

    An answer may name it beside what is hidden.

    Examples
    --------
    >>> named("uneven-damping", "cart-pole"), named("heavy-rod", "cart-pole")
    ('position_dependent_damping@x', '')
    """
    found = _NAMED.get(structure, "")
    return found if "@" in found or not found else f"{found}@{'theta' if plant == 'pendulum' else 'x'}"


def natural_frequency(values: Mapping[str, float]) -> float:
    """Return the frequency of small swings [Hz]."""
    if "mgl" in values:
        return math.sqrt(values["mgl"] / values["J"]) / (2 * math.pi)
    return math.sqrt(9.81 / values["l"] * (1 + values["mp"] / values["mc"])) / (2 * math.pi)


def disturbance(kind: str, n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return a force (n,) with an rms of 1.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    n : int
    dt : float
        [s].
    resonance : float
        Natural frequency of the plant [Hz].
    rng : numpy.random.Generator

    Examples
    --------
    >>> force = disturbance("steps", 5000, 0.004, 1.0, np.random.default_rng(0))
    >>> len(np.unique(force)) < 40
    True
    """
    force = KINDS[kind](n, dt, resonance, rng)
    return np.asarray(force / rms(force))


def _gauss_markov(n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return first-order noise with a corner between 0.3 and 3 Hz."""
    from scipy.signal import lfilter

    corner = math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
    pole = math.exp(-2 * math.pi * corner * dt)
    return np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(n + 2000))[2000:])


def _drifting_sine(n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return a sine between 0.8 and 4 Hz whose frequency wanders by some 10 % within seconds."""
    hertz = math.exp(rng.uniform(math.log(0.8), math.log(4.0)))
    wander = _slow(n, dt, 0.2, rng)
    return np.sin(2 * math.pi * np.cumsum(hertz * (1 + 0.1 * wander)) * dt + rng.uniform(-math.pi, math.pi))


def _steps(n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return a level that changes at random instants, every 2 s on average."""
    changes = np.flatnonzero(rng.random(n) < dt / 2.0)
    levels = rng.standard_normal(len(changes) + 1)
    force = levels[np.searchsorted(changes, np.arange(n), side="right")]
    return np.asarray(force - force.mean() if len(changes) else force)


def _band_at_resonance(n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return noise through a resonator with 5 % damping at the plant's own frequency."""
    from scipy.signal import bilinear, lfilter

    omega = 2 * math.pi * resonance
    b, a = bilinear([omega, 0.0], [1.0, 0.1 * omega, omega**2], fs=1 / dt)
    return np.asarray(lfilter(b, a, rng.standard_normal(n + 5000))[5000:])


def _wheel(n: int, dt: float, resonance: float, rng: np.random.Generator) -> FloatArray:
    """Return three harmonics of a wheel whose speed goes between 1 and 4 turns a second, and grow with it."""
    speed = 2.5 + 1.5 * np.sin(2 * math.pi * np.arange(n) * dt / rng.uniform(8.0, 16.0) + rng.uniform(-3.0, 3.0))
    turns = np.cumsum(speed) * dt
    phases = rng.uniform(-math.pi, math.pi, 3)
    waves = [np.sin(2 * math.pi * (k + 1) * turns + phases[k]) / (k + 1) for k in range(3)]
    return np.asarray(speed**2 * np.sum(waves, axis=0))


def _slow(n: int, dt: float, corner: float, rng: np.random.Generator) -> FloatArray:
    """Return slow noise with an rms of about 1."""
    from scipy.signal import butter, lfilter

    b, a = butter(2, 2 * corner * dt)
    noise = np.asarray(lfilter(b, a, rng.standard_normal(n + 5000))[5000:])
    return noise / rms(noise)


KINDS: dict[str, Callable[[int, float, float, np.random.Generator], FloatArray]] = {
    GAUSS_MARKOV: _gauss_markov,
    "drifting-sine": _drifting_sine,
    "steps": _steps,
    "resonance": _band_at_resonance,
    "wheel": _wheel,
}
