"""FMU plants against fmpy's own ways of stepping the same FMU, side by side in one process.

Claims: a step costs at most 2.5 us; an open-loop rollout of 1e4 steps is at least 5 times faster than simulate_fmu;
the same rollout in a child process costs less than twice the direct one.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable

import numpy as np
from timing import least_times, verdict

from harness.protocols import Plant
from plants.fmu.mockups import pendulum_fmu
from plants.fmu.plant import FmuPlant
from plants.isolation.isolated import IsolatedPlant
from plants.mockups import mockup

N = 10_000
DT = 0.01


def fmpy_methods(path: str, version: int, u: np.ndarray) -> tuple[Callable[[], float], Callable[[], None]]:
    """Return a run of N steps through the methods of fmpy's slave classes, and what frees it."""
    import fmpy
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    description = fmpy.read_model_description(path)
    folder = fmpy.extract(path)
    names = {v.name: v.valueReference for v in description.modelVariables}
    fmu = (FMU2Slave if version == 2 else FMU3Slave)(
        guid=description.guid, unzipDirectory=str(folder), modelIdentifier="Pendulum", instanceName="bench"
    )
    fmu.instantiate()
    vr_u, vr_y = [names["u"]], [names["theta"], names["omega"]]
    vr_substep = [names["substep"]]

    def run() -> float:
        fmu.reset()
        put, get = (fmu.setReal, fmu.getReal) if version == 2 else (fmu.setFloat64, fmu.getFloat64)
        if version == 2:
            fmu.setupExperiment()
        put(vr_substep, [DT])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        for k in range(N):
            put(vr_u, [u[k]])
            fmu.doStep(k * DT, DT)
            y = get(vr_y)
        return float(y[0])

    def free() -> None:
        fmu.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)

    return run, free


def main() -> int:
    import fmpy

    t = DT * np.arange(N)
    u = 0.3 * np.sin(3.0 * t)
    rng = np.random.default_rng(0)
    worst = True
    for version in (2, 3):
        path = str(mockup("pendulum", version))
        signal = np.zeros(N, dtype=[("time", float), ("u", float)])
        signal["time"], signal["u"] = t, u
        plant = FmuPlant(path, sample_time=DT, outputs=["theta", "omega"], parameters={"substep": DT})
        rows = u.reshape(-1, 1)

        def stepping(plant: FmuPlant = plant, rows: np.ndarray = rows) -> np.ndarray:
            plant.reset(rng=rng)
            step = plant.step
            for row in rows:
                y = step(row)
            return y

        def rolling(plant: FmuPlant = plant, rows: np.ndarray = rows) -> np.ndarray:
            plant.reset(rng=rng)
            return plant.rollout(rows)

        def simulating(path: str = path, signal: np.ndarray = signal) -> object:
            return fmpy.simulate_fmu(
                path, stop_time=DT * N, output_interval=DT, input=signal, start_values={"substep": DT}, validate=False
            )

        methods, free = fmpy_methods(path, version, u)
        ours, theirs = stepping()[0], methods()
        assert abs(ours - theirs) < 1e-9, (ours, theirs)
        names = ("simulate_fmu", "fmpy's methods", "Plant.step", "Plant.rollout")
        jobs = (simulating, methods, stepping, rolling)
        costs = dict(zip(names, least_times(*jobs, clock=time.perf_counter)[0], strict=True))
        free()
        plant.close()
        apart = IsolatedPlant("pendulum-fmu", {"fmi": version})
        direct = pendulum_fmu(fmi=version)

        def both(one: Plant, rows: np.ndarray = rows) -> None:
            one.reset(rng=rng)
            one.rollout(rows)  # type: ignore[attr-defined]

        jobs = (lambda one=apart: both(one), lambda one=direct: both(one))
        (far, near), _ = least_times(*jobs, rounds=15, clock=time.perf_counter)
        apart.close()
        direct.close()
        print(f"FMI {version}.0, {N} steps, one RK4 step of a pendulum each")
        for name, cost in costs.items():
            print(f"  {name:15s} {1e6 * cost / N:8.3f} us a step   {costs['simulate_fmu'] / cost:7.1f}x simulate_fmu")
        step, ratio = 1e6 * costs["Plant.step"] / N, costs["simulate_fmu"] / costs["Plant.rollout"]
        print(f"  isolated rollout over direct rollout {far / near:.2f}")
        claims = {
            "step <= 2.5 us": step <= 2.5,
            "rollout >= 5x simulate_fmu": ratio >= 5,
            "isolated < 2x": far < 2 * near,
        }
        for claim, holds in claims.items():
            worst = verdict(holds, claim) and worst
    return 0 if worst else 1


if __name__ == "__main__":
    sys.exit(main())
