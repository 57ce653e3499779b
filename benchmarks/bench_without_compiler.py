"""The loop on a machine without a C compiler against the loop on one with it: processor time of whole commands.

Run ``python benchmarks/bench_without_compiler.py`` (3 minutes). The system's compilers are hidden as an empty PATH
hides them (``SYSID_HARNESS_NO_COMPILER=system``), which leaves the small one installed with the package; without
that one too, CasADi's virtual machine does the work (``SYSID_HARNESS_NO_COMPILER=1``). Each loop runs twice and the
second time counts, when everything that is compiled is in the cache. Asked: at most 3 times with what the package
installs, and the same answer.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from timing import least_times, verdict

from harness.api import simulate
from harness.effects import builtin
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.physics import load_model
from harness.physics.compiled.kalman_pass import KalmanPass, PassNoise
from harness.physics.compiled.latent import with_latent_forces
from harness.signals import PlantSpec, Trajectory

ASKED = 3.0
CASES = {"pendulum": ("pendulum-ode", "theta", 0.05), "cart-pole": ("cart-pole-ode", "x", 0.3)}


def loop(folder: Path, model: str, without: str) -> tuple[float, list[str]]:
    """Return the processor time of a command [s] and the effects that it names."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = ["close-loop", "estimation.csv", "--validation", "validation.csv", "--model", model, "--out", "out"]
    environment = {**os.environ, "SYSID_HARNESS_NO_COMPILER": without, "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [sys.executable, "-m", "harness", *words, "--force"],
        cwd=folder,
        env=environment,
        check=True,
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    told = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, [effect["name"] for effect in told["effects"]]


def passes(model: str, port: str, samples: int = 1500, dt: float = 0.01) -> None:
    """Print the time of a pass over a record, alone and with all derivatives."""
    system = compose(load_model(model), [Placed(builtin()["coulomb_friction"], port)])
    rng, p, x0 = np.random.default_rng(0), system.vector(), np.full(system.nx, 0.1)
    u = 0.02 * np.cumsum(rng.standard_normal((samples, system.nu)), axis=0)
    y = system.simulator(dt).rollout(p, x0, u)
    spec = PlantSpec(system.inputs, system.outputs, dt)
    record = Trajectory(np.arange(samples) * dt, u, y + 1e-3 * rng.standard_normal(y.shape), spec)
    disturbed = with_latent_forces(system)
    ways = KalmanPass(disturbed, dt), KalmanPass(disturbed, dt, compiled=False)
    nl, ny, columns = ways[0].nl, ways[0].ny, np.arange(system.np + system.nx)
    noise = PassNoise(s=np.full(nl, 0.01), tau=np.full(nl, 0.1), w=np.zeros(nl), r=np.full(ny, 1e-3))
    for what, given in (("value", {}), ("all derivatives", {"columns": columns, "by_noise": True})):
        jobs = [lambda one=one, given=given: one(record, p, x0, noise, **given) for one in ways]
        best, _ = least_times(*jobs, rounds=6)
        print(
            f"  pass, {what:15s} {1e3 * best[0]:7.2f} ms   without {1e3 * best[1]:7.2f} ms   {best[1] / best[0]:5.1f}"
        )


def main() -> int:
    holds = True
    for model, (plant, port, size) in CASES.items():
        print(model)
        passes(model, port)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for role in ("estimation", "validation"):
                hidden = [("coulomb_friction", port, {"Fc": size})]
                options, file = {"noise": 1e-3}, folder / f"{role}.csv"
                simulate(plant, scenario="multisine", scenario_options=options, hide=hidden, role=f"{role}/0", out=file)
            loop(folder, model, "")
            loop(folder, model, "system")
            (cpu, names), (small, same), (slow, others) = (loop(folder, model, how) for how in ("", "system", "1"))
        holds = holds and small <= ASKED * cpu and names == same == others
        print(f"  close-loop {cpu:6.1f} s   with the small compiler {small:6.1f} s, {small / cpu:.1f} times", end="")
        print(f"   without any {slow:6.1f} s, {slow / cpu:.1f} times   {names} {same} {others}")
    return 0 if verdict(holds, f"at most {ASKED:g} times as long, and the same answer") else 1


if __name__ == "__main__":
    sys.exit(main())
