"""What must hold of every mechanism, over random arms: exactness, symmetries, ranks and bodies that can exist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harness.physics import lumped
from harness.physics.arms.mechanism import ArmMechanism
from harness.physics.arms.rigid_tree import Arm
from harness.physics.lumps.arm_lumps import ArmLumps
from harness.physics.lumps.identifiability import determined
from harness.physics.models import BUILT_IN
from harness.signals import PlantSpec, Trajectory
from harness.testing import arms, random_motion, random_rotation
from identifiers.mechanics.lumped import lumped_momentum
from identifiers.mechanics.motion import motion

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15, deadline=None)


def torques(arm, q, v, a, gravity=(0.0, 0.0, -9.81)):
    return arm.torques(q, v, a, gravity=gravity)


@FEW
@given(arms(), SEEDS)
def test_exact_data_give_exact_lumped_parameters(arm, seed):
    mechanism = ArmMechanism(arm)
    model = lumped(mechanism)
    q, v, a = random_motion(arm, 150, np.random.default_rng(seed))
    u = torques(arm, q, v, a) + arm.damped(v)
    fit = model.solve(*model.torque_rows(np.zeros(150), q, v, a, u))
    true = model.values(mechanism.system().values())
    assert fit.identifiability.rank == model.k
    np.testing.assert_allclose(list(fit.values.values()), true, atol=1e-7 * np.abs(true).max())


@FEW
@given(arms((1, 3), square=True))
def test_symbols_and_generated_code_find_the_same_number_of_base_parameters(arm):
    mechanism = ArmMechanism(arm)
    assume(mechanism.symbolic)
    written, generated = lumped(mechanism), ArmLumps(mechanism, {})
    assert written.k == len(generated.names)
    rng = np.random.default_rng(0)
    q, v, a = random_motion(arm, 60, rng)
    u = np.zeros((60, arm.n))
    own = written.regressor(q, v, a, u)
    (other,) = generated.functions["torque"](q, v, u, np.zeros((60, 1)), a)
    both = np.hstack([own, other.reshape(own.shape)])
    assert np.linalg.matrix_rank(both, tol=1e-8 * np.linalg.norm(both)) == written.k  # the same space


@FEW
@given(arms(), SEEDS)
def test_a_turned_base_with_turned_gravity_leaves_the_torques(arm, seed):
    rng = np.random.default_rng(seed)
    turn = random_rotation(rng)
    joints = tuple(
        replace(one, rotation=turn @ one.rotation, offset=turn @ one.offset) if one.parent < 0 else one
        for one in arm.arm.joints
    )
    turned = replace(arm, arm=Arm("turned", joints))
    q, v, a = random_motion(arm, 20, rng)
    expected = torques(arm, q, v, a)
    found = torques(turned, q, v, a, gravity=tuple(turn @ [0.0, 0.0, -9.81]))
    np.testing.assert_allclose(found, expected, atol=1e-10 * max(np.abs(expected).max(), 1.0))


@FEW
@given(arms(), SEEDS)
def test_the_frame_of_a_body_is_a_matter_of_words(arm, seed):
    """Turn the frame of every body, with its mass distribution, its axis and its children: nothing else changes."""
    rng = np.random.default_rng(seed)
    turns = [random_rotation(rng) for _ in arm.arm.joints]
    joints = []
    for one, turn in zip(arm.arm.joints, turns, strict=True):
        outer = np.eye(3) if one.parent < 0 else turns[one.parent]
        joints.append(
            replace(
                one,
                rotation=outer.T @ one.rotation @ turn,
                offset=outer.T @ one.offset,
                axis=turn.T @ one.axis,
                centre=turn.T @ one.centre,
                inertia=turn.T @ one.inertia @ turn,
            )
        )
    other = replace(arm, arm=Arm("other words", tuple(joints)))
    q, v, a = random_motion(arm, 20, rng)
    expected = torques(arm, q, v, a)
    np.testing.assert_allclose(torques(other, q, v, a), expected, atol=1e-10 * max(np.abs(expected).max(), 1.0))


@FEW
@given(arms((2, 5)), SEEDS)
def test_bodies_in_another_order_permute_torques_and_regressor(arm, seed):
    rng = np.random.default_rng(seed)
    joints, order = arm.arm.joints, []
    while len(order) < len(joints):  # a random order with parents before children
        ready = [k for k, one in enumerate(joints) if k not in order and (one.parent < 0 or one.parent in order)]
        order.append(int(rng.choice(ready)))
    place = {old: new for new, old in enumerate(order)}
    mixed = tuple(replace(joints[k], parent=place.get(joints[k].parent, -1)) for k in order)
    moving = [k for k, one in enumerate(joints) if one.kind != "fixed"]
    coordinates = [moving.index(k) for k in order if k in moving]
    q, v, a = random_motion(arm, 15, rng)
    expected = torques(arm, q, v, a)[:, coordinates]
    other = Arm("mixed", mixed)
    moved = [part[:, coordinates] for part in (q, v, a)]
    W = other.regressor(*moved)
    np.testing.assert_allclose(
        (W @ other.parameters).reshape(15, -1), expected, atol=1e-9 * max(np.abs(expected).max(), 1)
    )
    columns = np.concatenate([np.arange(10 * k, 10 * k + 10) for k in order])
    own = arm.arm.regressor(q, v, a).reshape(15, arm.n, -1)[:, coordinates][:, :, columns]
    np.testing.assert_allclose(W.reshape(own.shape), own, atol=1e-10 * max(np.abs(own).max(), 1.0))


@FEW
@given(arms((1, 4), square=True), SEEDS, st.floats(0.1, 10), st.floats(0.1, 10))
def test_units_scale(arm, seed, heavier, longer):
    """Kilograms and metres by other units: torques scale by mass times length squared (forces by one length less)."""
    joints = tuple(
        replace(
            one,
            offset=longer * one.offset,
            mass=heavier * one.mass,
            centre=longer * one.centre,
            inertia=heavier * longer**2 * one.inertia,
        )
        for one in arm.arm.joints
    )
    scaled = replace(arm, arm=Arm("scaled", joints))
    rng = np.random.default_rng(seed)
    slides = np.array([one.kind == "prismatic" for one in arm.arm.moving])
    q, v, a = random_motion(arm, 10, rng)
    size = np.where(slides, longer, 1.0)
    found = torques(scaled, q * size, v * size, a * size, gravity=(0.0, 0.0, -9.81 * longer))
    expected = torques(arm, q, v, a) * heavier * longer**2 / size
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * max(np.abs(expected).max(), 1e-9))


@FEW
@given(arms((2, 4)), SEEDS, st.sampled_from([0.0, 1e-12, 1e-9, 1e-6]))
def test_what_a_motion_does_not_show_is_named_under_tiny_noise_too(arm, seed, noise):
    """The last joint stands still: what only its motion shows is not determined, whatever the numerical rank."""
    assume(arm.n >= 2)
    rng = np.random.default_rng(seed)
    q, v, a = random_motion(arm, 120, rng)
    q[:, -1], v[:, -1], a[:, -1] = 0.3, 0.0, 0.0
    model = lumped(ArmMechanism(arm))
    exact = model.regressor(q, v, a)
    size = noise * np.maximum(np.abs(exact).max(), 1.0)
    rows, again = (exact + size * rng.normal(size=exact.shape) for _ in range(2))
    decision, kept, _ = determined(rows, model.names, again - exact if noise else None)
    assert not decision.full
    assert {f"damping{arm.n}", f"friction{arm.n}"} <= set(decision.undetermined)
    assert kept.shape == (model.k, decision.rank)
    assert len(decision.null_directions) == model.k - decision.rank
    assert decision.rank == determined(exact, model.names)[0].rank


@settings(max_examples=8, deadline=None)
@given(st.sampled_from(["pendulum", "double-pendulum", "oscillator"]), SEEDS)
def test_no_equation_reaches_across_two_records(name, seed):
    system = BUILT_IN[name]().system()
    n, rng = len(system.coordinates), np.random.default_rng(seed)
    simulator = system.simulator(0.01, substeps=4, backend="casadi")
    records = []
    for _ in range(2):
        u = np.repeat(rng.normal(size=(20, system.nu)), 10, axis=0)
        y = simulator.rollout(system.vector(), 0.3 * rng.normal(size=2 * n), u)
        records.append(Trajectory(np.arange(200) * 0.01, u, y, PlantSpec(system.inputs, system.outputs, 0.01)))
    identifier = lumped_momentum(name)
    regression = identifier.regression_of(system)

    def equations(part):
        return identifier.stacked(regression, [motion(system, one) for one in part], part)

    both, apart = equations(records), [equations([one]) for one in records]
    for column in (0, 1):
        np.testing.assert_array_equal(both[column], np.concatenate([one[column] for one in apart]))
