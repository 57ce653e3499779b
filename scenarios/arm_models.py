"""The model of an arm that a controller or a design uses."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from harness.errors import InputError
from harness.signals import FloatArray, PlantSpec

if TYPE_CHECKING:
    from harness.physics.arms.arm import ArmModel
    from harness.physics.arms.rigid_tree import Arm


def arm_of(urdf: str | Path | None, spec: PlantSpec) -> Arm:
    """Return the model of the arm that a controller uses; the iiwa for a plant with seven inputs.

    Raises InputError if there is none, or it has another number of joints than the plant has inputs.
    """
    return arm_model_of(urdf, spec).arm


def arm_model_of(urdf: str | Path | None, spec: PlantSpec) -> ArmModel:
    """Return the model of an arm with the damping, friction and rotors of its URDF or MJCF; see :func:`arm_of`."""
    from harness.physics.arms.arm import load_arm

    path = _path(urdf, spec)
    model = load_arm(path)
    if model.n != spec.nu:
        raise InputError(
            "model of the arm",
            expected=f"{spec.nu} moving joints, one for each input",
            got=str(model.n),
            remedy="give the URDF or MJCF of this arm",
            file=path,
            place="urdf",
        )
    return model


def damping_of(urdf: str | Path | None, spec: PlantSpec) -> FloatArray:
    """Return the damping (n,) that the file of :func:`arm_of` states."""
    return arm_model_of(urdf, spec).damping


def _path(urdf: str | Path | None, spec: PlantSpec) -> Path:
    return Path(urdf) if urdf is not None else _iiwa_urdf(spec)


def _iiwa_urdf(spec: PlantSpec) -> Path:
    """Return the URDF of the KUKA iiwa that PyBullet brings, for a plant with seven inputs."""
    found = importlib.util.find_spec("pybullet_data") if spec.nu == 7 else None
    path = None if found is None or found.origin is None else Path(found.origin).parent / "kuka_iiwa" / "model.urdf"
    if path is None or not path.is_file():
        raise InputError(
            "model of the arm",
            expected="a URDF or MJCF, or a plant with seven inputs and PyBullet's data installed",
            got=f"{spec.nu} inputs",
            remedy="give urdf, or inverse_dynamics, or for arm-pd kp, kd and gravity_compensation = false",
            place="urdf",
        )
    return path
