"""Checks of identifiers that learn from records."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.conformance import fitted
from harness.conformance.results import Broken, Check, CheckResult, demand, run_checks
from harness.conformance.running import EXAMPLES, alike, fit, for_all, one_step, untouched
from harness.conformance.workloads import KINDS, Workload, kinds_for
from harness.errors import HarnessError
from harness.protocols import Identifier
from harness.signals import PlantSpec, Trajectory

__all__ = ["check_identifier", "identifier_checks"]

Factory = Callable[[], Any]
_SLOW = 1.0
# seconds for two fits, beyond which each check draws two systems only


def check_identifier(
    factory: Factory,
    *,
    kinds: tuple[str, ...] = KINDS,
    expected_failures: Mapping[str, str] | None = None,
    examples: int = EXAMPLES,
) -> list[CheckResult]:
    """Hold an identifier to its contract.

    Parameters
    ----------
    factory : callable
        Returns a fresh identifier each time; a class will do.
    kinds : tuple of str
        Kinds of data to try; at least one must be accepted. ``plant:ID`` records a registered plant.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail; strict.
    examples : int
        Systems drawn for each check; 2 for an identifier that takes seconds to fit.

    Returns
    -------
    list of CheckResult
    """
    return run_checks(identifier_checks(kinds=kinds, examples=examples), factory, expected_failures=expected_failures)


def identifier_checks(*, kinds: tuple[str, ...] = KINDS, examples: int = EXAMPLES) -> list[Check]:
    """Return the checks of an identifier, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in identifier_checks()][:3]
    ['interface', 'learns', 'no_mutation']
    """
    cache: dict[int, tuple[str, ...]] = {}
    drawn: dict[int, int] = {}
    models: dict[tuple[int, Workload], Any] = {}

    def accepted(factory: Factory) -> tuple[str, ...]:
        """Return the kinds of data that this identifier accepts, found once."""
        if id(factory) not in cache:
            started = time.perf_counter()
            found, refused = kinds_for(lambda w: fit(factory(), [w.first.measured(), w.second.measured()]), kinds)
            why = "; ".join(f"{kind}: {reason}" for kind, reason in refused.items())
            demand(found, f"it refuses every kind of data ({why})")
            slow = (time.perf_counter() - started) / len(found) > _SLOW
            cache[id(factory)], drawn[id(factory)] = found, min(examples, 2) if slow else examples
        return cache[id(factory)]

    def on_all(body: Callable[[Factory, Workload], None]) -> Callable[[Factory], None]:
        def hold(factory: Factory) -> None:
            found = accepted(factory)
            for_all(found, lambda workload: body(factory, workload), drawn[id(factory)])

        return hold

    def on_models(body: Callable[[Any, Trajectory], None]) -> Callable[[Factory], None]:
        def run(factory: Factory, workload: Workload) -> None:
            key = (id(factory), workload)  # the checks of models draw the same systems: fit them once
            if key not in models:
                models[key] = fit(factory(), _shown(workload))
            body(models[key], workload.probe.measured())

        return on_all(run)

    return [
        Check("interface", "fit(trajectories, *, rng), options frozen", _interface),
        Check("learns", "accepts at least one kind of data and predicts finite numbers", on_all(_learns)),
        Check("no_mutation", "fit changes neither its data nor itself nor global state", on_all(_no_mutation)),
        Check("deterministic", "the same data and rng give the same model", on_all(_deterministic)),
        Check("refit_equals_fresh_fit", "an earlier fit leaves no trace", on_all(_refit)),
        Check("pickles", "the identifier travels to another process", on_all(_pickles)),
        Check("no_seam_crossed", "nothing is differenced or windowed across two records", on_all(_no_seam)),
        Check("bad_data_refused", "no data, too little, or of two plants: a named refusal", on_all(_bad_data)),
        Check("truth_never_read", "true states in a record make no difference", on_all(_truth)),
        Check("model_pure_steps", "a model's methods are pure", on_models(fitted.pure_steps)),
        Check("model_batch_axes", "a model takes leading axes", on_models(fitted.batch_axes)),
        Check("model_no_look_ahead", "a prediction is made before its output is seen", on_models(fitted.no_look_ahead)),
        Check("model_stored_and_read", "a model pickles, and its JSON is read back", on_models(fitted.stored_and_read)),
        Check(
            "model_other_data_refused", "data of another sample time are refused", on_models(fitted.other_data_refused)
        ),
    ]


def _shown(workload: Workload) -> list[Trajectory]:
    """Return the records that a fit sees."""
    return [workload.first.measured(), workload.second.measured()]


def _interface(factory: Factory) -> None:
    identifier = factory()
    demand(isinstance(identifier, Identifier), f"{type(identifier).__name__} has no fit(trajectories, *, rng)")
    names = [name for name in vars(identifier) if not name.startswith("_")] if hasattr(identifier, "__dict__") else []
    for name in names:
        try:
            setattr(identifier, name, getattr(identifier, name))
        except (AttributeError, TypeError):
            return
    demand(not names, f"options can be changed ({', '.join(names)}): make it a frozen dataclass")


def _learns(factory: Factory, workload: Workload) -> None:
    model = fit(factory(), _shown(workload))
    predicted = one_step(model, workload.probe)
    demand(
        np.isfinite(predicted[int(model.burn_in) + 1 :]).all(), "one-step predictions after the burn-in are not finite"
    )
    demand(model.spec.outputs == workload.probe.spec.outputs, "the model's outputs are not those of the data")


def _no_mutation(factory: Factory, workload: Workload) -> None:
    identifier = factory()
    records = _shown(workload)
    given = list(records)
    before = _state(identifier)
    with untouched(*records):
        fit(identifier, given)
    demand(_state(identifier) == before, "fit changes the identifier itself")


def _state(identifier: Any) -> bytes:
    """Return everything that an identifier holds."""
    try:
        return pickle.dumps(identifier)
    except Exception as error:
        raise Broken(f"the identifier does not pickle: {type(error).__name__}: {error}") from error


def _deterministic(factory: Factory, workload: Workload) -> None:
    records = _shown(workload)
    one, two = fit(factory(), records), fit(factory(), records)
    demand(alike(one, two, workload.probe), "two fits with the same data and rng differ")


def _refit(factory: Factory, workload: Workload) -> None:
    used = factory()
    fit(used, [workload.probe.measured()])
    again, fresh = fit(used, _shown(workload)), fit(factory(), _shown(workload))
    demand(alike(again, fresh, workload.probe), "a second fit differs from a fresh one: the first left a trace")


def _pickles(factory: Factory, workload: Workload) -> None:
    identifier = factory()
    copy = pickle.loads(_state(identifier))
    one, two = fit(identifier, _shown(workload)), fit(copy, _shown(workload))
    demand(alike(one, two, workload.probe), "a pickled identifier fits something else")


def _no_seam(factory: Factory, workload: Workload) -> None:
    """Two records whose seam contradicts the system, in both orders.

    Sound: the order makes no difference, or the fit is exact on exact data, or (for identifiers that depend on the
    order) the contradiction does not spoil the predictions compared with one record alone.
    """
    a, b = _shown(workload)
    forth, back = fit(factory(), [a, b]), fit(factory(), [b, a])
    if alike(forth, back, workload.probe, tolerance=1e-6):
        return
    errors = [_error(model, workload.probe) for model in (forth, back)]
    if max(errors) < 1e-6:
        return
    alone = max(_error(fit(factory(), [a]), workload.probe), 1e-9)
    whole = fit(factory(), [a, b[: len(b) // 2], b[len(b) // 2 :]])  # a seam that contradicts nothing
    if alike(whole, forth, workload.probe, tolerance=1e-6) and max(errors) < 3 * alone:
        return
    demand(
        max(errors) < 1.5 * alone and max(errors) < 1.2 * min(errors),
        "the order of two records changes the model: something is differenced or windowed across their seam",
    )


def _error(model: Any, data: Trajectory) -> float:
    """Return the one-step error relative to the size of the outputs."""
    skip = int(model.burn_in) + 1
    difference = one_step(model, data)[skip:] - data.y[skip:]
    if not np.isfinite(difference).all():
        return float("inf")
    return float(np.sqrt(np.mean(difference**2)) / (data.y.std() or 1.0))


def _bad_data(factory: Factory, workload: Workload) -> None:
    _refused(factory, [], "no records")
    first = workload.first.measured()
    spec = first.spec
    other = PlantSpec(spec.inputs, spec.outputs, 3 * spec.sample_time, spec.states, spec.feedthrough)
    _refused(factory, [first, Trajectory(first.t * 3, first.u, first.y, other)], "records of two sample times")
    for short in (first[:1], first[:2], first[:3]):
        try:
            model = fit(factory(), [short])
        except HarnessError:
            continue
        predicted = one_step(model, workload.probe)[int(model.burn_in) + 1 :]
        demand(np.isfinite(predicted).all(), f"a record of {len(short)} samples gives a model that predicts no numbers")


def _refused(factory: Factory, records: list[Trajectory], what: str) -> None:
    """Demand a named refusal."""
    try:
        fit(factory(), records)
    except HarnessError:
        return
    raise Broken(f"{what} are accepted; expected a FitError or an InputError")


def _truth(factory: Factory, workload: Workload) -> None:
    plain = fit(factory(), _shown(workload))
    trapped = [
        Trajectory(r.t, r.u, r.y, r.spec, np.full((len(r), max(len(r.spec.states), 1)), 1e6))
        for r in (workload.first, workload.second)
    ]
    for records in (trapped, [workload.first, workload.second]):
        model = fit(factory(), records)
        demand(alike(plain, model, workload.probe), "the true states in the records change the model")
