"""Compiled roll-outs with sensitivities against the same C code compiled without a flag, in one process.

Run ``python benchmarks/bench_rollouts.py``. The flag has gcc clear the upper halves of the wide registers before it
calls tanh or log1p. Some processors need it: on the one that showed it, a saturation took 36 ms without and 7.8 ms
with it. Others do not care: an AMD EPYC with AVX-512 gives ratios of 0.96 to 1.08. Claim: the flag changes no bit and
costs at most a tenth anywhere. Best of many turns, taken alternately.
"""

from __future__ import annotations

import sys
import time
from unittest.mock import patch

import numpy as np

from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled import compilation
from harness.physics.compiled.simulator import Simulator

SAMPLES, DT, TURNS = 5000, 0.004, 40
PLACED = {
    "nothing": None,
    "coulomb_friction": "x",
    "stribeck_friction": "x",
    "dead_zone": "u",
    "saturation": "u",
}
CLAIM = 0.9


def simulator(name: str, flags: tuple[str, ...]) -> Simulator:
    """Return the simulator of a cart-pole with an effect, compiled with these flags."""
    cart_pole = load_model("cart-pole")
    place = PLACED[name]
    system = cart_pole if place is None else compose(cart_pole, [Placed(builtin()[name], place)])
    with patch.object(compilation, "_machine_flags", lambda: flags):
        made = Simulator(system, DT, backend="c")
        run(made, 2)
    return made


def run(made: Simulator, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and sensitivities of one window under noise."""
    system = made.system
    p = system.vector()[None]
    u = 2.0 * np.random.default_rng(0).normal(size=(1, samples, 1))
    _, y, s = made.windows(p, np.full((1, made.nx), 0.1), u, None, np.zeros(1))
    assert s is not None
    return y, s


def main() -> int:
    flags = compilation._machine_flags()
    if len(flags) < 2:
        print("this processor has no wide registers: nothing is claimed")
        return 0
    print(f"cart-pole, {SAMPLES} samples of {DT:g} s, states and sensitivities")
    holds = True
    for name in PLACED:
        made = simulator(name, flags), simulator(name, flags[:1])
        best = [np.inf, np.inf]
        for _ in range(TURNS):
            for place, one in enumerate(made):
                began = time.perf_counter()
                run(one, SAMPLES)
                best[place] = min(best[place], time.perf_counter() - began)
        same = all(np.array_equal(a, b) for a, b in zip(run(made[0], SAMPLES), run(made[1], SAMPLES), strict=True))
        ratio = best[1] / best[0]
        holds = holds and same and ratio >= CLAIM
        bits = "same bits" if same else "OTHER NUMBERS"
        times = f"{1e3 * best[0]:7.2f} ms   without the flag {1e3 * best[1]:7.2f} ms"
        print(f"  {name:18s} {times}   {ratio:5.2f} times   {bits}")
    print(f"  {'holds ' if holds else 'MISSED'} the same bits, and at least {CLAIM:g} times as fast")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
