"""How far the engines are from the exact motion as their step falls: writes engines-agree.svg, prints the orders.

Run from the project's folder: ``python docs/engines_agree.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from harness.protocols import Plant
from plants.bullet.robots import one_joint_arm
from plants.equations.ode import cart_pole_ode, pendulum_ode
from plants.fmu.mockups import cart_pole_fmu, pendulum_fmu
from plants.pymunk.cart_pole import PymunkCartPole

SAMPLE_TIME = 0.02
SECONDS = 2.0
SUBSTEPS = (1, 2, 4, 8, 16, 32, 64)
CART = {"mc": 1.0, "mp": 0.2, "l": 0.5, "bx": 0.2, "btheta": 0.005}
ARM = {"J": 0.25, "b": 0.02, "mgl": 9.81 * 0.5}  # 1 kg at 0.5 m
START = {"theta": 1.0}
Make = Callable[[int], Plant]


def force(k: int) -> float:
    """Return what acts over sample k [N or N m]."""
    return float(np.sin(2.5 * k * SAMPLE_TIME))


def cart_pole(_t: float, s: np.ndarray, u: float) -> list[float]:
    """Return the rates of x, theta and their rates."""
    _, theta, v, w = s
    mc, mp, length, bx, b = CART.values()
    sine, cosine = np.sin(theta), np.cos(theta)
    push, torque = u - bx * v + mp * length * w**2 * sine, -b * w - mp * 9.81 * length * sine
    dv = (push - cosine * torque / length) / (mc + mp * sine**2)
    return [v, w, dv, torque / (mp * length**2) - cosine * dv / length]


def pendulum(_t: float, s: np.ndarray, u: float) -> list[float]:
    """Return the rates of theta and its rate."""
    return [s[1], (u - ARM["b"] * s[1] - ARM["mgl"] * np.sin(s[0])) / ARM["J"]]


def exact(rates: Callable[..., list[float]], state: list[float], row: int) -> np.ndarray:
    """Return theta at the samples to 1e-11, the input held over each of them."""
    angles, now = [state[row]], np.array(state)
    for k in range(round(SECONDS / SAMPLE_TIME)):
        now = solve_ivp(
            rates, (0, SAMPLE_TIME), now, method="DOP853", rtol=1e-12, atol=1e-13, max_step=0.005, args=(force(k),)
        ).y[:, -1]
        angles.append(now[row])
    return np.array(angles)


def moved(plant: Plant) -> np.ndarray:
    """Return theta of an engine at the same samples."""
    column = [channel.name for channel in plant.spec.outputs].index("theta")
    rows = [plant.reset(rng=np.random.default_rng(0), x0=START)[column]]
    for k in range(round(SECONDS / SAMPLE_TIME)):
        rows.append(plant.step(np.array([force(k)]))[column])
    return np.array(rows)


def engines() -> dict[str, tuple[np.ndarray, Mapping[str, Make]]]:
    """Return for each machine its exact motion and its engines, each made from the steps in a sample."""
    dt = SAMPLE_TIME
    return {
        "cart-pole": (
            exact(cart_pole, [0.0, START["theta"], 0.0, 0.0], 1),
            {
                "pymunk": lambda n: PymunkCartPole(sample_time=dt, substeps=n, **CART),
                "FMU (C)": lambda n: cart_pole_fmu(sample_time=dt, substep=dt / n * (1 + 1e-9), **CART),
                "ODE": lambda n: cart_pole_ode(sample_time=dt, substeps=n, parameters=CART),
            },
        ),
        "pendulum": (
            exact(pendulum, [START["theta"], 0.0], 0),
            {
                "Bullet": lambda n: one_joint_arm(sample_time=dt, substeps=n, joint_damping=ARM["b"]),
                "FMU (C)": lambda n: pendulum_fmu(sample_time=dt, substep=dt / n * (1 + 1e-9), **ARM),
                "ODE": lambda n: pendulum_ode(sample_time=dt, substeps=n, parameters=ARM),
            },
        ),
    }


def measured() -> dict[str, dict[str, np.ndarray]]:
    """Return the largest errors of theta [rad] by machine and engine, one for each number of steps."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for machine, (truth, makers) in engines().items():
        found[machine] = {}
        for name, make in makers.items():
            errors = []
            for n in SUBSTEPS:
                with make(n) as plant:
                    errors.append(float(np.abs(moved(plant) - truth).max()))
            found[machine][name] = np.array(errors)
    return found


def order(errors: np.ndarray) -> float:
    """Return the slope over the steps whose error is above what rounding leaves."""
    good = errors > 1e-9
    steps = SAMPLE_TIME / np.array(SUBSTEPS)
    return float(np.polyfit(np.log(steps[good])[-4:], np.log(errors[good])[-4:], 1)[0])


def draw(found: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Write the plot."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "engines", "svg.fonttype": "none", "font.size": 10})
    import matplotlib.pyplot as plt

    colours = {"pymunk": "#b3541e", "Bullet": "#7a3e9d", "FMU (C)": "#1b6ca8", "ODE": "#2e7d32"}
    marks = {"pymunk": "s", "Bullet": "D", "FMU (C)": "o", "ODE": "x"}
    steps = 1e3 * SAMPLE_TIME / np.array(SUBSTEPS)
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.2), sharey=True, layout="constrained")
    for axis, (machine, by_name) in zip(axes, found.items(), strict=True):
        for name, errors in by_name.items():
            style = {"mfc": "none", "ms": 9} if name == "FMU (C)" else {"ms": 6}
            label = f"{name}: order {order(errors):.1f}"
            axis.loglog(steps, errors, marker=marks[name], color=colours[name], label=label, **style)
        axis.set(title=machine, xlabel="step of the engine [ms]")
        axis.set_xticks([0.3, 1, 3, 10, 20], ["0.3", "1", "3", "10", "20"])
        axis.minorticks_off()
        axis.grid(True, which="major", color="#dddddd", lw=0.6)
        axis.legend(frameon=False, loc="lower right")
    axes[0].set_ylabel("largest error of theta in 2 s [rad]")
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    """Print the table and write the plot."""
    found = measured()
    print("| machine | engine | " + " | ".join(f"{1e3 * SAMPLE_TIME / n:.3g} ms" for n in SUBSTEPS) + " | order |")
    print("|---" * (len(SUBSTEPS) + 3) + "|")
    for machine, by_name in found.items():
        for name, errors in by_name.items():
            print(f"| {machine} | {name} | " + " | ".join(f"{e:.1e}" for e in errors) + f" | {order(errors):.2f} |")
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("engines-agree.svg")
    draw(found, target)
    print(f"wrote {target}")


if __name__ == "__main__":
    main()
