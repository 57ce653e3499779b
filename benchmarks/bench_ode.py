"""The ODE cart-pole against SciPy's solve_ivp, called anew for every hold, and a step of it against gymnasium's.

Run ``python benchmarks/bench_ode.py``. Claims: a step (four Runge-Kutta steps, checked input) takes at most as long as
gymnasium's CartPole (one Euler step), and 100 roll-outs of 1e4 samples at least 100 times faster than solve_ivp per
hold. solve_ivp is given a hand-written right-hand side in plain Python and its default method RK45, at two tolerances;
it is run on a part of the samples and its time is scaled up (it would take minutes). Errors of all are printed.
"""

from __future__ import annotations

import math
import sys
import time
from functools import partial

import gymnasium
import numpy as np
from scipy.integrate import solve_ivp
from timing import least_times, verdict

from plants.equations.ode import cart_pole_ode

RUNS, SAMPLES, PART, DT = 100, 10_000, 500, 0.01
ROUNDS, CALLS = 40, 2000
CLAIM = 100.0


def by_solve_ivp(values: dict[str, float], x0: list[float], u: np.ndarray, rtol: float, atol: float) -> np.ndarray:
    """Return the states after every hold."""
    mc, mp, length, bx, bt = (values[name] for name in ("mc", "mp", "l", "bx", "btheta"))

    def rates(_t: float, z: np.ndarray, force: float) -> list[float]:
        _, theta, v, w = z
        sine, cosine = math.sin(theta), math.cos(theta)
        a11, a12, a22 = mc + mp, mp * length * cosine, mp * length**2
        b1 = force - bx * v + mp * length * w * w * sine
        b2 = -bt * w - mp * 9.81 * length * sine
        det = a11 * a22 - a12 * a12
        return [v, w, (a22 * b1 - a12 * b2) / det, (a11 * b2 - a12 * b1) / det]

    x, rows = np.array(x0), []
    for force in u:
        x = solve_ivp(rates, (0.0, DT), x, args=(float(force),), rtol=rtol, atol=atol).y[:, -1]
        rows.append(x)
    return np.array(rows)


def step_holds() -> bool:
    """Print the times of one step, and whether ours takes no longer."""
    plant = cart_pole_ode(sample_time=0.02)
    plant.reset(rng=np.random.default_rng(0))
    step = partial(plant.step, np.array([0.1]))
    step()
    peer = gymnasium.make("CartPole-v1").unwrapped
    peer.reset(seed=0)
    peer.theta_threshold_radians = peer.x_threshold = float("inf")  # it goes on, as ours does

    def many(call: partial[object]) -> None:
        for _ in range(CALLS):
            call()

    jobs = [partial(many, call) for call in (step, partial(peer.step, 1), partial(plant._engine._call))]
    ours, theirs, inside = (1e6 * one / CALLS for one in least_times(*jobs, rounds=ROUNDS, clock=time.perf_counter)[0])
    print(f"cart-pole, a step: ours {ours:.2f} us, gymnasium {theirs:.2f} us: {ours / theirs:.2f} times")
    print(f"  ours inside the compiled engine {inside:.2f} us, outside {ours - inside:.2f} us")
    return verdict(ours <= theirs, "at most as long as gymnasium's step")


def main() -> int:
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(RUNS, SAMPLES, 1))
    plant = cart_pole_ode(sample_time=DT)
    start = {"theta": 0.5}
    plant.reset(rng=rng, x0=start)
    plant.rollout(inputs[0, :10])  # compiles, or loads what was compiled

    began = time.perf_counter()
    for run in range(RUNS):
        plant.reset(rng=rng, x0=start)
        plant.rollout_truth(inputs[run])
    ours = time.perf_counter() - began
    plant.reset(rng=rng, x0=start)
    _, x = plant.rollout_truth(inputs[0, :PART])

    values = plant.true_parameters
    truth = by_solve_ivp(values, [0.0, 0.5, 0.0, 0.0], inputs[0, :PART, 0], 1e-11, 1e-13)
    our_error = float(np.abs(x - truth).max())
    print(f"cart-pole, {RUNS} x {SAMPLES} samples of {DT:g} s, {plant.substeps} Runge-Kutta steps each")
    per_step = 1e6 * ours / (RUNS * SAMPLES)
    print(f"  ours                        {ours:8.2f} s   {per_step:8.3f} us a sample   error {our_error:.1e}")
    holds = True
    for rtol, atol in ((1e-3, 1e-6), (1e-6, 1e-8)):
        began = time.perf_counter()
        part = by_solve_ivp(values, [0.0, 0.5, 0.0, 0.0], inputs[0, :PART, 0], rtol, atol)
        one = (time.perf_counter() - began) / PART
        error = float(np.abs(part - truth).max())
        whole, ratio = one * RUNS * SAMPLES, one * RUNS * SAMPLES / ours
        holds = holds and ratio >= CLAIM
        print(
            f"  solve_ivp, rtol {rtol:g}       {whole:8.2f} s   {1e6 * one:8.3f} us a sample   error {error:.1e}   "
            f"{ratio:.0f} times ours (scaled up from {PART} samples)"
        )
    holds = verdict(holds, f"at least {CLAIM:g} times faster than solve_ivp for each hold")
    return 0 if step_holds() and holds else 1


if __name__ == "__main__":
    sys.exit(main())
