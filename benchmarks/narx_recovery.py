"""Polynomial NARX beside sysidentpy: how often exactly the true terms are found, the free-run error, the CPU time.

    python benchmarks/narx_recovery.py [records]      (20 by default, of every row; seeds 10000 on)

Both choose from the same 84 terms (3 lags, degree 3) of the same records of 800 samples by forward regression with
orthogonal least squares; the peer with its BIC and plain least squares, and up to 15 terms as by default. The
free-run error is that on a record without noise, relative to the output, in the median; a run that diverges counts as
infinite. A peer that is not installed has a row that says so.
"""

from __future__ import annotations

import importlib.util
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harness.scoring import simulation_error
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.sparse.narx import Narx

SAMPLES, FRESH, BASE, LAGS, DEGREE = 800, 400, 10_000, 3, 3
SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
Terms = frozenset[tuple[int, ...]]


@dataclass(frozen=True)
class System:
    """The next output from ``y[k], y[k-1]`` and ``u[k], u[k-1]``, and its terms.

    Terms hold 1000 + lag of outputs and 2000 + lag of inputs, the lag counted from the output that they make.
    """

    ahead: Callable[[float, float, float, float], float]
    terms: Terms
    size: float = 1.0
    held: int = 1


def _terms(*given: tuple[int, ...]) -> Terms:
    return frozenset(tuple(sorted(one)) for one in given)


SYSTEMS = {
    "mixed": System(
        lambda y, z, u, v: 0.5 + 0.5 * y + 0.8 * v - 0.05 * z * z + u * u,
        _terms((), (1001,), (2002,), (1002, 1002), (2001, 2001)),
    ),
    "bilinear": System(
        lambda y, z, u, v: 0.75 * z + 0.25 * v - 0.2 * z * v, _terms((1002,), (2002,), (1002, 2002)), 0.8
    ),
    "cubic": System(
        lambda y, z, u, v: 0.6 * y - 0.2 * z + 0.5 * u - 0.1 * y**3, _terms((1001,), (1002,), (2001,), (1001,) * 3)
    ),
    "slow, held input": System(
        lambda y, z, u, v: 1.6 * y - 0.65 * z + 0.05 * u + 0.02 * u * u,
        _terms((1001,), (1002,), (2001,), (2001, 2001)),
        1.0,
        5,
    ),
}
NOISES = {"none": (0.0, 0.0), "process 2 %": (0.02, 0.0), "process 10 %": (0.1, 0.0), "sensor 2 %": (0.0, 0.02)}


def record(system: System, seed: int, n: int, process: float, sensor: float) -> Trajectory:
    """Return a record; the process noise is relative to the output's change from sample to sample."""
    rng = np.random.default_rng([BASE + seed, n])
    u = system.size * np.repeat(rng.uniform(-1, 1, n // system.held + 1), system.held)[:n]

    def run(size: float) -> FloatArray:
        y = np.zeros(n)
        for k in range(1, n - 1):
            y[k + 1] = system.ahead(y[k], y[k - 1], u[k], u[k - 1]) + size * noise[k]
        return y

    noise = rng.normal(size=n)
    y = run(process * float(np.diff(run(0.0)).std()))
    y = y + sensor * y.std() * rng.normal(size=n)
    return Trajectory(np.arange(n, dtype=float), u[:, None], y[:, None], SPEC)


def ours(prune: bool) -> Callable[[Trajectory, Trajectory], tuple[Terms, float]]:
    """Return what fits a record, and gives the terms and the free-run error."""

    def fit(data: Trajectory, fresh: Trajectory) -> tuple[Terms, float]:
        model = Narx(lags=LAGS, degree=DEGREE, prune=prune).fit([data], rng=np.random.default_rng(0))
        codes = {f"y[k{f'-{j}' if j else ''}]": 1001 + j for j in range(LAGS)}
        codes |= {f"u[k{f'-{j}' if j else ''}]": 2001 + j for j in range(LAGS)}
        found = []
        for name in model.terms[0]:
            parts = [] if name == "1" else [part.split("^") for part in name.split()]
            found.append(tuple(code for base, *power in parts for code in [codes[base]] * int((power or [1])[0])))
        return _terms(*found), float(simulation_error(model, fresh).nrmse[0])

    return fit


def peer(data: Trajectory, fresh: Trajectory) -> tuple[Terms, float]:
    """Return the same of the peer."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    model = FROLS(
        ylag=LAGS,
        xlag=LAGS,
        order_selection=True,
        info_criteria="bic",
        estimator=LeastSquares(),
        basis_function=Polynomial(degree=DEGREE),
    )
    # its output k answers inputs up to k - 1, as ours
    model.fit(X=data.u, y=data.y)
    found = _terms(*(tuple(int(code) for code in row if code) for row in model.final_model))
    run = np.asarray(model.predict(X=fresh.u, y=fresh.y[:LAGS]))[:, 0]
    wrong = (fresh.y[:, 0] - run)[LAGS:]
    error = float(np.sqrt(np.mean(wrong**2)) / fresh.y[:, 0].std())
    return found, error if np.isfinite(error) else np.inf


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    there = importlib.util.find_spec("sysidentpy") is not None
    who = {"narx": ours(True), "narx, prune=false": ours(False), **({"sysidentpy": peer} if there else {})}
    if not there:
        print("sysidentpy: not installed")
    print(f"{'system':18} {'noise':13} {'':18} {'exact':>7} {'free run':>10} {'CPU ms':>8}")
    for name, system in SYSTEMS.items():
        fresh = record(system, 999, FRESH, 0.0, 0.0)
        for kind, (process, sensor) in NOISES.items():
            for title, fit in who.items():
                exact, errors, spent = 0, [], []
                for seed in range(count):
                    data = record(system, seed, SAMPLES, process, sensor)
                    start = time.process_time()
                    with warnings.catch_warnings(), np.errstate(all="ignore"):
                        warnings.simplefilter("ignore")
                        terms, error = fit(data, fresh)
                    spent.append(time.process_time() - start)
                    exact += terms == system.terms
                    errors.append(error)
                row = f"{name:18} {kind:13} {title:18} {exact:>3}/{count:<3} {np.median(errors):>10.2g}"
                print(f"{row} {1e3 * np.median(spent):>8.0f}", flush=True)


if __name__ == "__main__":
    main()
