"""Two engines and a controller in one loop, against the same machine in one engine.

A MuJoCo arm with a finger; the finger's cable goes to a motor at the base, which is an FMU, and a controller FMU holds
the shoulder (``gripper_on_arm.toml``, for the command line: ``sysid simulate examples/gripper_on_arm.toml --scenario
multisine``). MuJoCo can hold the motor as one more body, the cable as a tendon, the controller as a servo: that is the
truth here. The communication step is made finer, row by row.
"""

from pathlib import Path
from typing import Literal

import numpy as np

from harness.cosim import Connection, Coupled
from plants.fmu import FmuPlant
from plants.mockups import mockup
from plants.mujoco import MujocoPlant

HERE = Path(__file__).parent
SECONDS, PULL = 1.0, 3.0  # duration; a constant force of the motor [N]


def whole() -> str:
    """Return the MJCF of everything: motor, cable and servo in MuJoCo."""
    text = (HERE / "gripper_arm.xml").read_text(encoding="utf-8")
    motor = (
        '<body name="motor" pos="0 0 2"><joint name="motor" type="slide" axis="1 0 0" damping="5"/>'
        '<inertial pos="0 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>'
        '<tendon><fixed stiffness="200" springlength="0"><joint joint="motor" coef="1"/>'
        '<joint joint="finger" coef="-1"/></fixed></tendon>'
    )
    servo = '<position joint="shoulder" kp="20"/><motor joint="motor"/></actuator>'
    return text.replace("</worldbody>", motor).replace("</actuator>", servo)


def truth(step: float) -> np.ndarray:
    """Return shoulder [rad], finger and motor [m] at every communication step (N, 3)."""
    fine = {"sample_time": step, "substeps": round(step / 1e-4), "outputs": ["q"], "shapes": False}
    with MujocoPlant(whole(), **fine) as plant:
        plant.reset(rng=np.random.default_rng(0), x0={"q1": 0.5})
        held = np.tile([0.0, 0.0, 0.0, PULL], (round(SECONDS / step), 1))
        return plant.rollout(held)


def coupled(step: float, order: Literal["gauss-seidel", "jacobi"]) -> np.ndarray:
    """Return the same of the coupling."""
    motor = {"M": 0.4, "ML": 0.1, "Fv": 5.0, "FvL": 0.0, "Fc": 0.0, "gap": 0.0}
    given = {"sample_time": step}
    parts = {
        "arm": MujocoPlant(HERE / "gripper_arm.xml", substeps=round(step / 1e-4), **given),
        "motor": FmuPlant(mockup("drive"), parameters=motor, **given),
        "law": FmuPlant(mockup("pi_controller"), parameters={"Kp": 20.0, "Ki": 0.0}, **given),
    }
    wires = [Connection("arm.q1", "law.y"), Connection("law.u", "arm.tau1", gain_unit="N m")]
    for end, other in (("arm.q2", "motor.q"), ("motor.q", "arm.q2")):  # the cable pulls both ends together
        force = {"arm.q2": "arm.tau2", "motor.q": "motor.u"}[end]
        wires.append(Connection(other, force, gain=200.0, gain_unit="N/m", add=True))
        wires.append(Connection(end, force, gain=-200.0, gain_unit="N/m", add=True))
    wires += [Connection("wish", "law.r"), Connection("pull", "motor.u", add=True)]
    inputs, outputs = {"wish": "law.r", "pull": "motor.u"}, ["arm.q1", "arm.q2", "motor.q"]
    with Coupled(parts, wires, inputs=inputs, outputs=outputs, order=order) as plant:
        plant.reset(rng=np.random.default_rng(0), x0={"arm.q1": 0.5})
        return np.array([plant.step(np.array([0.0, PULL])) for _ in range(round(SECONDS / step))])


def table(order: Literal["gauss-seidel", "jacobi"]) -> list[tuple[float, float, float]]:
    """Return communication step [s], largest difference of the finger [m], measured order."""
    rows: list[tuple[float, float, float]] = []
    for step in (0.008, 0.004, 0.002, 0.001):
        error = float(np.abs(coupled(step, order) - truth(step))[:, 1].max())
        rows.append((step, error, np.log2(rows[-1][1] / error) if rows else np.nan))
    return rows


if __name__ == "__main__":
    orders: tuple[Literal["gauss-seidel", "jacobi"], ...] = ("gauss-seidel", "jacobi")
    for order in orders:
        print(f"{order}: communication step [s]   largest difference of the finger [m]   order")
        for step, error, measured in table(order):
            print(f"{step:36.2g}   {error:36.2e}   {'' if np.isnan(measured) else f'{measured:5.2f}'}")
