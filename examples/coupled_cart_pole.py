"""Four engines in one loop: a pymunk cart-pole, two quantising-sensor FMUs and a state-feedback FMU.

Their coupling is compared with the one ODE that it stands for. Both engines and both sensors are made finer row by row;
what is left is the error of the coupling itself. A second table makes the communication step finer: the sampled loop
comes to continuous state feedback, and the order of convergence is printed. ``coupled_cart_pole.toml`` is the same
coupling for the command line: ``sysid simulate examples/coupled_cart_pole.toml --scenario multisine``.
"""

import numpy as np
from scipy.integrate import solve_ivp

from harness.cosim import Connection, Coupled
from plants.fmu import FmuPlant
from plants.mockups import mockup
from plants.pymunk import PymunkCartPole

GAINS = {"K1": -1.414, "K2": 34.91, "K3": -3.151, "K4": 7.463}  # LQR on x, theta - pi and their rates
STATES = ["x1", "x2", "x3", "x4"]
SAMPLE_TIME = 0.01
NOTHING = np.zeros(0)  # the loop has no input from outside
START = 3.0  # theta [rad]; pi stands up


def coupled(substeps: int, resolution: float, step: float = SAMPLE_TIME) -> Coupled:
    """Return the loop: pymunk steps in a sample, size of a sensor's count [m and rad], communication step [s]."""
    sensor = {"sample_time": step, "outputs": ["y"]}
    parts = {
        "cart": PymunkCartPole(sample_time=step, substeps=substeps),
        "ruler": FmuPlant(mockup("quantiser"), parameters={"resolution": resolution}, **sensor),
        "encoder": FmuPlant(mockup("quantiser"), parameters={"resolution": resolution, "offset": -np.pi}, **sensor),
        "law": FmuPlant(mockup("state_feedback"), sample_time=step, inputs=STATES, parameters=GAINS),
    }
    wires = [
        Connection("cart.x", "ruler.u", gain_unit="1/m"),
        Connection("cart.theta", "encoder.u"),
        Connection("ruler.y", "law.x1"),
        Connection("encoder.y", "law.x2"),
        Connection("law.u", "cart.u", gain_unit="N"),
    ]
    for source, target in (("ruler.y", "law.x3"), ("encoder.y", "law.x4")):  # rates: differences over a sample
        wires.append(Connection(source, target, gain=1 / step, add=True))
        wires.append(Connection(source, target, gain=-1 / step, delay=1, add=True))
    return Coupled(parts, wires, outputs=["cart.x", "cart.theta", "law.u"])


def run(plant: Coupled, seconds: float = 5.0) -> np.ndarray:
    """Return x, theta, u at every sample (N, 3)."""
    samples = round(seconds / plant.spec.sample_time)
    plant.reset(rng=np.random.default_rng(0), x0={"cart.theta": START})
    rows = [plant.output(NOTHING)] + [plant.step(NOTHING) for _ in range(samples)]
    return np.array(rows)


def rates(_t: float, s: np.ndarray, u: float) -> list[float]:
    """Return the rates of x, theta, x', theta' under a force u: the cart-pole in one ODE."""
    mc, mp, length, bx, bt, g = 1.0, 0.2, 0.5, 0.2, 0.005, 9.81
    _x, theta, v, w = s
    sine, cosine = np.sin(theta), np.cos(theta)
    force, torque = u - bx * v + mp * length * w**2 * sine, -bt * w - mp * g * length * sine
    dv = (force - cosine * torque / length) / (mc + mp * sine**2)
    return [v, w, dv, torque / (mp * length**2) - cosine * dv / length]


def feedback(x: float, theta: float, dx: float, dtheta: float) -> float:
    """Return the force of the state feedback."""
    return -(GAINS["K1"] * x + GAINS["K2"] * (theta - np.pi) + GAINS["K3"] * dx + GAINS["K4"] * dtheta)


def monolith(seconds: float = 5.0) -> np.ndarray:
    """Return the same from the equations of motion in one ODE, with the same feedback held over every sample."""
    state, before = np.array([0.0, START, 0.0, 0.0]), np.array([0.0, START])
    rows = []
    for k in range(round(seconds / SAMPLE_TIME) + 1):
        x, theta = state[:2]
        dx, dtheta = (state[:2] - before) / SAMPLE_TIME
        u = feedback(x, theta, dx, dtheta)
        rows.append([x, theta, u])
        before = state[:2]
        span = (k * SAMPLE_TIME, (k + 1) * SAMPLE_TIME)
        state = solve_ivp(rates, span, state, method="DOP853", rtol=1e-11, atol=1e-12, args=(u,)).y[:, -1]
    return np.array(rows)


def table() -> list[tuple[int, float, float]]:
    """Return pymunk steps in a sample, size of a count, largest difference of theta [rad] from the one ODE."""
    truth = monolith()
    rows = []
    for substeps, resolution in ((1, 1e-2), (5, 1e-3), (25, 1e-4), (125, 1e-5), (625, 1e-6), (625, 1e-12)):
        with coupled(substeps, resolution) as plant:
            rows.append((substeps, resolution, float(np.abs(run(plant) - truth)[:, 1].max())))
    return rows


def convergence(seconds: float = 2.0) -> list[tuple[float, float, float]]:
    """Return communication step [s], largest difference of theta [rad] from continuous feedback, measured order."""
    rows: list[tuple[float, float, float]] = []
    for step in (0.02, 0.01, 0.005, 0.0025):
        times = np.arange(round(seconds / step) + 1) * step
        truth = solve_ivp(
            lambda t, s: rates(t, s, feedback(*s)),
            (0, seconds),
            [0.0, START, 0.0, 0.0],
            method="DOP853",
            t_eval=times,
            rtol=1e-10,
            atol=1e-12,
        ).y[1]
        with coupled(round(step / 2.5e-5), 1e-9, step) as plant:
            error = float(np.abs(run(plant, seconds)[:, 1] - truth).max())
        rows.append((step, error, np.log2(rows[-1][1] / error) if rows else np.nan))
    return rows


if __name__ == "__main__":
    print("pymunk step [s]   count [m, rad]   largest difference of theta from the one ODE [rad]")
    for substeps, resolution, error in table():
        print(f"{SAMPLE_TIME / substeps:15.2g}   {resolution:14.2g}   {error:.2e}")
    print("communication step [s]   largest difference of theta from continuous feedback [rad]   order")
    for step, error, order in convergence():
        print(f"{step:22.2g}   {error:61.2e}   {'' if np.isnan(order) else f'{order:5.2f}'}")
