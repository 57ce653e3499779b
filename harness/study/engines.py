"""Truth by other people's engines: Bullet's arm, Chipmunk's cart-pole, and the FMUs written by hand in C."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from harness import registry
from harness.rng import Streams, stream
from harness.signals import FloatArray
from harness.study.context import Hidden
from harness.study.plan import Task
from harness.study.truths import DT

__all__ = ["BALANCE_BAND", "balanced_run", "engine_run"]

BALANCE_BAND = (0.1, 10.0)
"""Of the force that is added to the controller's [Hz]."""
_SUBSTEPS = {"bullet": 160, "pymunk": 160}
"""Both engines integrate to first order: with 40 steps a sample Bullet is 1e-4 rad off, as much as the low noise."""
_OPTIONS = {
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
    u: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Return the outputs (N, ny) of an engine under a force (N,) from a start at rest.

    Parameters
    ----------
    engine : str
        ``bullet``, ``pymunk`` or ``fmu``.
    plant : str
    parameters : mapping
        In the words of the model.
    options : mapping
        The hidden effect in the words of any engine; those of this engine are taken.
    u : array (N,)
    start : array (2 dof,)
        Coordinates, then rates (0).
    """
    own = {name: options[name] for name in _OPTIONS[engine, plant] if name in options}
    names = ("theta",) if plant == "pendulum" else ("x", "theta")
    x0 = dict(zip(names, start.tolist(), strict=False))
    with registry.create("plants", _plant_name(engine, plant), **_made(engine, plant, parameters, own)) as made:
        y = np.empty((len(u), len(names)))
        y[0] = made.reset(rng=stream("study", "engine"), x0=x0)
        if "batch" in made.abilities:
            y[1:] = made.rollout(u[:-1, None])
        else:
            for k, value in enumerate(u[:-1]):
                y[k + 1] = made.step(np.array([value]))
    return y


def _plant_name(engine: str, plant: str) -> str:
    """Return the id of a registered plant."""
    return "arm-bullet" if engine == "bullet" else f"{plant}-{engine}"


def _made(engine: str, plant: str, parameters: Mapping[str, float], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that make an engine's plant."""
    options: dict[str, Any] = {"sample_time": DT, **own}
    if engine == "bullet":
        length = parameters["J"] * 9.81 / parameters["mgl"]  # a point mass: J = m l^2
        options.update(mass=parameters["mgl"] / (9.81 * length), length=length, joint_damping=parameters["b"])
    else:
        options.update(parameters)
    if engine == "fmu":
        options["substep"] = DT / 20
    else:
        options["substeps"] = _SUBSTEPS[engine]
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
    for one in hidden:
        own.update({name: one.engine[name] for name in _OPTIONS["pymunk", "cart-pole"] if name in one.engine})
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
    options = _made("pymunk", "cart-pole", parameters, own) | {"u_limit": math.inf}
    with registry.create("plants", "cart-pole-pymunk", **options) as plant:
        record = run(plant, scenario, streams=Streams("study", task.key, task.seed), role=f"{use}/0").measured()
    return record.t, record.u, record.y
