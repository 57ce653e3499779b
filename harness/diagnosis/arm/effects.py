"""Effects that act on several joints of an arm: payload, tilted base, wrong link, joint zero, elasticity, gain.

All but a joint's elasticity are linear in their parameters once the motion is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from harness.diagnosis.arm.motion import ArmRun, torque_gradient
from harness.diagnosis.arm.rotor import LINK_SIDE, MOTOR_SIDE, Spring, Swinging, ahead, swinging
from harness.diagnosis.policy import ARM_POLICY, ArmPolicy
from harness.effects.effect import Effect, EffectParameter, Placed
from harness.physics.arms.arm import ArmModel
from harness.physics.arms.joints import Joint
from harness.signals import FloatArray

GAIN = "input_gain"
BODIES = MappingProxyType({"parameter": "inertial parameters that the URDF gives the same link"})
"""What the data tell no body's effect from."""


@dataclass(frozen=True, eq=False)
class Wide:
    """An effect on several joints.

    Attributes
    ----------
    placed : Placed
        Its parameters are 0 where it does nothing, and linear but for those of ``bent``.
    columns : callable
        ``ArmRun -> (N, n, k)``: torque that the joints need more, for a parameter of 1.
    of_bodies : bool
        Another arm (other masses, lengths) can look like several of its kind together.
    bent : callable, optional
        ``ArmRun -> Spring``, which makes that torque of its parameters where it is not in proportion to them.
    """

    placed: Placed
    columns: Callable[[ArmRun], FloatArray]
    of_bodies: bool = True
    bent: Callable[[ArmRun], Spring] | None = None

    def __str__(self) -> str:
        return str(self.placed)


def together(springs: Sequence[tuple[Spring, FloatArray]]) -> list[tuple[Spring, FloatArray]]:
    """Return springs and their values, those that swing as one: each one's twist moves the others."""
    found: list[tuple[Spring, FloatArray]] = []
    for spring, values in springs:
        at = next((k for k, (other, _) in enumerate(found) if isinstance(other, Swinging)), None)
        if at is None or not isinstance(spring, Swinging):
            found.append((spring, values))
        elif isinstance(other := found[at][0], Swinging):
            found[at] = other.beside(spring), np.concatenate([found[at][1], values])
    return found


def torques_of(effects: Sequence[tuple[Wide, FloatArray]], run: ArmRun) -> tuple[FloatArray, FloatArray]:
    """Return the torque (N, n) that the joints need more, of effects with values of their parameters.

    Beside it stand the torques (N, n, k) of the swings that the record may begin in.
    """
    total = np.zeros_like(run.calm.q)
    swings = [np.zeros((*total.shape, 0))]
    for effect, values in effects:
        if effect.bent is None:
            total += effect.columns(run) @ values
    for spring, values in together([(effect.bent(run), values) for effect, values in effects if effect.bent]):
        total += spring(values)
        if spring.hidden:
            swings.append(spring.swings(values))
    return total, np.concatenate(swings, axis=2)


def _on_several(signal: Any, states: Any, parameters: Any, q: Any, v: Any) -> Any:
    """Refuse: such an effect is a column of the whole arm's torques and no block at one port."""
    raise TypeError("an effect on several joints of an arm has no block of its own")


def _effect(
    name: str,
    parameters: Sequence[EffectParameter],
    words: Sequence[str],
    nests: tuple[str, ...] = (),
    same_as: Mapping[str, str] = MappingProxyType({}),
) -> Effect:
    """Return an effect with summary, formula and experiment; its first parameter decides."""
    summary, formula, experiment = words
    return Effect(name, ("base",), tuple(parameters), (), _on_several, summary=summary, formula=formula,
                  experiment=experiment, nests=nests, same_as=same_as)  # fmt: skip


def _par(
    name: str, unit: str, meaning: str, most: float, *, main: bool = True, sign: Any = "any", least: Any = None,
    linear: bool = True,
) -> EffectParameter:  # fmt: skip
    """Return a parameter that does nothing at 0, between minus and plus its largest size."""
    low = -most if least is None else least
    return EffectParameter(name, unit, sign=sign, minimum=low, maximum=most, neutral=0.0, main=main, linear=linear,
                           meaning=meaning)  # fmt: skip


def wide_effects(arm: ArmModel, torques: FloatArray, policy: ArmPolicy = ARM_POLICY) -> list[Wide]:
    """Return the effects on several joints that are looked for.

    Parameters
    ----------
    arm : ArmModel
    torques : array (n,)
        Typical size of each joint's torque.
    policy : ArmPolicy
    """
    wide: list[Wide] = []
    tip = arm.links[-1]
    frame = arm.arm.joints[tip].name
    whole = sum(joint.mass for joint in arm.arm.joints)

    def add(effect: Effect, at: str, columns: Callable[[ArmRun], FloatArray], of_bodies: bool = True) -> None:
        wide.append(Wide(Placed(effect, at), columns, of_bodies))

    def body(row: int, offset: int) -> Callable[[ArmRun], FloatArray]:
        unit = np.zeros(10 * len(arm.arm.joints))
        unit[10 * row + offset] = 1.0
        return lambda run: arm.torques(run.calm.q, run.calm.v, run.calm.a, parameters=unit)[:, :, None]

    # an arm carries no more than it weighs; what it carries reaches no farther than a metre beyond its flange
    mass = _par("m", "kg", "mass at the end of the arm", whole, sign="+")
    moments = [
        _par(f"m{axis}", "kg m", f"mass times its distance along {axis} of the last link's frame", whole, main=False)
        for axis in "xyz"
    ]
    load = [body(tip, k) for k in range(4)]
    heavier = "the same motion with a known mass in addition: the scale of the torque tells a payload from a gain"
    formula = f"tau = ID(q, v, a) + m ID_unit mass at {frame}"
    add(
        _effect("payload", [mass], ("A point mass at the end of the arm.", formula, heavier), same_as=BODIES),
        "flange",
        load[0],
    )
    beside = "A mass at the end of the arm, its centre beside the frame of the last link."
    add(
        _effect("payload_off_centre", [mass, *moments], (beside, f"{formula} + (m c) ID_unit moment", heavier),
                ("payload",), BODIES),
        "flange",
        lambda run: np.concatenate([column(run) for column in load], axis=2),
    )  # fmt: skip
    swings = _swings(arm)
    turning = "turn the base, or mount it on a level plate: a tilt moves with the base, an encoder's zero does not"

    def tilted(run: ArmRun) -> FloatArray:
        still = np.zeros_like(run.calm.q)
        return np.stack(
            [arm.torques(run.calm.q, still, still, gravity) for gravity in ((9.81, 0.0, 0.0), (0.0, 9.81, 0.0))], axis=2
        )

    tilts = [
        _par("x", "rad", "tilt of gravity towards x of the base", policy.angle),
        _par("y", "rad", "tilt of gravity towards y of the base", policy.angle, main=False),
    ]
    add(_effect("gravity_tilt", tilts, ("The base does not stand upright.", "gravity = 9.81 (x, y, -1)", turning)),
        "base", tilted)  # fmt: skip
    for k, channel in enumerate(arm.positions):
        zero = _par("offset", channel.unit, "reading minus true position", policy.angle)
        words = "The zero of the position sensor is wrong.", f"{channel.name} = true position + offset", turning
        add(_effect("sensor_offset", [zero], words), channel.name, _zero(arm, k))
        if swings[k]:
            wide += _springs(arm, k, policy.angle / max(float(torques[k]), 1e-9))
    for number in arm.links:
        joint = arm.arm.joints[number]
        if joint.mass > 0:
            scale = _par("scale", "1", "relative error of mass and inertia", policy.gain - 1, least=policy.lightest)
            words = (
                "The URDF gives this link the wrong mass and inertia.",
                "mass and inertia of the link times (1 + scale)",
                heavier,
            )
            add(_effect("link_mass", [scale], words, same_as=BODIES), f"link of {joint.name}", _link(arm, number))
            if not joint.inertia.any():
                add(_tensor(joint), f"link of {joint.name}", _turning(arm, number))
    for k, channel in enumerate(arm.inputs):
        factor = _par("gain", "1", "relative error of the torque", policy.gain - 1, least=1 / policy.gain - 1)
        words = "The torque of one joint is wrong by a factor.", "left to the search on the joint", heavier
        add(_effect(GAIN, [factor], words), channel.name, _gain(arm, k))
    return wide


def _swings(arm: ArmModel) -> FloatArray:
    """Return for each joint whether its bodies have an inertia about it (n,): else nothing swings on its spring."""
    still, unit = np.zeros((arm.n, arm.n)), np.eye(arm.n)
    bent = np.tile(np.linspace(0.3, 0.7, arm.n), (arm.n, 1))  # no pose where links lie along each other
    mass = np.diag(arm.torques(bent, still, unit, (0.0, 0.0, 0.0), arm.arm.parameters))
    return np.asarray(mass > ARM_POLICY.told * float(np.max(mass)))


def _springs(arm: ArmModel, k: int, most: float) -> list[Wide]:
    """Return the elasticity of a joint up to a compliance, seen from its motor, and from its link."""
    channel, drive = arm.positions[k], arm.inputs[k]
    faster = "fast excitation, through the resonance sqrt(k/J), with a position sensor on either side of the joint"
    unit = f"{channel.unit}/({drive.unit})"
    soft = _par("compliance", unit, "1/stiffness between motor and link", most, sign="+", linear=False)
    lag = EffectParameter(
        "lag", "s", sign="+", minimum=ARM_POLICY.least_lag, maximum=ARM_POLICY.most_lag, nuisance=True,
        meaning="damping between motor and link over the stiffness",
    )  # fmt: skip
    words = (
        "The joint gives way under its torque, and its link swings on it; the motor's side is measured.",
        f"k e + d e' = torque of the bodies at {channel.name} - e; k = 1/compliance, d = lag k",
        faster,
    )
    of_motor = _effect(MOTOR_SIDE, [soft, lag], words)
    rotor = _par("rotor_over_stiffness", "s^2", "inertia of the rotor over the stiffness", ARM_POLICY.most_lag**2,
                 sign="+", linear=False)  # fmt: skip
    words = (
        "The joint gives way under its torque, and its rotor runs ahead of it; the link's side is measured.",
        f"{drive.name} = J theta'' + torque of the bodies = k e + d e', e = theta - {channel.name}",
        faster,
    )
    of_link = _effect(LINK_SIDE, [rotor, lag], words)

    def springs(effect: Effect, made: Callable[[ArmRun], Spring]) -> Wide:
        def stiff(run: ArmRun) -> FloatArray:
            """Return the torque of a stiff spring in proportion to its first parameter, and none for the lag."""
            spring = made(run)
            small = ARM_POLICY.small_spring * spring.starts()[-1][effect.parameter_names[0]]
            first = spring(np.array([small, ARM_POLICY.least_lag])) / small
            return np.stack([first, np.zeros_like(first)], axis=2)

        return Wide(Placed(effect, channel.name), stiff, False, made)

    return [springs(of_motor, swinging(arm, k)), springs(of_link, ahead(arm, k))]


def _tensor(joint: Joint) -> Effect:
    """Return the effect of an inertia tensor that the URDF does not state.

    A factor on one that it does state is not tried: at a joint of next to no inertia the noise of its acceleration asks
    for none.
    """
    moment = _par("I", "kg m^2", "moment of inertia about every axis", joint.mass * ARM_POLICY.gyration**2, sign="+")
    faster = "the same path at several speeds: what a tensor needs grows with the square of the speed, gravity stays"
    words = "The URDF gives this link no inertia tensor.", "inertia I about the centre of mass, as of a ball", faster
    return _effect("link_inertia", [moment], words, same_as=BODIES)


def _turning(arm: ArmModel, number: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a ball's inertia in the place of one link's."""
    own = np.zeros_like(arm.arm.parameters)
    own[10 * number + 4 : 10 * number + 10] = np.eye(3)[np.triu_indices(3)]
    return lambda run: arm.torques(run.calm.q, run.calm.v, run.calm.a, parameters=own)[:, :, None]


def _zero(arm: ArmModel, k: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a wrong joint zero: minus the gradient of the torques over that joint's position."""
    return lambda run: -torque_gradient(arm, run.calm, k, 0)[:, :, None]


def _gain(arm: ArmModel, k: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of a wrong torque gain: what the motion needs, for no torque explains itself."""

    def columns(run: ArmRun) -> FloatArray:
        m = run.calm
        result = np.zeros((*m.u.shape, 1))
        result[:, k, 0] = (arm.torques(m.q, m.v, m.a) + arm.damped(m.v))[:, k]
        return result

    return columns


def _link(arm: ArmModel, number: int) -> Callable[[ArmRun], FloatArray]:
    """Return the column of one link's mass and inertia."""
    own = np.zeros_like(arm.arm.parameters)
    own[10 * number : 10 * number + 10] = arm.arm.parameters[10 * number : 10 * number + 10]
    return lambda run: arm.torques(run.calm.q, run.calm.v, run.calm.a, parameters=own)[:, :, None]
