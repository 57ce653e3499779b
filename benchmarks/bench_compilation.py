"""Compiled roll-outs with sensitivities as gcc is told to make them, against the same C code without what it is told.

Run ``python benchmarks/bench_compilation.py``. Claims: without the passes that straight-line code gains nothing from,
gcc takes at most 0.85 of its CPU and the roll-outs at most 1.1 of theirs; and the flag that has gcc clear the upper
halves of the wide registers before it calls tanh or log1p costs at most a tenth anywhere. Neither changes a bit. Some
processors need the flag: on the one that showed it, a saturation took 36 ms without and 7.8 ms with it. Others do not
care: an AMD EPYC with AVX-512 gives ratios of 0.96 to 1.08. Best of many turns, taken alternately.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
from typing import Any
from unittest.mock import patch

import numpy as np
from timing import least_times, verdict

from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled import compilation
from harness.physics.compiled.simulator import Simulator

SAMPLES, DT, TURNS, BUILDS = 5000, 0.004, 40, 5
PLACED = {"nothing": None, "coulomb_friction": "x", "stribeck_friction": "x", "dead_zone": "u", "saturation": "u"}


def simulator(name: str, **instead: Any) -> tuple[Simulator, float]:
    """Return the simulator of a cart-pole with an effect, told otherwise, and the CPU seconds of its compiler."""
    cart_pole = load_model("cart-pole")
    place = PLACED[name]
    system = cart_pole if place is None else compose(cart_pole, [Placed(builtin()[name], place)])
    seconds = np.inf
    for _ in range(BUILDS):
        with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, SYSID_HARNESS_CACHE=folder):
            with patch.multiple(compilation, LEFT_OUT=compilation.LEFT_OUT, **instead):
                made = Simulator(system, DT, backend="c")
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                made.library(sensitivities=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = min(seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return made, seconds


def run(made: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and sensitivities of one window under noise."""
    u = 2.0 * np.random.default_rng(0).normal(size=(1, SAMPLES, 1))
    _, y, s = made.windows(made.system.vector()[None], np.full((1, made.nx), 0.1), u, None, np.zeros(1))
    assert s is not None
    return y, s


def compared(**instead: Any) -> tuple[bool, float, float]:
    """Print both for each effect; return whether no bit differs, and the worst ratios of gcc and of roll-outs."""
    same, worst = True, [0.0, 0.0]
    for name in PLACED:
        (made, compiled), (other, before) = simulator(name), simulator(name, **instead)
        best, (ours, theirs) = least_times(lambda one=made: run(one), lambda one=other: run(one), rounds=TURNS)
        same &= all(np.array_equal(a, b, equal_nan=True) for a, b in zip(ours, theirs, strict=True))
        ratios = compiled / before, best[0] / best[1]
        worst = [max(a, b) for a, b in zip(worst, ratios, strict=True)]
        print(
            f"  {name:18s} gcc {before:.3f} -> {compiled:.3f} s ({ratios[0]:.2f}), "
            f"roll-out {1e3 * best[1]:.2f} -> {1e3 * best[0]:.2f} ms ({ratios[1]:.2f})"
        )
    return same, worst[0], worst[1]


def main() -> int:
    print(f"cart-pole, {SAMPLES} samples of {DT:g} s, states and sensitivities; passes left out")
    same, gcc, rollouts = compared(_shortened=lambda level: ())
    holds = verdict(same and gcc <= 0.85 and rollouts <= 1.1, "the same bits, gcc at most 0.85, roll-outs at most 1.1")
    flags = compilation._machine_flags()
    if len(flags) < 2:
        print("this processor has no wide registers: nothing is claimed of the flag")
        return int(not holds)
    print("with the flag of wide registers")
    same, _, rollouts = compared(_machine_flags=lambda: flags[:1])
    return int(not (verdict(same and rollouts <= 1 / 0.9, "the same bits, at most a tenth longer") and holds))


if __name__ == "__main__":
    sys.exit(main())
