"""How a fitted model is run in the checks, and when two models count as the same."""

from __future__ import annotations

import os
import pickle
import random
import warnings
from collections.abc import Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings

from harness.conformance.results import Broken, demand
from harness.conformance.workloads import Workload, draw_workload, workloads
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

EXAMPLES = 6  # Systems that hypothesis draws for each check.


def seeded(seed: int = 0) -> np.random.Generator:
    """Return a fresh generator: the same numbers each time."""
    return np.random.default_rng(seed)


def for_all(kinds: tuple[str, ...], body: Callable[[Workload], None], examples: int = EXAMPLES) -> None:
    """Hold a body against drawn workloads; at least one must not be refused.

    The smallest failing system is reported: hypothesis shrinks it.
    """
    done: list[int] = []
    refusals: list[str] = []

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        phases=(Phase.generate, Phase.shrink) if examples > 20 else (Phase.generate,),
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
    )
    @given(workloads(kinds))
    def hold(drawn: tuple[str, int, int, float]) -> None:
        workload = draw_workload(*drawn)
        try:
            body(workload)
        except HarnessError as error:
            refusals.append(str(error))
            return
        except Broken as error:
            raise Broken(f"{error} (system: {workload.kind}, seed {workload.seed})") from error
        done.append(workload.seed)

    hold()
    demand(done, f"every drawn system was refused, the last with: {refusals[-1] if refusals else '(none drawn)'}")


def fit(identifier: Any, trajectories: Sequence[Trajectory], seed: int = 0) -> Any:
    """Return a fitted model; anything but a named refusal breaks the contract."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return identifier.fit(trajectories, rng=seeded(seed))
    except HarnessError:
        raise
    except Exception as error:
        if "read-only" in str(error):
            raise Broken(f"it tries to change its data: {error}") from error
        raise Broken(f"fit raised {type(error).__name__}: {error}; only HarnessErrors may leave it") from error


def one_step(model: Any, data: Trajectory, *, prefix: int | None = None) -> FloatArray:
    """Return one-step predictions (N, ny), each made before its output is seen.

    The initial state is estimated from a prefix of the record only.
    """
    data = data.measured()
    known = prefix if prefix is not None else max(int(model.burn_in), 1)
    x = model.initial_state(data[: min(known, len(data))])
    rows = np.empty((len(data), data.spec.ny))
    for k in range(len(data)):
        rows[k] = model.output(x, data.u[k])
        x = model.step(model.correct(x, data.u[k], data.y[k]), data.u[k])
    return rows


def alike(first: Any, second: Any, data: Trajectory, *, tolerance: float = 0.0) -> bool:
    """Return True if two models predict the same, bit for bit or within a tolerance relative to the record's size."""
    a, b = one_step(first, data), one_step(second, data)
    if tolerance == 0.0:
        return bool(np.array_equal(a, b, equal_nan=True))
    scale = float(np.abs(data.y).max()) or 1.0
    with np.errstate(invalid="ignore"):
        return bool(np.all((np.abs(a - b) <= tolerance * scale) | (np.isnan(a) & np.isnan(b))))


def global_state() -> dict[str, bytes]:
    """Return the state of the whole process that nothing may touch, by its name in a verdict."""
    return {
        "numpy's global random state": pickle.dumps(np.random.get_state()),  # noqa: NPY002 - the one that is global
        "the state of the module random": pickle.dumps(random.getstate()),
        "numpy's handling of floating-point errors": pickle.dumps(np.geterr()),
        "how numpy prints": repr(np.get_printoptions()).encode(),
        "the environment": pickle.dumps(dict(os.environ)),
        "the working folder": os.getcwd().encode(),
    }


@contextmanager
def globals_untouched() -> Iterator[None]:
    """Demand that nothing that belongs to the whole process is changed.

    The random states are set to ones that no seed gives first, so that seeding them shows even if it was done before;
    everything is put back.
    """
    kept, rand, errors, folder = np.random.get_state(), random.getstate(), np.geterr(), os.getcwd()  # noqa: NPY002
    environment, printing = dict(os.environ), np.get_printoptions()
    np.random.set_state(("MT19937", np.arange(1, 625, dtype=np.uint32), 624, 0, 0.0))  # noqa: NPY002
    random.setstate((3, (*range(1, 625), 624), None))
    np.seterr(divide="warn", over="warn", under="ignore", invalid="warn")
    before = global_state()
    try:
        yield
        after = global_state()
        changed = [what for what in before if before[what] != after[what]]
        demand(not changed, f"it changes {' and '.join(changed)}; random numbers come from rng alone")
    finally:
        np.random.set_state(kept)  # noqa: NPY002
        random.setstate(rand)
        np.seterr(**errors)
        np.set_printoptions(**printing)
        os.chdir(folder)
        if dict(os.environ) != environment:
            os.environ.clear()
            os.environ.update(environment)


@contextmanager
def untouched(*records: Trajectory) -> Iterator[None]:
    """Demand that the records, and all that belongs to the whole process, are the same afterwards."""
    before = [(r.t.tobytes(), r.u.tobytes(), r.y.tobytes()) for r in records]
    with globals_untouched():
        yield
    after = [(r.t.tobytes(), r.u.tobytes(), r.y.tobytes()) for r in records]
    demand(before == after, "it changed its data")
