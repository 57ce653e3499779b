"""A step of the ODE cart-pole (four Runge-Kutta steps, checked input) against gymnasium's CartPole (one Euler step).

Run ``python benchmarks/bench_ode_step.py``: alternating in one process, minima of the rounds. Claim: at most as long as
gymnasium's. What the step spends outside its compiled engine is printed too.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np

from plants.equations.ode import cart_pole_ode

ROUNDS, CALLS = 40, 2000
CLAIM = 1.0


def time_of(call: Callable[[], object]) -> float:
    """Return the time of one call [us]."""
    began = time.perf_counter()
    for _ in range(CALLS):
        call()
    return 1e6 * (time.perf_counter() - began) / CALLS


def main() -> int:
    plant = cart_pole_ode(sample_time=0.02)
    plant.reset(rng=np.random.default_rng(0))
    step = partial(plant.step, np.array([0.1]))
    step()
    peer = gymnasium.make("CartPole-v1").unwrapped
    peer.reset(seed=0)
    peer.theta_threshold_radians = peer.x_threshold = float("inf")  # it goes on, as ours does
    times = [(time_of(step), time_of(partial(peer.step, 1)), time_of(plant._engine._call)) for _ in range(ROUNDS)]
    ours, theirs, inside = (min(column) for column in zip(*times, strict=True))
    print(f"cart-pole: ours {ours:.2f} us, gymnasium {theirs:.2f} us: {ours / theirs:.2f} times")
    print(f"  ours inside the compiled engine {inside:.2f} us, outside {ours - inside:.2f} us")
    holds = ours <= CLAIM * theirs
    print(f"  {'holds ' if holds else 'MISSED'} at most {CLAIM:g} times gymnasium's step")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
