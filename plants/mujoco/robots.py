"""Robots in MuJoCo that need no file: one joint, as the other engines have it."""

from __future__ import annotations

from typing import Any

from plants.checking import checked_options, positive
from plants.mujoco.plant import MujocoPlant

POINT = 1e-12  # Inertia [kg m^2] of a point mass: MuJoCo refuses none.


def one_joint_arm(*, mass: float = 1.0, length: float = 0.5, link_inertia: float = 0.0, **options: Any) -> MujocoPlant:
    """Pendulum in MuJoCo: a mass at the end of a rod on a hinge; theta = 0 hangs down.

    ``true_parameters`` are those of the built-in model ``pendulum``: J (rotor included), b, mgl. Dry friction
    (``joint_friction``) is MuJoCo's ``frictionloss``, a soft constraint: with its own time constant of 20 ms the joint
    creeps at mrad/s where it should stick, which is another law than Coulomb's; here it is 2 ms. Integrated by RK4:
    what MuJoCo's integrators of first order leave in a record is seen by ``close-loop``.

    Parameters
    ----------
    mass, length, link_inertia : float
        In kg; from hinge to centre of mass [m]; about the centre of mass [kg m^2].
    **options
        Of :class:`plants.mujoco.plant.MujocoPlant`.

    Examples
    --------
    >>> import importlib.util
    >>> if importlib.util.find_spec("mujoco"):
    ...     with one_joint_arm(mass=2.0, length=0.5, joint_damping=0.1) as arm:
    ...         assert arm.true_parameters == {"J": 0.5, "b": 0.1, "mgl": 9.81}
    """
    mass, length = positive("mass", mass), positive("length", length)
    link_inertia = positive("link_inertia", link_inertia, zero=True)
    tensor = " ".join([repr(max(link_inertia, POINT))] * 3)
    text = f"""<mujoco model="one-joint-arm"><worldbody><body name="rod"><joint name="hinge" axis="0 -1 0"/>
<inertial pos="0 0 {-length!r}" mass="{mass!r}" diaginertia="{tensor}"/></body></worldbody>
<actuator><motor name="u" joint="hinge"/></actuator></mujoco>"""
    defaults: dict[str, Any] = {
        "outputs": ("q",),
        "joint_names": ("theta",),
        "input_names": ("u",),
        "input_limit": 2 * mass * 9.81 * length,
        "sample_time": 0.004,
        "substeps": 4,
        "integrator": "rk4",
        "friction_time": 0.002,
    }
    arm = MujocoPlant(text, **checked_options("one_joint_arm", MujocoPlant, defaults, options))
    given = arm.declared
    arm.true_parameters = {
        "J": mass * length**2 + link_inertia + given["armature"][0],
        "b": given["joint_damping"][0],
        "mgl": -mass * given["gravity"][2] * length,
    }
    return arm
