"""What can be hidden where, and who can simulate it."""

from __future__ import annotations

from collections.abc import Sequence

from sysid_lab.truths.applied import ACTUATOR, FORCES
from sysid_lab.truths.hardware import LAWS

_COORDINATE = (
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "hysteresis",
    "sublinear_friction",
    "load_dependent_friction",
    "quadratic_drag",
    "linear_spring",
    "cubic_spring",
    "maxwell_element",
    "position_dependent_damping",
    "drifting_damping",
    "force_bias",
    "force_step",
    "payload_step",
    "end_stop",
    "cogging",
    "periodic_disturbance",
)
_ANGLE = ("position_dependent_friction", "eccentric_load", "quadratic_spring")
_INPUT = ("input_delay", "actuator_lag", "dead_zone", "saturation", "rate_limit", "input_gain",
          "input_compression", "drifting_gain")  # fmt: skip
_DRIVEN = ("elasticity", "backlash")
_OUTPUT = (
    "sensor_delay",
    "sensor_gain",
    "sensor_nonlinearity",
    "sensor_offset",
    "sensor_quantisation",
    "sensor_rectification",
    "sensor_saturation",
)
_ANGLE_OUTPUT = ("sensor_cyclic_error",)
# Not hidden: viscous_friction, which both models have on every coordinate; yield_friction, a sum of two that are; leak,
# overflow, level_saturation, which belong to tanks; quadratic_spring on the cart, which would run away to infinity;
# one_sided_stop, half of end_stop.
PAIRS = {
    "pendulum": (
        ("coulomb_friction@theta", "force_bias@theta"),
        ("coulomb_friction@theta", "quadratic_drag@theta"),
        ("coulomb_friction@theta", "input_delay@u"),
        ("stribeck_friction@theta", "gravity_tilt@base"),
        ("quadratic_drag@theta", "cogging@theta"),
        ("cubic_spring@theta", "coulomb_friction@theta"),
        ("linear_spring@theta", "dead_zone@u"),
        ("saturation@u", "coulomb_friction@theta"),
        ("end_stop@theta", "quadratic_drag@theta"),
        ("actuator_lag@u", "periodic_disturbance@theta"),
    ),
    "cart-pole": (
        ("coulomb_friction@x", "coulomb_friction@theta"),
        ("coulomb_friction@x", "input_delay@u"),
        ("quadratic_drag@x", "coulomb_friction@theta"),
        ("linear_spring@x", "coulomb_friction@x"),
        ("dead_zone@u", "quadratic_drag@theta"),
        ("coulomb_friction@x", "sensor_offset@theta"),
        ("saturation@u", "linear_spring@theta"),
        ("cogging@x", "coulomb_friction@theta"),
        ("coulomb_friction@x", "gravity_tilt@base"),
        ("periodic_disturbance@x", "coulomb_friction@theta"),
    ),
}
OUTSIDE = {
    "pendulum": (
        "even_drag@theta",
        "cubic_drag@theta",
        "force_pulse@theta",
        "magnet@theta",
        "tiring_drive@theta",
    ),
    "cart-pole": (
        "even_drag@theta",
        "cubic_drag@x",
        "force_pulse@x",
        "magnet@x",
        "tiring_drive@x",
    ),
}
ENGINES = {"pendulum": ("bullet", "fmu"), "cart-pole": ("pymunk", "fmu")}
"""Whose mechanics are not the truth's own; ``balanced`` joins where nothing is hidden."""
_OWN = {
    ("bullet", "pendulum"): ("coulomb_friction@theta",),
    ("fmu", "pendulum"): ("coulomb_friction@theta", "stribeck_friction@theta"),
    ("fmu", "cart-pole"): ("coulomb_friction@x", "coulomb_friction@theta"),
    ("pymunk", "cart-pole"): ("coulomb_friction@x", "coulomb_friction@theta", "linear_spring@theta"),
}
"""What the joints of an engine have themselves, beside what is put on its driven coordinate from outside."""


def places(plant: str) -> list[str]:
    """Return every effect of the confusion study at every place it fits."""
    coordinates = ("theta",) if plant == "pendulum" else ("x", "theta")
    driven = coordinates[0]
    found = [f"{name}@{at}" for name in _COORDINATE for at in coordinates if _apart(name, at, driven)]
    found += [f"{name}@theta" for name in _ANGLE] + ["gravity_tilt@base"]
    found += [f"{name}@u" for name in _INPUT] + [f"{name}@{driven}" for name in _DRIVEN]
    found += [f"{name}@{at}" for name in _OUTPUT for at in coordinates]
    return found + [f"{name}@theta" for name in _ANGLE_OUTPUT]


def _apart(name: str, at: str, driven: str) -> bool:
    """Return False for what makes no sense on a coordinate that nothing drives."""
    return at == driven or name != "periodic_disturbance"


def sources(plant: str, effects: Sequence[str]) -> tuple[str, ...]:
    """Return who can simulate all of these effects: engines that are not ours, then other laws, then ours.

    Examples
    --------
    >>> sources("pendulum", ["coulomb_friction@theta"])
    ('bullet', 'fmu', 'hardware', 'laws')
    >>> sources("cart-pole", ["cubic_spring@theta"])
    ('laws',)
    """
    found = [engine for engine in ENGINES[plant] if all(_has(engine, plant, effect) for effect in effects)]
    if effects and any(effect.partition("@")[0] in LAWS for effect in effects):
        found.append("hardware")
    return (*found, "laws")


def _has(engine: str, plant: str, effect: str) -> bool:
    """Return whether an engine has an effect, or it can be put around it."""
    name, _, at = effect.partition("@")
    if effect in _OWN[engine, plant] or name in ACTUATOR or name in (*_OUTPUT, *_ANGLE_OUTPUT):
        return True
    if name == "gravity_tilt":
        return plant == "pendulum"
    return name in FORCES and at == ("theta" if plant == "pendulum" else "x")
