"""Finite and learned models against peers: the same work in one process, in turn, with the ratio of CPU times.

Run ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/bench_learned.py``; a peer that is not installed
(hmmlearn, scikit-learn) has a row that says so. Claims, on one thread: Baum-Welch faster than hmmlearn's scaling
implementation, exact bisimulation of 1e4 states in seconds, a Gaussian process with 1e4 samples through inducing points
in less than a minute.
"""

from __future__ import annotations

import importlib.util
import time

import numpy as np
from timing import least_times

from harness.signals import Channel, PlantSpec, Trajectory
from identifiers.finite.bisimulation import bisimulation
from identifiers.finite.hmm_pass import expected_counts
from identifiers.learned.gaussian_process import GaussianProcess

RNG = np.random.default_rng(0)


def row(work: str, ours: float, peer: float | None, who: str, difference: float | None = None) -> None:
    """Print one line of the table."""
    other = f"{who}: not installed" if peer is None else f"{who} {peer:.3f} s   ratio {peer / ours:.2f}"
    equal = "" if difference is None else f"   largest difference {difference:.1e}"
    print(f"{work:52s} {ours:8.3f} s   {other}{equal}")


def have(package: str) -> bool:
    """Return True if a peer is installed."""
    return importlib.util.find_spec(package) is not None


def baum_welch(states: int = 10, samples: int = 100_000, iterations: int = 10) -> None:
    """Baum-Welch from the same start; the peer knows no actions, ours has one."""
    transition, emission = (RNG.dirichlet(np.ones(states), size=states) for _ in range(2))
    seen = RNG.integers(states, size=samples).astype(np.intc)
    action = np.zeros(samples, dtype=np.intc)

    def ours() -> np.ndarray:
        initial, t, e = np.full(states, 1.0 / states), transition[:, None], emission
        for _ in range(iterations):
            counts = expected_counts([(seen, action)], initial, t, e)
            initial = counts.first / counts.first.sum()
            t = counts.transition / counts.transition.sum(axis=2, keepdims=True)
            e = counts.emission / counts.emission.sum(axis=1, keepdims=True)
        return t[:, 0]

    theirs = None
    if have("hmmlearn"):
        from hmmlearn.hmm import CategoricalHMM

        def theirs() -> np.ndarray:
            peer = CategoricalHMM(
                states, n_iter=iterations, tol=-1, init_params="", implementation="scaling", n_features=states
            )
            peer.startprob_, peer.transmat_, peer.emissionprob_ = np.full(states, 1.0 / states), transition, emission
            return np.asarray(peer.fit(seen[:, None]).transmat_)

    jobs = (ours,) if theirs is None else (ours, theirs)
    times, answers = least_times(*jobs, rounds=3)
    own, other = times[0], None if theirs is None else times[1]
    gap = None if theirs is None else float(np.abs(answers[0] - answers[1]).max())
    row(f"Baum-Welch, {states} states, N = {samples:.0e}, {iterations} iterations", own, other, "hmmlearn scaling", gap)


def lumping(small: int = 100, copies: int = 100, actions: int = 4, successors: int = 5) -> None:
    """Exact bisimulation of small * copies states, sparse; no peer in Python."""
    from scipy.sparse import csr_array

    labels = np.repeat(np.arange(small), copies)
    states = small * copies
    reward = RNG.integers(3, size=(small, actions)) / 2.0
    matrices = []
    for _ in range(actions):
        blocks = np.array([RNG.choice(small, size=successors, replace=False) for _ in range(small)])
        share = RNG.dirichlet(np.ones(successors), size=small)
        columns = blocks[labels] * copies + RNG.integers(copies, size=(states, successors))
        rows = np.repeat(np.arange(states), successors)
        matrices.append(csr_array((share[labels].ravel(), (rows, columns.ravel())), shape=(states, states)))
    start = time.process_time()
    found = bisimulation(matrices, reward[labels])
    spent = time.process_time() - start
    print(f"{f'exact bisimulation, {states} states to {found.max() + 1}':52s} {spent:8.3f} s   no peer")


def process(samples: int = 11_000) -> None:
    """Gaussian process on 1e4 samples; the peer is exact on as many as it takes in a comparable time."""
    u, y = RNG.uniform(-1, 1, samples), np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * np.sin(2 * y[k]) + 0.5 * u[k] + 0.05 * RNG.normal()
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    data = Trajectory(np.arange(samples) * 1.0, u[:, None], y[:, None], spec)
    start = time.process_time()
    model = GaussianProcess(exact=400).fit([data[: samples - 1000]], rng=np.random.default_rng(0))
    own = time.process_time() - start
    rows = np.column_stack([y, u])[-1000:-1]
    error = float(np.sqrt(np.mean((model.ahead(rows)[0][:, 0] - y[-999:]) ** 2)))
    print(f"{f'Gaussian process, N = {samples - 1000}, inducing points':52s} {own:8.3f} s   one-step rms {error:.4f}")
    if not have("sklearn"):
        print(f"{'':52s}              scikit-learn: not installed")
        return
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel

    few = 1500
    start = time.process_time()
    peer = GaussianProcessRegressor(1.0 * RBF([1.0, 1.0]) + WhiteKernel(0.01))
    peer.fit(np.column_stack([y, u])[:few], y[1 : few + 1])
    other = time.process_time() - start
    theirs = float(np.sqrt(np.mean((peer.predict(rows) - y[-999:]) ** 2)))
    print(f"{f'  scikit-learn, exact, N = {few}':52s} {other:8.3f} s   one-step rms {theirs:.4f}   (noise 0.05)")


if __name__ == "__main__":
    baum_welch()
    lumping()
    process()
