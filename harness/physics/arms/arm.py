"""An arm as a nominal model: what its URDF or MJCF says about the torque of every joint along a motion."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.physics.arms.formats.mjcf import Stated, load_mjcf
from harness.physics.arms.formats.mjcf_spec import parsed
from harness.physics.arms.formats.urdf import dynamics_of, load_urdf, refuse_dependent, rotors_of
from harness.physics.arms.inertia import triangle_excess
from harness.physics.arms.rigid_tree import Arm
from harness.signals import Channel, FloatArray

GRAVITY = (0.0, 0.0, -9.81)
ARMS = {"iiwa": ("kuka_iiwa", "model.urdf")}  # Arms by name: their URDF comes with the package ``pybullet_data``.
FILES = (".urdf", ".xml", ".mjcf")  # Endings of files that hold an arm.
REST = 1e-2  # Width of the sign of the dry friction that a file states [rad/s or m/s].


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Inverse dynamics of an arm: ``tau = ID(q, v, a) + motor_inertia a + damping v + friction sgn(v)``.

    Attributes
    ----------
    name : str
        Of the robot.
    arm : Arm
        Joints and bodies of the file.
    damping, friction, motor_inertia : array (n,)
        Of a URDF's ``<dynamics>`` and ``<transmission>``, or of an MJCF's joints (``damping``, ``frictionloss``,
        ``armature``): N m s/rad, N m and kg m^2 behind the gear (N s/m, N and kg on a sliding joint); 0 where the
        file states none.
    inputs, outputs : tuple of Channel
        ``tau1`` ... and ``q1`` ..., in the order of the joints; rates follow the positions if they are measured.
    inertia : {"fixed", "calibrated"}
        Whether the inertial parameters of the file are believed, or fitted to the data.
    path : Path or None
        The URDF; None for an arm of another file.
    mjcf : Path or None
        The MJCF; None for an arm of another file.
    notes : tuple of str
        What its user should know of the file: links without mass or inertia, gears, what an arm does not hold.
    idle : tuple of str
        Joints that move and have no motor, where the file states the motors of others.

    Examples
    --------
    >>> import importlib.util
    >>> if importlib.util.find_spec("pybullet_data"):
    ...     arm = load_arm("iiwa")
    ...     assert [channel.name for channel in arm.inputs][:2] == ["tau1", "tau2"]
    ...     assert arm.torques(*np.zeros((3, 5, 7))).shape == (5, 7)
    """

    name: str
    arm: Arm
    damping: FloatArray
    friction: FloatArray
    motor_inertia: FloatArray
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    inertia: Literal["fixed", "calibrated"] = "fixed"
    path: Path | None = None
    mjcf: Path | None = None
    notes: tuple[str, ...] = ()
    idle: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.name}: {self.n} joints, inertial parameters {self.inertia}"

    @property
    def n(self) -> int:
        """Degrees of freedom."""
        return self.arm.n

    @property
    def positions(self) -> tuple[Channel, ...]:
        """The joint positions."""
        return self.outputs[: self.n]

    @property
    def states(self) -> tuple[Channel, ...]:
        """What can be measured: positions, then rates."""
        rates = tuple(Channel(f"{channel.name}_rate", f"{channel.unit}/s") for channel in self.positions)
        return (*self.positions, *rates)

    @property
    def links(self) -> tuple[int, ...]:
        """Index of the body that each moving joint carries."""
        return tuple(number for number, joint in enumerate(self.arm.joints) if joint in self.arm.moving)

    def torques(
        self,
        q: FloatArray,
        v: FloatArray,
        a: FloatArray,
        gravity: tuple[float, float, float] = GRAVITY,
        parameters: FloatArray | None = None,
    ) -> FloatArray:
        """Return the torques (N, n) along a motion, without friction.

        Parameters
        ----------
        q, v, a : array (N, n)
            Joint position, rate, acceleration.
        gravity : (x, y, z)
            m/s^2 in the frame of the base.
        parameters : array (10 * bodies,), optional
            Inertial parameters in the order of :attr:`Arm.parameters`; the torques are linear in them. By default those
            of the file, and the rotors that it states.
        """
        rows = [np.ascontiguousarray(np.asarray(values, dtype=float).T) for values in (q, v, a)]
        given = self.arm.parameters if parameters is None else np.asarray(parameters, dtype=float)
        bodies = np.array(self._function(*rows, np.array(gravity), given), dtype=float).T
        return bodies if parameters is not None else bodies + self.motor_inertia * np.asarray(a, dtype=float)

    def damped(self, v: FloatArray) -> FloatArray:
        """Return the torque (N, n) against damping and friction that the file states."""
        return np.asarray(self.damping * v + self.friction * np.tanh(v / REST))

    def with_outputs(self, chosen: Sequence[str | tuple[str, int] | tuple[str, int, str]]) -> ArmModel:
        """Return the arm with these measured outputs: every position, and rates, ``("q1", 1)`` or ``"q1_rate"``.

        Raises
        ------
        InputError
            If a joint position is missing, or another thing is asked for.
        """
        known = [channel.name for channel in self.positions]
        rate_of = {(f"{name}_rate", 0): (name, 1) for name in known}
        plain = [(item, 0) if isinstance(item, str) else (item[0], item[1]) for item in chosen]
        plain = [rate_of.get(item, item) for item in plain]
        wrong = [name for name, order in plain if name not in known or order not in (0, 1)]
        missing = [name for name in known if (name, 0) not in plain]
        if wrong or missing:
            raise InputError(
                f"measured outputs of {self.name}",
                expected=f"every joint position ({', '.join(known)}), and rates if there are any",
                got=f"{', '.join(missing)} missing" if missing else ", ".join(wrong),
                remedy="record all joints of the arm" if missing else "leave these columns out",
            )
        channels = {channel.name: channel for channel in self.states}
        rates = [f"{name}_rate" for name in known if (name, 1) in plain]
        return replace(self, outputs=tuple(channels[name] for name in (*known, *rates)))

    @cached_property
    def _function(self) -> Any:
        """Return the torques as a CasADi function of (q, v, a, gravity, parameters), linear in size."""
        import casadi as ca

        parameters = ca.SX.sym("p", 10 * len(self.arm.joints))
        arguments, torques = self.arm.symbolic_torques(parameters)
        return ca.Function("torques", [*arguments, parameters], [torques])


def is_arm(name: str) -> bool:
    """Return True if a model's name means an arm.

    Examples
    --------
    >>> is_arm("iiwa"), is_arm("robots/MINE.URDF"), is_arm("robots/mine.xml"), is_arm("pendulum")
    (True, True, True, False)
    """
    return name in ARMS or name.lower().endswith(FILES)


def load_arm(name: str | Path, *, inertia: str = "fixed", locked: Sequence[str] = ()) -> ArmModel:
    """Return an arm by name, or from a URDF or MJCF file.

    Raises InputError if the file cannot be read, an option is wrong, or PyBullet's data or MuJoCo are not installed.

    - ``name``: a name of :data:`ARMS`, a URDF file, or an MJCF file (which needs the package ``mujoco``)
    - ``inertia``: ``fixed``: masses, centres and inertias are those of the file, so that a payload or a wrong torque
      constant can be seen. ``calibrated``: they are fitted to the data; then only what no inertial parameter can mimic
      is seen.
    - ``locked``: names of joints that do not move and are not in the log
    """
    if inertia not in ("fixed", "calibrated"):
        raise InputError("option inertia", expected="fixed or calibrated", got=repr(inertia), remedy="choose one")
    path = _installed(str(name)) if str(name) in ARMS else Path(name)
    of_mujoco = parsed(path)[0].tag == "mujoco"
    stated = load_mjcf(path, locked=locked) if of_mujoco else _stated_by_urdf(path, locked)
    arm = stated.arm
    names = [joint.name for joint in arm.joints]
    refuse_unknown("locked joint", locked, names)
    arm = Arm(arm.name, tuple(replace(joint, kind="fixed") if joint.name in locked else joint for joint in arm.joints))
    if not arm.n:
        raise InputError(
            "arm without joints", expected="a joint that moves", got="none", remedy="choose another file", file=path
        )
    inputs, outputs = [], []
    for number, joint in enumerate(arm.moving, start=1):
        slides = joint.kind == "prismatic"
        inputs.append(Channel(f"tau{number}", "N" if slides else "N m"))
        outputs.append(Channel(f"q{number}", "m" if slides else "rad"))
    acting = np.array([stated.at_joints.get(joint.name, (0.0, 0.0, 0.0)) for joint in arm.moving])
    return ArmModel(
        name=str(name) if str(name) in ARMS else arm.name,
        arm=arm,
        damping=acting[:, 0],
        friction=acting[:, 1],
        motor_inertia=acting[:, 2],
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        inertia=inertia,  # type: ignore[arg-type]
        path=None if of_mujoco else path,
        mjcf=path if of_mujoco else None,
        notes=stated.notes,
        idle=tuple(joint.name for joint in arm.moving if stated.driven and joint.name not in stated.driven),
    )


def _stated_by_urdf(path: Path, locked: Sequence[str]) -> Stated:
    """Return what a URDF states; joints that are locked are still as they are there."""
    arm, root = load_urdf(path), ElementTree.parse(path).getroot()
    refuse_dependent(root, locked, path)
    dynamics, rotors = dynamics_of(root, path), rotors_of(root, path)
    at_joints = {
        joint.name: (*dynamics.get(joint.name, (0.0, 0.0)), rotors.get(joint.name, 0.0)) for joint in arm.joints
    }
    still = tuple(replace(joint, kind="fixed") if joint.name in locked else joint for joint in arm.joints)
    driven = {_name(joint, "name") for drive in root.findall("transmission") for joint in drive.findall("joint")}
    return Stated(arm, at_joints, tuple(_notes(Arm(arm.name, still), root, rotors)), frozenset(driven))


def _notes(arm: Arm, root: ElementTree.Element, rotors: Mapping[str, float]) -> list[str]:
    """Return what a reader of the URDF should know of its bodies and drives."""
    links = {joint.get("name"): _name(joint.find("child"), "link") for joint in root.findall("joint")}
    notes = []
    for number, joint in enumerate(arm.joints):
        link = links[joint.name]
        carried = {number}
        for other, below in enumerate(arm.joints):
            if below.parent in carried:
                carried.add(other)
        if joint in arm.moving and not any(arm.joints[k].mass > 0 for k in carried):
            notes.append(f"the URDF gives link {link} no mass, nor what it carries: joint {joint.name} moves nothing")
        elif joint.mass > 0 and not joint.inertia.any():
            notes.append(f"the URDF gives link {link} no inertia tensor: it is a point mass")
        elif joint.mass > 0 and (excess := triangle_excess(joint.inertia)) > 0:
            notes.append(
                f"the URDF gives link {link} an inertia that no body has: its largest principal moment exceeds the "
                f"sum of the other two by {100 * excess:.2g} % of itself"
            )
    for drive in root.findall("transmission"):
        for element in drive.iter("mechanicalReduction"):
            ratio = (element.text or "").strip()
            if ratio not in ("", "1", "1.0"):
                name = _name(drive.find("joint"), "name")
                absent = "" if name in rotors else ", and the inertia of its rotor is not in the URDF"
                notes.append(
                    f"the URDF states a gear ratio of {ratio} at joint {name}: torques and positions are taken on the "
                    f"side of the joint{absent}"
                )
    return list(dict.fromkeys(notes))


def _name(element: ElementTree.Element | None, key: str) -> str:
    """Return what an element names."""
    return "" if element is None else element.get(key, "")


def _installed(name: str) -> Path:
    """Return the URDF of a named arm."""
    found = importlib.util.find_spec("pybullet_data")
    path = None if found is None or found.origin is None else Path(found.origin).parent.joinpath(*ARMS[name])
    if path is None or not path.is_file():
        raise InputError(
            f"model {name}",
            expected="the URDF that comes with PyBullet's data",
            got="pybullet_data is not installed",
            remedy="give a URDF file, or use Python 3.11 and pip install pybullet, which has no wheels for later ones",
        )
    return path
