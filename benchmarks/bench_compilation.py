"""Roll-outs compiled without the passes of gcc that straight-line code gains nothing from, against plain -O1.

Run ``python benchmarks/bench_compilation.py``. Claim: gcc takes at most 0.85 of its CPU, the roll-outs with
sensitivities at most 1.1 of theirs, and no bit changes. Best of many turns, taken alternately.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from unittest.mock import patch

import numpy as np

from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled import compilation
from harness.physics.compiled.simulator import Simulator

SAMPLES, DT, TURNS, BUILDS = 5000, 0.004, 40, 5
PLACED = {"nothing": None, "coulomb_friction": "x", "stribeck_friction": "x", "saturation": "u"}
COMPILES, RUNS = 0.85, 1.1


def simulator(name: str, left_out: tuple[str, ...]) -> tuple[Simulator, float]:
    """Return the simulator of a cart-pole with an effect, and the CPU seconds of its compiler."""
    cart_pole = load_model("cart-pole")
    place = PLACED[name]
    system = cart_pole if place is None else compose(cart_pole, [Placed(builtin()[name], place)])
    seconds = np.inf
    for _ in range(BUILDS):
        with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, SYSID_HARNESS_CACHE=folder):
            with patch.object(compilation, "_shortened", lambda level: left_out):
                made = Simulator(system, DT, backend="c")
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                made.library(sensitivities=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        seconds = min(seconds, used)
    return made, seconds


def run(made: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and sensitivities of one window under noise."""
    u = 2.0 * np.random.default_rng(0).normal(size=(1, SAMPLES, 1))
    _, y, s = made.windows(made.system.vector()[None], np.full((1, made.nx), 0.1), u, None, np.zeros(1))
    assert s is not None
    return y, s


def main() -> int:
    print(f"cart-pole, {SAMPLES} samples of {DT:g} s, states and sensitivities")
    worst = [0.0, 0.0]
    same = True
    for name in PLACED:
        short, compiled = simulator(name, compilation.LEFT_OUT)
        plain, before = simulator(name, ())
        same &= all(np.array_equal(a, b, equal_nan=True) for a, b in zip(run(short), run(plain), strict=True))
        best = [np.inf, np.inf]
        for _ in range(TURNS):
            for k, made in enumerate((short, plain)):
                began = time.process_time()
                run(made)
                best[k] = min(best[k], time.process_time() - began)
        ratios = compiled / before, best[0] / best[1]
        worst = [max(a, b) for a, b in zip(worst, ratios, strict=True)]
        print(
            f"{name:20s} gcc {before:.3f} -> {compiled:.3f} s ({ratios[0]:.2f}), "
            f"roll-out {1e3 * best[1]:.2f} -> {1e3 * best[0]:.2f} ms ({ratios[1]:.2f})"
        )
    good = same and worst[0] <= COMPILES and worst[1] <= RUNS
    print(f"same bits: {same}; claim {'holds' if good else 'FAILS'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
