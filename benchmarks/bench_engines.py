"""What a plant's step costs over the raw calls of its engine, in one process; and the engines' own error by step size.

Run ``python benchmarks/bench_engines.py``. Claims: PyBullet iiwa at most 1.10 times the raw calls (set torques, step,
read the joints) made by hand on the same arm with its shapes loaded, as ``loadURDF`` does; pymunk cart-pole at most 1.5
times (set the force, step, read two coordinates); MuJoCo at most 1.10 times (set the controls, ``mj_step``, read the
positions and rates). Both sides are checked to move alike. The plant leaves out collision
shapes where nothing can be touched; the second figure of an arm is against hand-written calls on that lighter world.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from timing import least_times

from plants.bullet.engine import bullet, data_file, explicit_urdf
from plants.bullet.robots import ArmPlant, iiwa, one_joint_arm
from plants.bullet.world import World
from plants.mujoco.plant import MujocoPlant
from plants.mujoco.robots import one_joint_arm as arm_mujoco
from plants.pymunk.cart_pole import PymunkCartPole

pybullet = bullet()
STEPS = 2000
ROUNDS = 15


def per_step(*jobs: Callable[[], object]) -> list[float]:
    """Return the least time of each job in microseconds a step."""
    return [1e6 * one / STEPS for one in least_times(*jobs, rounds=ROUNDS, clock=time.perf_counter)[0]]


def by_hand(world: World, torques: list[list[float]]) -> list[float]:
    """Make the raw engine calls and return the last joint positions."""
    body, joints, client = world.body, world.joints, world.client
    calls = world.settings.substeps if world.settings.split else 1
    for row in torques:
        for _ in range(calls):
            pybullet.setJointMotorControlArray(
                body, joints, pybullet.TORQUE_CONTROL, forces=row, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
        states = pybullet.getJointStates(body, joints, physicsClientId=client)
    return [state[0] for state in states]


def arm(plant: ArmPlant, inputs: np.ndarray) -> None:
    """Compare an arm with the engine's calls made by hand, on the file's shapes and on the plant's own world."""
    damping = plant.declared["joint_damping"]
    full = World(explicit_urdf(data_file("kuka_iiwa", "model.urdf"), damping=damping), plant._world.settings)
    torques, ends = inputs.tolist(), {}

    def ours() -> None:
        plant.reset(rng=np.random.default_rng(0))
        for u in inputs:
            y = plant.step(u)
        ends["ours"] = y[:7].tolist()

    def raw(world: World) -> None:
        world.set_joints(plant._home.tolist(), [0.0] * 7)
        ends[id(world)] = by_hand(world, torques)

    mine, stock, light = per_step(ours, lambda: raw(full), lambda: raw(plant._world))
    full.close()
    assert len(set(map(tuple, ends.values()))) == 1, "all three must move alike, bit for bit"
    name = f"iiwa-bullet, {plant.declared['substeps']} substeps, damping {damping[0]:g}"
    report(name, mine, stock, 1.10)
    print(f"{'':47s} against calls on the world without shapes ({light:.2f} us): {mine / light:.3f}")


def cart_pole(plant: PymunkCartPole, inputs: np.ndarray) -> None:
    """Compare the cart-pole with the same engine calls made by hand."""
    forces, dt, substeps = inputs[:, 0].tolist(), plant._dt, plant._substeps

    def ours() -> None:
        plant.reset(rng=np.random.default_rng(0))
        for u in inputs:
            plant.step(u)

    def raw() -> None:
        plant.reset(rng=np.random.default_rng(0))
        space, cart, pole = plant._space, plant._cart, plant._pole
        for force in forces:
            for _ in range(substeps):
                cart.force = (force, 0.0)
                space.step(dt)
            _ = cart.position.x, pole.angle

    report(f"cart-pole-pymunk, {substeps} substeps", *per_step(ours, raw), 1.5)


def robot(name: str, plant: MujocoPlant, inputs: np.ndarray) -> None:
    """Compare a robot in MuJoCo with the engine's calls made by hand on its own model."""
    import mujoco

    model, substeps, ends = plant._model, plant.declared["substeps"], {}
    data, first = mujoco.MjData(model), len(plant._inputs.controls)

    def ours() -> None:
        plant.reset(rng=np.random.default_rng(0))
        for u in inputs:
            y = plant.step(u)
        ends["ours"] = y.tolist()

    def raw() -> None:
        mujoco.mj_resetData(model, data)
        held = data.ctrl if first else data.qfrc_applied
        for u in inputs:
            held[:] = u
            mujoco.mj_step(model, data, substeps)
            q, v = data.qpos.copy(), data.qvel.copy()
        ends["raw"] = [*q, *v]

    mine, stock = per_step(ours, raw)
    assert ends["ours"] == ends["raw"], "both must move alike, bit for bit"
    report(f"{name}, {substeps} substeps", mine, stock, 1.10)


def report(name: str, ours: float, raw: float, limit: float) -> None:
    ratio = ours / raw
    verdict = "reached" if ratio <= limit else "MISSED"
    print(f"{name:47s} {ours:6.2f} us a step, raw {raw:6.2f} us, ratio {ratio:.3f} (claim <= {limit}: {verdict})")


def pendulum_error(substeps: int) -> float:
    """Return the largest error [rad] of the undamped one-joint arm, swinging 5 s from 1 rad."""
    with one_joint_arm(sample_time=0.02, substeps=substeps) as plant:
        plant.reset(rng=np.random.default_rng(0), x0={"theta": 1.0})
        ours = plant.rollout(np.zeros((250, 1)))[:, 0]
        p = plant.true_parameters
    t = np.arange(1, 251) * 0.02
    exact = solve_ivp(
        lambda _, z: [z[1], -p["mgl"] / p["J"] * np.sin(z[0])], (0, 5), [1.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12
    )
    return float(np.abs(ours - exact.y[0]).max())


def cart_pole_error(substeps: int) -> float:
    """Return the largest error [rad] of the undamped cart-pole, swinging 5 s from 1 rad."""
    with PymunkCartPole(sample_time=0.02, substeps=substeps, bx=0.0, btheta=0.0) as plant:
        plant.reset(rng=np.random.default_rng(0), x0={"theta": 1.0})
        ours = plant.rollout(np.zeros((250, 1)))[:, 1]
        mc, mp, length, _, _ = plant.true_parameters.values()

    def rate(_: float, z: np.ndarray) -> list[float]:
        sine, cosine = np.sin(z[0]), np.cos(z[0])
        a = -((mc + mp) * 9.81 * sine + mp * length * z[1] ** 2 * sine * cosine) / (length * (mc + mp * sine**2))
        return [z[1], a]

    exact = solve_ivp(rate, (0, 5), [1.0, 0.0], t_eval=np.arange(1, 251) * 0.02, rtol=1e-10, atol=1e-12)
    return float(np.abs(ours - exact.y[0]).max())


def main() -> None:
    rng = np.random.default_rng(0)
    torques = rng.normal(size=(STEPS, 7)) * [30, 30, 10, 10, 3, 1, 0.1]
    for options in ({}, {"joint_damping": 0.0}, {"joint_damping": 0.0, "substeps": 1, "sample_time": 0.001}):
        with iiwa(**options) as plant:
            arm(plant, torques)
    for substeps in (20, 1):
        with PymunkCartPole(substeps=substeps, sample_time=0.0005 * substeps) as cart:
            cart_pole(cart, rng.normal(size=(STEPS, 1)))
    small = rng.normal(size=(STEPS, 1))
    for given in (
        {},
        {"substeps": 1, "sample_time": 0.001},
        {"substeps": 1, "sample_time": 0.001, "integrator": "euler"},
    ):
        with arm_mujoco(outputs=("q", "qd"), **given) as one:
            robot(f"arm-mujoco, {one.declared['integrator']}", one, small)
    for substeps in (4, 1):
        urdf = data_file("kuka_iiwa", "model.urdf")
        with MujocoPlant(urdf, sample_time=0.001 * substeps, substeps=substeps) as seven:
            robot("mjcf: iiwa", seven, torques * 0.01)
    print("largest error of a 5 s swing from 1 rad, undamped [rad], by engine step:")
    for substeps in (2, 4, 20, 100):
        print(
            f"  {20 / substeps:6.2f} ms: one-joint arm {pendulum_error(substeps):.2e}, "
            f"cart-pole {cart_pole_error(substeps):.2e}"
        )


if __name__ == "__main__":
    main()
