"""Identifiers against their peers: the same work in one process, in alternating rounds, with ratio, aim and difference.

Run ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_identifiers.py [NAMES]``; names: markov, era,
sparse, dmd, subspace, counting, recursive; ``large`` adds a million samples (pysindy then takes 7 GB). A peer that is
not installed (pysindy, pydmd, numba, padasip, sippy-unipi, nfoursid) has a row that says so.
The ratio is that of the shortest CPU times; the difference is the largest between the two answers.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from timing import least_times

from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.common.library import Library
from identifiers.finite.mdp import count_transitions
from identifiers.linear.arx import Arx
from identifiers.linear.dmd import Dmdc
from identifiers.linear.ho_kalman import markov_parameters, realize
from identifiers.linear.n4sid import Subspace
from identifiers.online.rls import RecursiveLeastSquares
from identifiers.sparse.stlsq import NormalEquations, stlsq

RNG = np.random.default_rng(0)
BLOCK = 8192
Job = Callable[[], Any]


def race(work: str, aim: float, ours: Job, who: str, peer: Job | None, *, rounds: int = 5, of: str = "") -> None:
    """Run both in alternating rounds and print one line: best CPU times, their ratio, the aim, the difference.

    Parameters
    ----------
    work, who : str
        What is done, and by which peer (``of`` names its package where that differs).
    aim : float
        The ratio asked for.
    ours, peer : callable
        Return the answer as an array.
    """
    package = of or who
    if peer is None or (package != "numpy" and importlib.util.find_spec(package) is None):
        print(f"{work:44s} {who}: not installed")
        return
    (own, other), answers = least_times(ours, peer, rounds=rounds)
    own, other = max(own, 1e-9), max(other, 1e-9)
    gap = float(np.abs(np.asarray(answers[0]) - np.asarray(answers[1])).max())
    verdict = "met" if other / own >= aim else "MISSED"
    times_text = f"{1e3 * own:10.3f} ms   {who} {1e3 * other:.3f} ms"
    print(
        f"{work:44s} {times_text}   ratio {other / own:.1f} (aim {aim:g}: {verdict})   difference {gap:.1e}", flush=True
    )


def record(u: FloatArray, y: FloatArray) -> Trajectory:
    """Return a record of unnamed signals."""
    spec = PlantSpec(
        tuple(Channel(f"u{i}") for i in range(u.shape[1])), tuple(Channel(f"y{i}") for i in range(y.shape[1])), 1.0
    )
    return Trajectory(np.arange(len(y)) * 1.0, u, y, spec)


def sparse() -> None:
    """STLSQ of 4 states on 126 functions; the peer gets the derivatives, so that both regress the same numbers."""
    for samples, aim in ((10_000, 15), (100_000, 35), *([(1_000_000, 50)] if "large" in sys.argv else [])):
        x = RNG.normal(size=(samples, 4))
        rates = x @ RNG.normal(size=(4, 4)) + 0.5 * x[:, :1] * x[:, 1:2] + 0.01 * RNG.normal(size=(samples, 4))
        library = Library(("a", "b", "c", "d"), degree=5)

        def sums(x: FloatArray = x, rates: FloatArray = rates, library: Library = library) -> NormalEquations:
            cuts = range(0, len(x), BLOCK)
            blocks = ((library.rows(list(x[k : k + BLOCK].T)), rates[k : k + BLOCK].T) for k in cuts)
            return NormalEquations.of(blocks, len(library), 4)

        def ours(sums: Callable[[], NormalEquations] = sums) -> FloatArray:
            return stlsq(sums(), 0.02)[0]

        def peer(x: FloatArray = x, rates: FloatArray = rates) -> FloatArray:
            import pysindy

            model = pysindy.SINDy(
                optimizer=pysindy.STLSQ(threshold=0.05, alpha=0.0), feature_library=pysindy.PolynomialLibrary(degree=5)
            )
            model.fit(x, t=1.0, x_dot=rates)
            return np.asarray(model.coefficients()).T

        def lean(x: FloatArray = x, rates: FloatArray = rates, library: Library = library) -> FloatArray:
            gram, right = np.zeros((len(library),) * 2), np.zeros((len(library), 4))
            for k in range(0, len(x), BLOCK):
                rows = library.rows(list(x[k : k + BLOCK].T))
                gram += rows @ rows.T
                right += rows @ rates[k : k + BLOCK]
            return gram

        work = f"STLSQ, {len(library)} functions, N = {samples:.0e}"
        race(work, aim, ours, "pysindy", peer, rounds=5 if samples < 50_000 else 2 if samples < 500_000 else 1)
        race(f"{work}, its sums", 0.9, lambda sums=sums: sums().gram, "lean Gram matrix", lean, of="numpy")


def dmd() -> None:
    """DMD with control of measured states."""
    large = [(40, 1_000_000, 50)] if "large" in sys.argv else []
    for states, samples, aim in ((4, 1_000_000, 40), (40, 100_000, 50), (400, 10_000, 10), *large):
        a = np.linalg.qr(RNG.normal(size=(states, states)))[0] * 0.95
        b, y, u = RNG.normal(size=(states, 2)), np.zeros((samples, states)), RNG.normal(size=(samples, 2))
        disturbance = 0.1 * RNG.normal(size=(samples, states))
        for k in range(samples - 1):
            y[k + 1] = a @ y[k] + b @ u[k] + disturbance[k]
        data = record(u, y)

        def ours(data: Trajectory = data) -> FloatArray:
            return np.sort(np.abs(Dmdc().fit([data], rng=RNG).eigenvalues))

        def peer(y: FloatArray = y, u: FloatArray = u) -> FloatArray:
            import pydmd

            model: Any = pydmd.DMDc(svd_rank=-1)
            return np.sort(np.abs(np.asarray(model.fit(y.T, u[:-1].T).eigs)))

        def normal(y: FloatArray = y, u: FloatArray = u) -> FloatArray:
            rows = np.hstack([y[:-1], u[:-1]])
            return np.sort(np.abs(np.linalg.eigvals(np.linalg.solve(rows.T @ rows, rows.T @ y[1:])[: y.shape[1]])))

        work = f"DMD with control, n = {states}, N = {samples:.0e}"
        race(work, aim, ours, "pydmd", peer, rounds=3 if states * samples < 10_000_000 else 1)
        race(work, 1.2, ours, "normal equations", normal, of="numpy", rounds=7)


def subspace(samples: int = 10_000) -> None:
    """N4SID of three states, and ARX, of one and of two inputs and outputs; the eigenvalues are compared.

    The peers use 10 block rows, as we do; what differs is noise in 4 digits, not the method.
    """
    rng = np.random.default_rng(0)
    a = np.array([[0.9, 0.3, 0.0], [-0.2, 0.85, 0.1], [0.0, 0.0, 0.6]])
    for size in (1, 2):
        b, c = rng.normal(size=(3, size)), rng.normal(size=(size, 3))
        u, x = rng.normal(size=(samples, size)), np.zeros((samples, 3))
        for k in range(samples - 1):
            x[k + 1] = a @ x[k] + b @ u[k]
        y = x @ c.T
        y = y + 0.01 * y.std(axis=0) * rng.normal(size=y.shape)
        data = record(u, y)

        def ours(data: Trajectory = data) -> FloatArray:
            return np.sort(np.abs(Subspace(order=3, past=10, method="n4sid").fit([data], rng=RNG).eigenvalues))

        def sippy(u: FloatArray = u, y: FloatArray = y) -> FloatArray:
            import sippy_unipi

            found: Any = sippy_unipi.system_identification(y.T, u.T, "N4SID", SS_fixed_order=3, SS_f=10)
            return np.sort(np.abs(np.linalg.eigvals(found.A)))

        def nfoursid(u: FloatArray = u, y: FloatArray = y, size: int = size) -> FloatArray:
            import pandas
            from nfoursid.nfoursid import NFourSID

            inputs, outputs = [f"u{i}" for i in range(size)], [f"y{i}" for i in range(size)]
            frame = pandas.DataFrame(np.hstack([u, y]), columns=inputs + outputs)
            method = NFourSID(frame, output_columns=outputs, input_columns=inputs, num_block_rows=10)
            method.subspace_identification()
            return np.sort(np.abs(np.linalg.eigvals(method.system_identification(rank=3)[0].a)))

        work = f"N4SID, {size} x {size}, N = {samples:.0e}"
        race(work, 7, ours, "sippy", sippy, rounds=3, of="sippy_unipi")
        race(work, 93, ours, "nfoursid", nfoursid, rounds=1)

        if size > 1:
            continue

        def arx(data: Trajectory = data) -> FloatArray:
            return np.asarray(Arx(order=3, offset=False).fit([data], rng=RNG).impulse_response(10)[:, 0, 0])

        def sippy_arx(u: FloatArray = u, y: FloatArray = y) -> FloatArray:
            import sippy_unipi
            from scipy.signal import lfilter

            found: Any = sippy_unipi.system_identification(y.T, u.T, "ARX", ARX_orders=[3, 3, 0])
            pulse = np.eye(10)[0]
            top, bottom = (np.atleast_1d(np.squeeze(part)) for part in (found.G.num[0][0], found.G.den[0][0]))
            lead = np.zeros(len(bottom) - len(top))
            return np.asarray(lfilter(np.concatenate([lead, top]), bottom, pulse))

        race(f"ARX of order 3, N = {samples:.0e}", 7, arx, "sippy", sippy_arx, rounds=3, of="sippy_unipi")


def markov(samples: int = 100_000) -> None:
    """Impulse responses of one input and one output, from rest.

    The peer takes inputs before the record for zero, ours counts only windows within it: given the zeros, they agree.
    """
    import control
    from scipy.signal import lfilter

    u = RNG.normal(size=samples)
    y = lfilter([0, 1, 0.5], [1, -1.5, 0.7], u) + 0.1 * RNG.normal(size=samples)
    for length, aim in ((100, 60), (300, 140), (1000, 700)):
        rest = np.zeros((length - 1, 1))
        data = record(np.vstack([rest, u[:, None]]), np.vstack([rest, y[:, None]]))
        race(
            f"Markov parameters, N = {samples:.0e}, m = {length}",
            aim,
            lambda n=length, data=data: markov_parameters([data], n, offset=False)[0][:, 0, 0],
            "control",
            lambda n=length: np.asarray(control.markov(y, u, m=n)).ravel(),
            rounds=3 if length < 1000 else 1,
        )


def era() -> None:
    """Realization of order 4 from noisy Markov parameters; the peer is told its window, whose default ignores most."""
    import control

    a, c = np.diag([0.95, 0.8, -0.5, 0.3]), np.array([[1.0, 2.0, 3.0, 4.0]])
    for length, aim in ((100, 5), (300, 10), (1000, 25), (2000, 130)):
        powers = np.diag(a)[None] ** np.arange(length)[:, None]
        response = (powers @ c[0])[:, None, None] + 1e-4 * RNG.normal(size=(length, 1, 1))
        half, series = length // 2, np.concatenate([[0.0], response[:, 0, 0]])
        race(
            f"ERA, m = {length}",
            aim,
            lambda g=response: np.sort(np.linalg.eigvals(realize(g, order=4)[0]).real),
            "control",
            lambda g=series, m=half: np.sort(
                np.linalg.eigvals(np.asarray(control.eigensys_realization(g, 4, m=m, n=m - 1)[0].A)).real
            ),
            rounds=20 if length < 1000 else 5,
        )


def counting(samples: int = 10_000_000, states: int = 1000, actions: int = 10) -> None:
    """Transition counts."""
    category = dict(kind="category", minimum=0.0)
    spec = PlantSpec(
        (Channel("a", maximum=actions - 1, **category),), (Channel("s", maximum=states - 1, **category),), 1.0
    )
    a, s = RNG.integers(actions, size=samples), RNG.integers(states, size=samples)
    data = Trajectory(np.arange(samples) * 1.0, a[:, None], s[:, None], spec)
    peer = None
    if importlib.util.find_spec("numba") is not None:
        import numba

        @numba.njit  # type: ignore[untyped-decorator]
        def count(u: FloatArray, y: FloatArray) -> FloatArray:
            counts = np.zeros((states, actions, states))
            for k in range(len(y) - 1):
                counts[int(y[k, 0]), int(u[k, 0]), int(y[k + 1, 0])] += 1
            return counts

        count(data.u[:10], data.y[:10])

        def peer() -> FloatArray:
            return np.asarray(count(data.u, data.y))

    race(f"counting, {samples:.0e} transitions", 1.0, lambda: count_transitions([data]), "numba", peer)


def recursive(samples: int = 3000) -> None:
    """Predict and learn by recursive least squares, 5 parameters, beside ten lines of numpy and padasip."""
    u, y = RNG.normal(size=(samples, 1)), np.zeros((samples, 1))
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + u[k] + 0.1 * RNG.normal()
    online, spec = RecursiveLeastSquares(order=2), record(u, y).spec

    def stepped() -> FloatArray:
        state = online.start(online.init(spec, rng=RNG), y[0])
        for k in range(samples - 1):
            online.predict(state, u[k])
            state = online.update(state, u[k], y[k + 1])
        return state.coefficients[:, 0]

    def tracked() -> FloatArray:
        state = online.start(online.init(spec, rng=RNG), y[0])
        return online.track(state, u[:-1], y[1:])[1].coefficients[:, 0]

    def plain() -> FloatArray:
        theta, covariance, row = np.zeros(5), 1e9 * np.eye(5), np.ones(5)
        outputs, inputs = y[:, 0], u[:, 0]
        for k in range(1, samples - 1):
            row[0], row[1], row[2], row[3] = outputs[k], outputs[k - 1], inputs[k], inputs[k - 1]
            guess = row @ theta
            spread = covariance @ row
            gain = spread / (1.0 + row @ spread)
            theta = theta + gain * (outputs[k + 1] - guess)
            covariance = covariance - np.outer(gain, spread)
        return theta

    def padasip() -> FloatArray:
        import padasip

        filter, row = padasip.filters.FilterRLS(n=5, mu=1.0, eps=1e-9, w="zeros"), np.ones(5)
        outputs, inputs = y[:, 0], u[:, 0]
        for k in range(1, samples - 1):
            row[0], row[1], row[2], row[3] = outputs[k], outputs[k - 1], inputs[k], inputs[k - 1]
            filter.predict(row)
            filter.adapt(outputs[k + 1], row)
        return np.asarray(filter.w)

    for work, ours in (("step by step", stepped), ("a record at once", tracked)):
        work = f"recursive least squares, {samples} samples, {work}"
        race(work, 1.5, ours, "ten lines of numpy", plain, of="numpy", rounds=10)
        race(work, 1.5, ours, "padasip", padasip, rounds=10)


RACES = (markov, era, sparse, dmd, subspace, counting, recursive)

if __name__ == "__main__":
    chosen = [name for name in sys.argv[1:] if name != "large"] or [job.__name__ for job in RACES]
    for job in RACES:
        if job.__name__ in chosen:
            job()
