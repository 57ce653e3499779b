"""What a coupling costs: a coupled step against the same calls of the same parts written out by hand, in one process.

Claim: a coupled step adds at most 3 us a connection.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from timing import least_times

from harness.cosim import Connection, Coupled
from harness.protocols import Plant
from plants.fmu.mockups import cart_pole_fmu, pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.mockups import mockup

N = 1000
DT = 0.01
NOTHING = np.zeros(0)


def fmu(name: str, **parameters: float) -> FmuPlant:
    """Return one of our controllers or sensors."""
    outputs = ["y"] if name == "quantiser" else None
    return FmuPlant(mockup(name), sample_time=DT, parameters=parameters, outputs=outputs)


def start(plant: Plant) -> np.ndarray:
    return plant.reset(rng=np.random.default_rng(0))


def two_parts() -> tuple[Coupled, Callable[[], None], int]:
    """Return the loop of a pendulum and a PI controller, both FMUs: 3 connections."""

    def parts() -> dict[str, Plant]:
        return {"arm": pendulum_fmu(sample_time=DT), "law": fmu("pi_controller", Kp=2.0, Ki=1.0)}

    loop = Coupled(
        parts(),
        [
            Connection("set", "law.r"),
            Connection("arm.theta", "law.y"),
            Connection("law.u", "arm.u", gain_unit="N m"),
        ],
        inputs={"set": "law.r"},
        outputs=["arm.theta"],
    )
    own = parts()
    arm, law = own["arm"], own["law"]
    assert isinstance(law, FmuPlant)

    def by_hand() -> None:
        y = start(arm)
        start(law)
        u = law.output(np.array([0.5, y[0]]))
        for _ in range(N):
            y = arm.step(u)
            law.step(np.array([0.5, y[0]]))
            u = law.output(np.array([0.5, y[0]]))

    return loop, by_hand, 3


def chain(length: int) -> tuple[Coupled, Callable[[], None], int]:
    """Return pendulums in a row, each driven by the angle of the one before: ``length`` connections, no feedthrough."""

    def parts() -> dict[str, Plant]:
        return {f"p{i}": pendulum_fmu(sample_time=DT) for i in range(length)}

    wires = [Connection(f"p{i}.theta", f"p{i + 1}.u", gain_unit="N m") for i in range(length - 1)]
    row = Coupled(
        parts(), [Connection("push", "p0.u"), *wires], inputs={"push": "p0.u"}, outputs=[f"p{length - 1}.theta"]
    )
    own = list(parts().values())

    def by_hand() -> None:
        for plant in own:
            start(plant)
        push = np.array([0.5])
        for _ in range(N):
            y = push
            for plant in own:
                y = plant.step(y)

    return row, by_hand, length


def sensed() -> tuple[Coupled, Callable[[], None], int]:
    """Return a cart-pole seen through two sensors under state feedback, rates by differences: 9 connections."""

    def parts() -> dict[str, FmuPlant]:
        return {
            "cart": cart_pole_fmu(sample_time=DT),
            "ruler": fmu("quantiser", resolution=1e-4),
            "encoder": fmu("quantiser", resolution=1e-4),
            "law": fmu("state_feedback", K1=1.0, K2=0.5, K3=1.0, K4=0.1),
        }

    wires = [
        Connection("cart.x", "ruler.u", gain_unit="1/m"),
        Connection("cart.theta", "encoder.u"),
        Connection("law.u", "cart.u", gain_unit="N"),
        Connection("set", "law.r"),
        Connection("ruler.y", "law.x1"),
        Connection("encoder.y", "law.x2"),
        Connection("encoder.y", "law.x4", gain=0.0),
        Connection("ruler.y", "law.x3", gain=1 / DT, add=True),
        Connection("ruler.y", "law.x3", gain=-1 / DT, delay=1, add=True),
    ]
    loop = Coupled(parts(), wires, inputs={"set": "law.r"}, outputs=["cart.x"])
    own = parts()
    cart, ruler, encoder, law = own.values()

    def by_hand() -> None:
        y = start(cart)
        for plant in (ruler, encoder, law):
            start(plant)
        before = 0.0
        for k in range(N + 1):
            x, theta = ruler.output(y[:1])[0], encoder.output(y[1:])[0]
            seen = np.array([0.5, x, theta, (x - before) / DT, 0.0])
            u = law.output(seen)
            before = x
            if k < N:
                first, second = y[:1], y[1:]
                y = cart.step(u)
                ruler.step(first)
                encoder.step(second)
                law.step(seen)

    return loop, by_hand, len(wires)


def main() -> int:
    """Print the table; 1 if the claim does not hold."""
    worst = 0.0
    print(f"{'coupling':34} {'by hand':>9} {'coupled':>9} {'added':>9}   us a connection")
    for title, (coupled, by_hand, connections) in {
        "pendulum + PI controller (FMUs)": two_parts(),
        "cart-pole, 2 sensors, law (FMUs)": sensed(),
        "4 pendulum FMUs in a row": chain(4),
        "16 pendulum FMUs in a row": chain(16),
    }.items():

        def run(plant: Coupled = coupled) -> None:
            start(plant)
            u = np.array([0.5])
            for _ in range(N):
                plant.step(u)

        (plain, whole), _ = least_times(by_hand, run, rounds=40, clock=time.thread_time)
        added = (whole - plain) / N * 1e6
        worst = max(worst, added / connections)
        print(
            f"{title:34} {plain / N * 1e6:7.2f}us {whole / N * 1e6:7.2f}us {added:7.2f}us   {added / connections:.2f}"
        )
        coupled.close()
    print(f"worst: {worst:.2f} us a connection (claim: at most 3)")
    return int(worst > 3.0)


if __name__ == "__main__":
    sys.exit(main())
