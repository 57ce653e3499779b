"""Checks of identifiers that learn while they predict."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.conformance.results import Broken, Check, CheckResult, NotApplicable, demand, run_checks
from harness.conformance.running import EXAMPLES, for_all, seeded, untouched
from harness.conformance.workloads import Workload, draw_workload, kinds_for
from harness.errors import HarnessError
from harness.protocols import OnlineIdentifier, Tracking
from harness.signals import FloatArray, Trajectory, residual

Factory = Callable[[], Any]


def check_online_identifier(
    factory: Factory, *, expected_failures: Mapping[str, str] | None = None, examples: int = EXAMPLES
) -> list[CheckResult]:
    """Hold an online identifier to its contract; see :func:`harness.conformance.check_identifier`."""
    return run_checks(online_checks(examples=examples), factory, expected_failures=expected_failures)


def online_checks(*, examples: int = EXAMPLES) -> list[Check]:
    """Return the checks of an online identifier, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in online_checks()][:2]
    ['online_interface', 'online_predicts']
    """
    # the factory is kept with what was found, so that its id stays its own
    cache: dict[int, tuple[Factory, tuple[str, ...]]] = {}

    def kinds(factory: Factory) -> tuple[str, ...]:
        if id(factory) not in cache:
            found, refused = kinds_for(lambda w: _stream(factory(), [w.first.measured()[:40]]))
            why = "; ".join(f"{kind}: {reason}" for kind, reason in refused.items())
            demand(found, f"it refuses every kind of data ({why})")
            cache[id(factory)] = factory, found
        return cache[id(factory)][1]

    def on_all(body: Callable[[Factory, Workload], None]) -> Callable[[Factory], None]:
        return lambda factory: for_all(kinds(factory), lambda workload: body(factory, workload), examples)

    def on_kinds(body: Callable[[Factory, tuple[str, ...]], None]) -> Callable[[Factory], None]:
        return lambda factory: body(factory, kinds(factory))

    return [
        Check("online_interface", "init, start, predict, update, hindsight", _interface),
        Check("online_predicts", "finite predictions of the right shape", on_all(_predicts)),
        Check("online_tracks", "track, where it is offered, is predict and update in turn", on_all(_tracks)),
        Check("online_deterministic", "the same stream and rng give the same predictions", on_all(_deterministic)),
        Check("online_no_mutation", "update leaves the old state and the data alone", on_all(_no_mutation)),
        Check("online_no_look_ahead", "a prediction is made before its output is seen", on_all(_no_look_ahead)),
        Check("online_no_seam_crossed", "start begins a record: nothing reaches across", on_all(_no_seam)),
        Check("online_learns", "predicts better than 0, and better for what earlier records taught", on_kinds(_learns)),
        Check("online_pickles", "a state travels to another process and goes on", on_all(_pickles)),
        Check("online_hindsight", "one finite loss for each predicted sample", on_all(_hindsight)),
        Check("online_hindsight_best", "what is called exact is no worse than the online predictions", on_kinds(_best)),
    ]


def _stream(identifier: Any, records: list[Trajectory]) -> FloatArray:
    """Return the predictions (M, ny) over a stream of records."""
    try:
        state = identifier.init(records[0].spec, rng=seeded())
        rows = []
        for record in records:
            state = identifier.start(state, record.y[0])
            for k in range(len(record) - 1):
                rows.append(np.array(identifier.predict(state, record.u[k]), dtype=float))
                state = identifier.update(state, record.u[k], record.y[k + 1])
    except HarnessError:
        raise
    except Exception as error:
        raise Broken(f"raised {type(error).__name__}: {error}; only HarnessErrors may leave it") from error
    return np.array(rows)


def _shown(workload: Workload) -> list[Trajectory]:
    return [workload.first.measured()[:120], workload.second.measured()[:120]]


def _interface(factory: Factory) -> None:
    identifier = factory()
    demand(isinstance(identifier, OnlineIdentifier), f"{type(identifier).__name__} lacks a method of OnlineIdentifier")


def _predicts(factory: Factory, workload: Workload) -> None:
    records = _shown(workload)
    predicted = _stream(factory(), records)
    demand(
        predicted.shape == (sum(len(r) - 1 for r in records), workload.first.spec.ny),
        f"predictions have shape {predicted.shape[1:]}, expected ({workload.first.spec.ny},)",
    )
    demand(np.isfinite(predicted).all(), "a prediction is not finite")


def _tracks(factory: Factory, workload: Workload) -> None:
    identifier = factory()
    if not isinstance(identifier, Tracking):
        return
    record = _shown(workload)[0]
    stepped = _stream(identifier, [record])
    state = identifier.start(identifier.init(record.spec, rng=seeded()), record.y[0])
    half = len(record) // 2
    first, state = identifier.track(state, record.u[:half], record.y[1 : half + 1])
    second, state = identifier.track(state, record.u[half:-1], record.y[half + 1 :])
    tracked = np.concatenate([first, second])
    demand(tracked.shape == stepped.shape, f"track predicts shape {tracked.shape}, expected {stepped.shape}")
    demand(
        np.allclose(tracked, stepped, rtol=1e-9, atol=1e-9 * float(np.abs(record.y).max())),
        "track predicts otherwise than predict and update in turn",
    )


def _deterministic(factory: Factory, workload: Workload) -> None:
    records = _shown(workload)
    used = factory()
    first, second, again = _stream(used, records), _stream(factory(), records), _stream(used, records)
    demand(np.array_equal(first, second), "two runs over the same stream differ")
    demand(np.array_equal(first, again), "a second run of the same object differs: the first left a trace")


def _no_mutation(factory: Factory, workload: Workload) -> None:
    identifier = factory()
    record = _shown(workload)[0]
    with untouched(record):
        state = identifier.start(identifier.init(record.spec, rng=seeded()), record.y[0])
        for k in range(30):
            kept = copy.deepcopy(state)
            before = np.array(identifier.predict(state, record.u[k]))
            twice = np.array(identifier.predict(state, record.u[k]))
            demand(np.array_equal(before, twice), "predict answers differently the second time")
            following = identifier.update(state, record.u[k], record.y[k + 1])
            after = np.array(identifier.predict(state, record.u[k]))
            demand(np.array_equal(before, after), "update changes the old state")
            demand(
                np.array_equal(before, np.array(identifier.predict(kept, record.u[k]))),
                "a copied state predicts otherwise",
            )
            state = following


def _no_look_ahead(factory: Factory, workload: Workload) -> None:
    record = _shown(workload)[0]
    half = len(record) // 2
    y = record.y.copy()
    y[half:] = y[half:][::-1]
    changed = Trajectory(record.t, record.u, y, record.spec)
    identifier = factory()
    _stream(identifier, [record])  # so that one that remembers a stream gives itself away
    same = _stream(identifier, [changed])[: half - 1], _stream(factory(), [record])[: half - 1]
    demand(np.array_equal(*same), "a prediction depends on an output that was not yet seen")


def _no_seam(factory: Factory, workload: Workload) -> None:
    """Demand that the last outputs of a record do not serve as the past of the next."""
    a, b = _shown(workload)
    identifier = factory()
    state = identifier.init(a.spec, rng=seeded())
    state = identifier.start(state, a.y[0])
    for k in range(40):
        state = identifier.update(state, a.u[k], a.y[k + 1])
    fresh = identifier.start(state, b.y[0])
    twice = identifier.start(identifier.start(state, a.y[7]), b.y[0])
    first = np.array(identifier.predict(fresh, b.u[0]))
    second = np.array(identifier.predict(twice, b.u[0]))
    demand(
        np.array_equal(first, second), "the first prediction of a record depends on what was shown of another record"
    )


def _learns(factory: Factory, kinds: tuple[str, ...]) -> None:
    """Demand that some stream is predicted better than by 0, and that a seam does not end what was learned."""
    better, keeps, seen = False, False, 0
    for workload in _survey(kinds):
        try:
            a, b = _shown(workload)
            whole, fresh = _stream(factory(), [a, b]), _stream(factory(), [b])
        except HarnessError:
            continue
        seen += 1
        late = slice(len(a) // 2, len(a) - 1)
        loss = [_losses(a, guess)[late].mean() for guess in (whole[: len(a) - 1], np.zeros((len(a) - 1, a.spec.ny)))]
        better = better or loss[0] < 0.9 * loss[1]
        keeps = keeps or not np.array_equal(whole[len(a) - 1 :], fresh)
        if better and keeps:
            return
    demand(seen, "every stream of the survey is refused")
    demand(better, "on no stream its predictions, once it has seen 60 samples, are better than always answering 0")
    demand(keeps, "after a seam it predicts as if it had seen nothing before: start() forgets what was learned")


def _best(factory: Factory, kinds: tuple[str, ...]) -> None:
    """Demand that an exact minimiser in hindsight loses no more than the online predictions, on stationary streams.

    One that adapts may gain a little on the best fixed predictor: only twice its loss is blamed.
    """
    worse: list[bool] = []
    survey = _survey(tuple(kind for kind in kinds if kind.startswith("linear") or kind == "finite"))
    for workload in survey:
        if worse.count(False) >= len(survey) / 2:
            return
        record = workload.probe.measured()[:120]
        try:
            result = factory().hindsight([record])
            online = _losses(record, _stream(factory(), [record])).sum()
        except HarnessError:
            continue
        if result.exact:
            worse.append(float(np.sum(result.losses)) > 2.0 * online + 1e-12 * float((record.y**2).sum()))
    if not worse:
        raise NotApplicable("no stationary stream with an exact minimiser")
    demand(
        sum(worse) <= len(worse) / 2,
        "hindsight is called exact, and loses more than twice as much as the online predictions: negative regret",
    )


def _survey(kinds: tuple[str, ...]) -> list[Workload]:
    """Return some systems of each kind."""
    return [draw_workload(kind, 100 + seed) for kind in kinds for seed in range(max(2, 8 // len(kinds)))]


def _losses(record: Trajectory, predicted: FloatArray) -> FloatArray:
    """Return the loss at each predicted sample (N - 1,), as regret counts it."""
    miss = residual(record.spec.outputs, record.y[1:], predicted)
    for column, channel in enumerate(record.spec.outputs):
        if channel.kind == "category":
            miss[:, column] = miss[:, column] != 0.0
    losses: FloatArray = (miss**2).sum(axis=1)
    return losses


def _pickles(factory: Factory, workload: Workload) -> None:
    record = _shown(workload)[0]
    identifier = factory()
    state = identifier.start(identifier.init(record.spec, rng=seeded()), record.y[0])
    for k in range(20):
        state = identifier.update(state, record.u[k], record.y[k + 1])
    other, moved = pickle.loads(pickle.dumps((identifier, state)))
    for k in range(20, 30):
        first, second = identifier.predict(state, record.u[k]), other.predict(moved, record.u[k])
        demand(np.array_equal(first, second), "a pickled state goes on differently")
        state = identifier.update(state, record.u[k], record.y[k + 1])
        moved = other.update(moved, record.u[k], record.y[k + 1])


def _hindsight(factory: Factory, workload: Workload) -> None:
    records = _shown(workload)
    with untouched(*records):
        result = factory().hindsight(records)
    losses = np.asarray(result.losses, dtype=float)
    expected = sum(len(r) - 1 for r in records)
    demand(losses.shape == (expected,), f"hindsight has {losses.shape} losses, expected ({expected},)")
    demand(np.isfinite(losses).all() and (losses >= -1e-12).all(), "a loss of hindsight is negative or not finite")
