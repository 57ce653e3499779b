"""Identifiers against their peers: the same work in one process, best of a few rounds, with the ratio.

Run ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_identifiers.py``; a peer that is not installed
(pysindy, pydmd) has a row that says so. Claims, on one thread: STLSQ more than 10 times, DMD with control about 10
times, Markov parameters about 50 times and more, ERA about 10 times from 1000 Markov parameters on (even below that) as
fast as the peer; both sides give the same numbers: the largest difference is printed. Counting is raced against a plain
Python loop.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.dmd import Dmdc
from identifiers.library import Library
from identifiers.mdp import count_transitions
from identifiers.online import RecursiveLeastSquares
from identifiers.sparse import NormalEquations, stlsq
from identifiers.subspace import markov_parameters, realize

RNG = np.random.default_rng(0)
BLOCK = 8192


def best(job: Callable[[], Any], rounds: int = 3) -> tuple[float, Any]:
    """Return the shortest CPU time [s] of a job and its result."""
    times, result = [], None
    for _ in range(rounds):
        start = time.process_time()
        result = job()
        times.append(time.process_time() - start)
    return max(min(times), 1e-9), result


def row(work: str, ours: float, peer: float | None, who: str, difference: float | None = None) -> None:
    """Print one line of the table."""
    if peer is None:
        print(f"{work:44s} {ours:10.4f} s   {who}: not installed")
        return
    equal = "" if difference is None else f"   largest difference {difference:.1e}"
    print(f"{work:44s} {ours:10.4f} s   {who} {peer:.4f} s   ratio {peer / ours:.1f}{equal}")


def have(package: str) -> bool:
    """Return True if a peer is installed."""
    return importlib.util.find_spec(package) is not None


def record(u: np.ndarray, y: np.ndarray) -> Trajectory:
    """Return a record of unnamed signals."""
    spec = PlantSpec(
        tuple(Channel(f"u{i}") for i in range(u.shape[1])), tuple(Channel(f"y{i}") for i in range(y.shape[1])), 1.0
    )
    return Trajectory(np.arange(len(y)) * 1.0, u, y, spec)


def sparse(samples: int) -> None:
    """STLSQ of 4 states on 126 functions; the peer gets the derivatives, so that both regress the same numbers."""
    x = RNG.normal(size=(samples, 4))
    rates = x @ RNG.normal(size=(4, 4)) + 0.5 * x[:, :1] * x[:, 1:2] + 0.01 * RNG.normal(size=(samples, 4))
    library = Library(("a", "b", "c", "d"), degree=5)

    def ours() -> np.ndarray:
        cuts = range(0, samples, BLOCK)
        blocks = ((library.rows(list(x[k : k + BLOCK].T)), rates[k : k + BLOCK].T) for k in cuts)
        return stlsq(NormalEquations.of(blocks, len(library), 4), 0.02)[0]

    own, found = best(ours)
    work = f"STLSQ, {len(library)} functions, N = {samples:.0e}"
    if not have("pysindy"):
        row(work, own, None, "pysindy")
        return
    import pysindy

    def peer() -> np.ndarray:
        model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=0.05, alpha=0.0), feature_library=pysindy.PolynomialLibrary(degree=5)
        )
        model.fit(x, t=1.0, x_dot=rates)
        return np.asarray(model.coefficients()).T

    other, theirs = best(peer, 1 if samples > 50_000 else 3)
    row(work, own, other, "pysindy", float(np.abs(found - theirs).max()))


def dmd(states: int, samples: int) -> None:
    """DMD with control of measured states."""
    a = np.linalg.qr(RNG.normal(size=(states, states)))[0] * 0.95
    b, y, u = RNG.normal(size=(states, 2)), np.zeros((samples, states)), RNG.normal(size=(samples, 2))
    disturbance = 0.1 * RNG.normal(size=(samples, states))
    for k in range(samples - 1):
        y[k + 1] = a @ y[k] + b @ u[k] + disturbance[k]
    data = record(u, y)
    own, model = best(lambda: Dmdc().fit([data], rng=RNG), 2)
    work = f"DMD with control, n = {states}, N = {samples:.0e}"
    if not have("pydmd"):
        row(work, own, None, "pydmd")
        return
    import pydmd

    def peer() -> Any:
        one = pydmd.DMDc(svd_rank=-1)
        return one.fit(y.T, u[:-1].T)

    other, theirs = best(peer, 1)
    values = np.sort(np.abs(np.asarray(theirs.eigs)))
    row(work, own, other, "pydmd", float(np.abs(values - np.sort(np.abs(model.eigenvalues))).max()))


def markov(lengths: tuple[int, ...], samples: int = 100_000) -> None:
    """Impulse responses of one input and one output."""
    import control
    from scipy.signal import lfilter

    u = RNG.normal(size=samples)
    y = lfilter([0, 1, 0.5], [1, -1.5, 0.7], u) + 0.1 * RNG.normal(size=samples)
    data = record(u[:, None], y[:, None])
    for length in lengths:
        own, found = best(lambda n=length: markov_parameters([data], n, offset=False)[0][:, 0, 0])
        other, theirs = best(lambda n=length: np.asarray(control.markov(y, u, m=n)).ravel(), 1)
        row(f"Markov parameters, N = 1e5, m = {length}", own, other, "control", float(np.abs(found - theirs).max()))


def era(lengths: tuple[int, ...]) -> None:
    """Realization of order 4 from noisy Markov parameters; the peer is told its window, whose default ignores most."""
    import control

    a, c = np.diag([0.95, 0.8, -0.5, 0.3]), np.array([[1.0, 2.0, 3.0, 4.0]])
    for length in lengths:
        powers = np.diag(a)[None] ** np.arange(length)[:, None]
        response = (powers @ c[0])[:, None, None] + 1e-4 * RNG.normal(size=(length, 1, 1))
        own, found = best(lambda g=response: realize(g, order=4)[0], 5)
        half = length // 2
        series = np.concatenate([[0.0], response[:, 0, 0]])

        def peer(g: np.ndarray = series, m: int = half) -> np.ndarray:
            return np.asarray(control.eigensys_realization(g, 4, m=m, n=m - 1)[0].A)

        other, theirs = best(peer)
        gap = np.abs(np.sort(np.linalg.eigvals(found).real) - np.sort(np.linalg.eigvals(theirs).real)).max()
        row(f"ERA, m = {length}", own, other, "control", float(gap))


def counting(samples: int = 1_000_000, states: int = 100, actions: int = 10) -> None:
    """Transition counts."""
    category = dict(kind="category", minimum=0.0)
    spec = PlantSpec(
        (Channel("a", maximum=actions - 1, **category),), (Channel("s", maximum=states - 1, **category),), 1.0
    )
    a, s = RNG.integers(actions, size=samples), RNG.integers(states, size=samples)
    data = Trajectory(np.arange(samples) * 1.0, a[:, None], s[:, None], spec)

    def loop() -> np.ndarray:
        counts = np.zeros((states, actions, states))
        for k in range(samples - 1):
            counts[s[k], a[k], s[k + 1]] += 1
        return counts

    own, found = best(lambda: count_transitions([data]))
    other, theirs = best(loop, 1)
    row(f"counting, {samples:.0e} transitions", own, other, "python loop", float(np.abs(found - theirs).max()))


def recursive(samples: int = 5000) -> None:
    """Time a step of recursive least squares, for the record: no peer scores regret."""
    online = RecursiveLeastSquares(order=2)
    u, y = RNG.normal(size=(samples, 1)), RNG.normal(size=(samples, 1))
    state = online.start(online.init(record(u, y).spec, rng=RNG), y[0])
    start = time.process_time()
    for k in range(samples - 1):
        online.predict(state, u[k])
        state = online.update(state, u[k], y[k + 1])
    print(f"recursive least squares, 5 parameters: {(time.process_time() - start) / samples * 1e6:.0f} us a step")


if __name__ == "__main__":
    markov((100, 300, 1000))
    era((100, 300, 1000, 2000))
    for size in (10_000, 100_000):
        sparse(size)
    dmd(4, 1_000_000)
    dmd(40, 100_000)
    dmd(400, 10_000)
    counting()
    recursive()
