"""Linear identifiers against their peers on the same 40 data sets, defaults against defaults: errors of free runs.

    python benchmarks/linear_against_peers.py [--base SEED] [--only NUMBER ...] [--packages FOLDER] [--alone]

The peers (``pip install --target FOLDER sippy_unipi nfoursid control sysidentpy jax-sysid``) are no part of the
product; one that is not installed has no column. Data sets are made here: eight kinds of five each, orders 1 to 8, the
record of a plant that was moving before it began, and a fresh record without noise, from rest, that nobody fitted. The
figure is the error of a free run over it, relative to the outputs, the root of the mean square over outputs, without
its mean: our identifiers fit a level too, which the peers take to be known and zero, as it is here.

Defaults are those of the functions called. Where a peer has none it gets what a user could only guess: the true order
(jax-sysid, and the realisation of python-control, from 60 Markov parameters). ``SIPPY`` runs as five methods,
``sysidentpy`` with polynomials of degree 1, each output by itself. Seeds begin at 10000; those below may be used while
tuning. The last column is a bound of a kind: the largest likelihood of the true order, dead time and colour of the
noise, searched for from the plant itself. Nobody can be lowest everywhere: of nine others the luckiest is counted.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from harness import registry
from harness.scoring import errors
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

BASE = 10_000  # First seed.
KINDS = ("white", "coloured", "two by two", "oversampled", "delayed", "short", "long", "loop")
EACH = 5  # Data sets of a kind.
SETTLE, FRESH, REST = 300, 1000, 20  # Samples before a record, of the fresh record, and of rest at its beginning.
POLE = 0.9  # Of noise that remembers.
REMEMBERED = ("coloured", "long", "loop")  # Kinds with such a noise.
MARKOV = 60  # Markov parameters that python-control's realisation is given.
OURS: tuple[tuple[str, dict[str, Any]], ...] = (("arx", {}), ("n4sid", {}), ("prediction-error", {}))
CLOSE = 1.05  # Beyond so many times the least error a method is not among the best.
DIVERGED = 1e6  # Times its outputs: a free run so far off has diverged.


@dataclass(frozen=True)
class Case:
    """A data set: inputs and outputs to fit, and a fresh record without noise."""

    kind: str
    order: int
    u: FloatArray
    y: FloatArray
    fresh_u: FloatArray
    fresh_y: FloatArray
    plant: Plant
    late: int


@dataclass(frozen=True)
class Plant:
    """``x[k+1] = A x[k] + B u[k]``, ``y = C x``."""

    a: FloatArray
    b: FloatArray
    c: FloatArray

    def run(self, u: FloatArray) -> FloatArray:
        """Return the outputs from rest."""
        x, y = np.zeros(len(self.a)), np.zeros((len(u), len(self.c)))
        for k, now in enumerate(u):
            y[k] = self.c @ x
            x = self.a @ x + self.b @ now
        return y


def plant_of(order: int, ny: int, nu: int, slow: bool, rng: np.random.Generator) -> Plant:
    """Return a stable plant in modes: poles of radius 0.5 to 0.95, or 0.96 to 0.99 where it is sampled fast."""
    a, place = np.zeros((order, order)), 0
    while place < order:
        radius = rng.uniform(0.96, 0.99) if slow else rng.uniform(0.5, 0.95)
        if order - place >= 2 and rng.uniform() < 0.6:
            turn = rng.uniform(0.01, 0.15) if slow else rng.uniform(0.1, 2.0)
            own = radius * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
            a[place : place + 2, place : place + 2], place = own, place + 2
        else:
            a[place, place], place = radius, place + 1
    b, c = rng.normal(size=(order, nu)), rng.normal(size=(ny, order))
    b *= np.sqrt(1.0 - np.abs(np.linalg.eigvals(a)).min() ** 2)
    return Plant(a, b, c)


def levels(n: int, nu: int, longest: int, rng: np.random.Generator) -> FloatArray:
    """Return steps of random height and length (n, nu)."""
    u = np.zeros((n, nu))
    for column in range(nu):
        k = 0
        while k < n:
            held = int(rng.integers(1, longest + 1))
            u[k : k + held, column], k = rng.normal(), k + held
    return u


def case_of(number: int, base: int = BASE) -> Case:
    """Return a data set by its number, 0 to 39."""
    kind, order = KINDS[number // EACH], 1 + (3 * number + number // EACH) % 8
    rng = np.random.default_rng([base, number])
    wide = 2 if kind == "two by two" else 1
    plant = plant_of(order, wide, wide, kind == "oversampled", rng)
    n = {"short": 200, "long": 10_000, "two by two": 2000, "oversampled": 2000, "loop": 2000}.get(kind, 1000)
    longest = {"oversampled": 40, "white": 1, "long": 1}.get(kind, 5)
    late = int(rng.integers(3, 9)) if kind == "delayed" else 0
    u = levels(n + SETTLE, wide, longest, rng)
    moved = np.vstack([np.zeros((late, wide)), u[: len(u) - late]])
    if kind == "loop":
        u, y = looped(plant, u, rng)
    else:
        y = plant.run(moved)
        size = 0.2 if kind in ("coloured", "short") else 0.1
        noise = rng.normal(size=y.shape)
        if kind in ("coloured", "long"):
            noise = lfilter([1.0], [1.0, -POLE], noise, axis=0) * np.sqrt(1.0 - POLE**2)
        y = y + size * y.std(axis=0) * noise
    fresh = levels(FRESH, wide, 4 * longest, rng)
    fresh[:REST] = 0.0
    answered = plant.run(np.vstack([np.zeros((late, wide)), fresh[: FRESH - late]]))
    return Case(kind, order, u[SETTLE:], y[SETTLE:], fresh, answered, plant, late)


def looped(plant: Plant, reference: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return inputs and outputs under ``u = r - K y``, a disturbance that remembers on the output of the plant."""
    gain = 1.0
    while np.abs(np.linalg.eigvals(plant.a - gain * plant.b @ plant.c)).max() >= 0.97:
        gain *= 0.7
    disturbance = lfilter([1.0], [1.0, -POLE], rng.normal(size=len(reference)))
    disturbance *= 0.2 * plant.run(reference).std() / disturbance.std()
    x, u, y = np.zeros(len(plant.a)), np.zeros_like(reference), np.zeros_like(reference)
    for k in range(len(reference)):
        y[k] = plant.c @ x + disturbance[k]
        u[k] = reference[k] - gain * y[k]
        x = plant.a @ x + plant.b @ u[k]
    return u, y


def trajectory(u: FloatArray, y: FloatArray) -> Trajectory:
    """Return a record of the product."""
    spec = PlantSpec(
        tuple(Channel(f"u{j}") for j in range(u.shape[1])), tuple(Channel(f"y{i}") for i in range(y.shape[1])), 1.0
    )
    return Trajectory(np.arange(len(u), dtype=np.float64), u, np.asarray(y, dtype=np.float64), spec)


def relative(found: FloatArray, truth: FloatArray) -> float:
    """Return the error of a free run relative to the outputs, infinity where it is no number."""
    with np.errstate(all="ignore"):
        ratio = (found - truth)[REST:].var(axis=0) / np.mean(truth[REST:] ** 2, axis=0)
        error = float(np.sqrt(np.mean(ratio)))
    return error if np.isfinite(error) and error < DIVERGED else float("inf")


Method = Callable[[Case], float]


def ours(name: str, options: dict[str, Any]) -> Method:
    """Return one of our identifiers."""

    def run(case: Case) -> float:
        model: Any = registry.create("identifiers", name, **options).fit(
            [trajectory(case.u, case.y)], rng=np.random.default_rng(0)
        )
        miss, _ = errors(model, trajectory(case.fresh_u, case.fresh_y), None)
        return relative(case.fresh_y + miss, case.fresh_y)

    return run


def state_space(matrices: Any, case: Case) -> float:
    """Return the error of A, B, C, D run from rest."""
    a, b, c, d = (np.atleast_2d(np.asarray(part, dtype=float)) for part in matrices)
    with np.errstate(all="ignore"):
        return relative(Plant(a, b, c).run(case.fresh_u) + case.fresh_u @ d.T, case.fresh_y)


def sippy(method: str) -> Method:
    """Return a method of SIPPY at its defaults."""
    whole = importlib.import_module("sippy_unipi")

    def run(case: Case) -> float:
        made = whole.system_identification(case.y.T, case.u.T, method)
        if hasattr(made, "A"):
            return state_space((made.A, made.B, made.C, made.D), case)
        import control

        plant = control.ss(made.G)
        return state_space((plant.A, plant.B, plant.C, plant.D), case)

    return run


def nfoursid() -> Method:
    """Return nfoursid at its defaults."""
    import pandas

    whole = importlib.import_module("nfoursid.nfoursid")

    def run(case: Case) -> float:
        u, y = [f"u{j}" for j in range(case.u.shape[1])], [f"y{i}" for i in range(case.y.shape[1])]
        fit = whole.NFourSID(pandas.DataFrame(np.hstack([case.u, case.y]), columns=u + y), y, u)
        fit.subspace_identification()
        made, _ = fit.system_identification()
        return state_space((made.a, made.b, made.c, made.d), case)

    return run


def realisation() -> Method:
    """Return python-control's realisation of its Markov parameters, of the true order."""
    import control

    def run(case: Case) -> float:
        markov = np.asarray(control.markov(case.y.T, case.u.T, m=MARKOV, truncate=True))
        markov = markov.reshape(case.y.shape[1], case.u.shape[1], MARKOV)
        made, _ = control.eigensys_realization(markov, r=case.order)
        return state_space((made.A, made.B, made.C, made.D), case)

    return run


def narmax() -> Method:
    """Return sysidentpy's selection by forward regression, of degree 1, each output by itself."""
    chosen = importlib.import_module("sysidentpy.model_structure_selection").FROLS
    basis = importlib.import_module("sysidentpy.basis_function").Polynomial

    def run(case: Case) -> float:
        columns = []
        lags: Any = 2 if case.u.shape[1] == 1 else [[1, 2]] * case.u.shape[1]
        for output in range(case.y.shape[1]):
            fit = chosen(basis_function=basis(degree=1), xlag=lags)
            fit.fit(X=case.u, y=case.y[:, output : output + 1])
            start = case.fresh_y[: fit.max_lag, output : output + 1]
            columns.append(np.ravel(fit.predict(X=case.fresh_u, y=start)))
        return relative(np.column_stack(columns), case.fresh_y)

    return run


def jax_sysid() -> Method:
    """Return jax-sysid's linear model of the true order."""
    made = importlib.import_module("jax_sysid.models").LinearModel

    def run(case: Case) -> float:
        model = made(case.order, case.y.shape[1], case.u.shape[1])
        model.fit(case.y, case.u)
        return state_space(model.ssdata(), case)

    return run


def knowing(case: Case) -> float:
    """Return the error of the largest likelihood that is reached from the plant, its structure known."""
    from identifiers.linear.statespace.model import Piece, StateSpace, errors_of
    from identifiers.linear.statespace.search import Freedom, StateSpaceEnd, loss_of, search, settled_starts

    plant, late, ny = case.plant, case.late, case.y.shape[1]
    pieces = [Piece(case.u[: len(case.u) - late], case.y[late:])]
    wide = np.zeros((ny, case.u.shape[1]))
    white = StateSpace(plant.a, plant.b, plant.c, wide, np.zeros(ny), np.zeros((ny, 0)))
    first = settled_starts(white, pieces, Freedom())
    if case.kind in REMEMBERED:
        model = replace(first.model, noise=np.full((ny, 1), -POLE))
        wrong = errors_of(model, first.starts, pieces)
        first = StateSpaceEnd(model, first.starts, wrong, loss_of(wrong), False)
    found = search(first, pieces, Freedom(), gain=1e-6).model
    moved = np.vstack([np.zeros((late, wide.shape[1])), case.fresh_u[: FRESH - late]])
    return relative(Plant(found.a, found.b, found.c).run(moved), case.fresh_y)


PEERS: tuple[tuple[str, Callable[[], Method]], ...] = (
    ("sippy N4SID", lambda: sippy("N4SID")),
    ("sippy MOESP", lambda: sippy("MOESP")),
    ("sippy CVA", lambda: sippy("CVA")),
    ("sippy PARSIM", lambda: sippy("PARSIM-K")),
    ("sippy ARX", lambda: sippy("ARX")),
    ("nfoursid", nfoursid),
    ("control ERA", realisation),
    ("sysidentpy", narmax),
    ("jax-sysid", jax_sysid),
)


def error_of(case: Case, method: Method) -> tuple[float, str]:
    """Return the error of a method, or infinity and why it failed."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return method(case), ""
    except Exception as error:  # whatever a peer raises is a failure of its fit
        return float("inf"), f"{type(error).__name__}: {str(error)[:90]}"


def summary(every: FloatArray, names: list[str], own: int, spent: dict[str, float]) -> None:
    """Print of each method on how many sets it is lowest: ours against the peers, a peer against the others and arx."""
    others = every[:, own:-1] if every.shape[1] > own + 1 else every[:, :own]
    print(f"\n{'method':20} {'lowest':>7} {'within 1.05':>12} {'worst ratio':>12} {'median':>8}", end="")
    print(f" {'failed':>7} {'CPU s':>7}")
    for column, name in enumerate(names):
        mine = column < own or column == every.shape[1] - 1
        rivals = others if mine else np.hstack([np.delete(others, column - own, axis=1), every[:, :1]])
        ratio = every[:, column] / np.maximum(rivals.min(axis=1), 1e-12)
        print(
            f"{name:20} {np.sum(ratio <= 1.0):>7} {np.sum(ratio <= CLOSE):>12} {ratio.max():>12.3g} "
            f"{np.median(every[:, column]):>8.3g} {np.sum(~np.isfinite(every[:, column])):>7} {spent[name]:>7.1f}"
        )
    for column in range(own):
        beaten = [f"{name} {np.sum(every[:, column] <= every[:, own + k])}" for k, name in enumerate(names[own:])]
        print(f"{names[column]} errs no more than, on so many sets: {', '.join(beaten)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=int, default=BASE, help="first seed")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of data sets")
    parser.add_argument("--packages", help="folder in which the peers are installed")
    parser.add_argument("--alone", action="store_true", help="our identifiers only")
    given = parser.parse_args()
    if given.packages:
        sys.path.append(given.packages)
    methods = {f"our {name}": ours(name, options) for name, options in OURS}
    for name, made in () if given.alone else PEERS:
        try:
            methods[name] = made()
        except ImportError:
            print(f"{name}: not installed")
    methods["true structure"] = knowing
    names = list(methods)
    print(f"{'':3} {'kind':12} {'order':>5} " + " ".join(f"{name[-12:]:>12}" for name in names))
    table = []
    spent = dict.fromkeys(names, 0.0)
    for number in given.only or range(len(KINDS) * EACH):
        case = case_of(number, given.base)
        row, failed = [], []
        for name in names:
            begun = time.process_time()
            error, why = error_of(case, methods[name])
            spent[name] += time.process_time() - begun
            row.append(error)
            failed += [f"{name}: {why}"] if why else []
        table.append(row)
        print(f"{number:3} {case.kind:12} {case.order:>5} " + " ".join(f"{one:>12.4g}" for one in row), flush=True)
        for text in failed:
            print(f"      {text}", flush=True)
    summary(np.array(table), names, len(OURS), spent)


if __name__ == "__main__":
    main()
