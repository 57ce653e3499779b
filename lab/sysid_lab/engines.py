"""Truth by other people's engines: Bullet's arm, Chipmunk's cart-pole, and the FMUs written by hand in C."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from harness import registry
from harness.rng import Streams, stream
from harness.signals import FloatArray
from sysid_lab.plan import Task
from sysid_lab.truths.applied import STEP, Law
from sysid_lab.truths.context import Hidden
from sysid_lab.truths.simulation import DT, SUBSTEPS

BALANCE_BAND = (0.1, 10.0)  # Of the force that is added to the controller's [Hz].
_SUBSTEPS = {"bullet": 320, "pymunk": 320}  # Of a sample: both engines integrate to first order.
_LATE = {"bullet": -0.5, "pymunk": 0.5}
"""Steps of the engine after which its positions are read. Chipmunk moves bodies before it pushes them, Bullet after:
positions lie half a step behind or ahead. Read at their time they are 4e-6 (pymunk) and 2e-5 rad (Bullet) off, a fifth
and a third of what they are as they come."""
OPTIONS = {
    ("bullet", "pendulum"): ("joint_friction",),
    ("fmu", "pendulum"): ("Fc", "Fs", "vs", "c2"),
    ("fmu", "cart-pole"): ("Fx", "Ftheta"),
    ("pymunk", "cart-pole"): ("friction_x", "friction_theta", "spring_x", "spring_theta"),
}


def engine_run(
    engine: str,
    plant: str,
    parameters: Mapping[str, float],
    options: Mapping[str, Any],
    force: FloatArray,
    start: FloatArray,
    law: Law | None = None,
) -> FloatArray:
    """Return the outputs (N, ny) of an engine at fine steps under a force (N,) from a start at rest.

    Parameters
    ----------
    engine : str
        ``bullet``, ``pymunk`` or ``fmu``.
    plant : str
    parameters : mapping
        In the words of the model.
    options : mapping
        The hidden effect in the words of any engine; those of this engine are taken.
    force : array (N,)
        Held over a fine step, ``SUBSTEPS`` of which are one sample.
    start : array (2 dof,)
        Coordinates, then rates (0).
    law : callable, optional
        More force on the driven coordinate, from what the engine shows, foretold to the middle of the next step.
    """
    own = {name: options[name] for name in OPTIONS[engine, plant] if name in options}
    names = ("theta",) if plant == "pendulum" else ("x", "theta")
    x0 = dict(zip(names, start.tolist(), strict=False))
    with registry.create(
        "plants", _plant_name(engine, plant), **_made(engine, plant, parameters, own, fine=True)
    ) as made:
        y = np.empty((len(force), len(names)))
        y[0] = made.reset(rng=stream("study", "engine"), x0=x0)
        if law is None:
            y[1:] = made.rollout(force[:-1, None])
            return _in_time(y, engine)
        before, rate, last = float(y[0, 0]), 0.0, 0.0
        for k, value in enumerate(force[:-1].tolist()):
            now = float(y[k, 0])
            rate, last, before = (now - before) / STEP, rate, now
            # of the middle of the step that the force is held over: half a step late it would brake, or drive
            middle = now + 0.5 * STEP * (rate + 0.75 * (rate - last)), 2.0 * rate - last, (k + 0.5) * STEP
            y[k + 1] = made.step(np.array([value + law(*middle, value)]))
    return _in_time(y, engine)


def _in_time(y: FloatArray, engine: str) -> FloatArray:
    """Return positions (N, ny) at fine steps as they are at their instants; the first ones are given."""
    if engine not in _LATE:
        return y
    moved = y + _LATE[engine] * DT / _SUBSTEPS[engine] * np.gradient(y, STEP, axis=0)
    moved[0] = y[0]
    return np.asarray(moved)


def _plant_name(engine: str, plant: str) -> str:
    """Return the id of a registered plant."""
    return "arm-bullet" if engine == "bullet" else f"{plant}-{engine}"


def _made(
    engine: str, plant: str, parameters: Mapping[str, float], own: Mapping[str, Any], *, fine: bool
) -> dict[str, Any]:
    """Return the options that make an engine's plant, with outputs at fine steps or at samples."""
    options: dict[str, Any] = {"sample_time": STEP if fine else DT, **own}
    if engine == "bullet":
        length = parameters["J"] * 9.81 / parameters["mgl"]  # a point mass: J = m l^2
        options.update(mass=parameters["mgl"] / (9.81 * length), length=length, joint_damping=parameters["b"])
    else:
        options.update(parameters)
    if engine == "fmu":
        options["substep"] = STEP
    else:
        options["substeps"] = _SUBSTEPS[engine] // (SUBSTEPS if fine else 1)
    if engine == "pymunk":
        options["u_limit"] = math.inf
    return options


def balanced_run(
    task: Task,
    parameters: Mapping[str, float],
    hidden: tuple[Hidden, ...],
    noise: float,
    amplitude: float,
    use: str,
    samples: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time, command and reading of Chipmunk's cart-pole balanced upright; the controller sees the noise.

    The controller's model is off by 10 %, as a user's would be.
    """
    from harness.rollout import run

    own: dict[str, Any] = {}
    for effect in hidden:
        own.update({name: effect.engine[name] for name in OPTIONS["pymunk", "cart-pole"] if name in effect.engine})
    known = {name: 1.1 * value for name, value in parameters.items()}
    scenario: Any = registry.create(
        "scenarios",
        "cart-pole-lqr",
        samples=samples,
        amplitude=amplitude,
        band=BALANCE_BAND,
        noise=noise,
        sensor=(noise, noise),
        process_noise_ratio=task.disturbance or None,
        **known,
    )
    options = _made("pymunk", "cart-pole", parameters, own, fine=False)
    with registry.create("plants", "cart-pole-pymunk", **options) as plant:
        record = run(plant, scenario, streams=Streams("study", task.key, task.seed), role=f"{use}/0").measured()
    return record.t, record.u, record.y
