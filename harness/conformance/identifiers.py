"""Checks of identifiers that learn from records."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from harness.conformance import fitted, seams, substance
from harness.conformance.feedback import feedback_told, stillness_told
from harness.conformance.results import Broken, Check, CheckResult, demand, run_checks
from harness.conformance.running import EXAMPLES, fit, for_all, one_step, untouched
from harness.conformance.subject import Factory, Subject, Subjects, shown
from harness.conformance.workloads import KINDS, Workload
from harness.errors import HarnessError
from harness.protocols import Identifier
from harness.signals import PlantSpec, Trajectory


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
    """
    return run_checks(identifier_checks(kinds=kinds, examples=examples), factory, expected_failures=expected_failures)


def identifier_checks(*, kinds: tuple[str, ...] = KINDS, examples: int = EXAMPLES) -> list[Check]:
    """Return the checks of an identifier, for ``pytest.mark.parametrize``.

    Examples
    --------
    >>> [check.name for check in identifier_checks()][:3]
    ['interface', 'learns', 'no_mutation']
    """
    subjects = Subjects(kinds, examples)

    def on_all(body: Callable[[Factory, Workload], None]) -> Callable[[Factory], None]:
        def hold(factory: Factory) -> None:
            subject = subjects(factory)
            for_all(subject.kinds, lambda workload: body(factory, workload), subject.examples)

        return hold

    def on_fits(body: Callable[[Subject, Workload], None]) -> Callable[[Factory], None]:
        return on_all(lambda factory, workload: body(subjects(factory), workload))

    def on_models(body: Callable[[Any, Trajectory], None]) -> Callable[[Factory], None]:
        # the checks of models draw the same systems, which are fitted once
        return on_all(lambda factory, workload: body(subjects(factory).model(workload), workload.probe.measured()))

    def on_survey(body: Callable[[Subject], None]) -> Callable[[Factory], None]:
        return lambda factory: body(subjects(factory))

    checks: list[tuple[str, str, Callable[[Factory], None]]] = [
        ("interface", "fit(trajectories, *, rng), options frozen", _interface),
        ("learns", "accepts at least one kind of data and predicts finite numbers", on_fits(_learns)),
        ("no_mutation", "fit changes neither its data nor itself nor anything global", on_all(_no_mutation)),
        ("any_sequence", "records in a tuple are as good as in a list", on_fits(_any_sequence)),
        ("deterministic", "the same data and rng give the same model", on_fits(_deterministic)),
        ("refit_equals_fresh_fit", "an earlier fit leaves no trace", on_fits(_refit)),
        ("models_stand_alone", "a later fit leaves an earlier model as it is", on_survey(substance.stands_alone)),
        ("pickles", "the identifier travels to another process", on_fits(_pickles)),
        ("no_seam_crossed", "nothing is differenced or windowed across two records", on_survey(seams.no_seam_crossed)),
        ("all_records_used", "every record is learned from", on_survey(seams.all_records_used)),
        ("bad_data_refused", "no data, too little, or of two plants: a named refusal", on_all(_bad_data)),
        ("truth_never_read", "true states in a record make no difference", on_fits(_truth)),
        ("data_matter", "other data give another model", on_survey(substance.data_matter)),
        ("beats_trivial", "predicts better than what needs no model", on_survey(substance.beats_trivial)),
        ("inputs_matter", "every input has an effect in the model", on_survey(substance.inputs_matter)),
        ("feedback_told", "records that show only a controller are refused or warned of", on_survey(feedback_told)),
        ("stillness_told", "records whose inputs never move are refused or warned of", on_survey(stillness_told)),
        ("start_matters", "a simulation starts where the record does", on_survey(substance.initial_state_matters)),
        ("model_burn_in", "a burn-in that leaves something to score", on_models(fitted.burn_in)),
        ("model_pure_steps", "a model's methods are pure", on_models(fitted.pure_steps)),
        ("model_batch_axes", "a model takes leading axes", on_models(fitted.batch_axes)),
        ("model_free_run", "a fast free run gives what the steps give", on_models(fitted.free_run_equals_steps)),
        ("model_no_look_ahead", "a prediction is made before its output is seen", on_models(fitted.no_look_ahead)),
        ("model_stored_and_read", "a model pickles, and its JSON is read back", on_models(fitted.stored_and_read)),
        ("model_other_data_refused", "data of another sample time are refused", on_models(fitted.other_data_refused)),
    ]
    return [Check(*check) for check in checks]


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


def _learns(subject: Subject, workload: Workload) -> None:
    model, predicted = subject.model(workload), subject.predicted(workload)
    demand(
        np.isfinite(predicted[int(model.burn_in) + 1 :]).all(), "one-step predictions after the burn-in are not finite"
    )
    demand(model.spec.outputs == workload.probe.spec.outputs, "the model's outputs are not those of the data")


def _no_mutation(factory: Factory, workload: Workload) -> None:
    identifier = factory()
    records = shown(workload)
    given = list(records)
    before = _state(identifier)
    with untouched(*records):
        fit(identifier, given)
    demand(len(given) == len(records), "fit changes the list of records that it was given")
    demand(all(a is b for a, b in zip(given, records, strict=True)), "fit reorders the list of records it was given")
    demand(_state(identifier) == before, "fit changes the identifier itself")


def _any_sequence(subject: Subject, workload: Workload) -> None:
    model = fit(subject.factory(), tuple(shown(workload)))
    demand(_same(subject, model, workload), "records in a tuple give another model than in a list")


def _same(subject: Subject, model: Any, workload: Workload) -> bool:
    """Return True if a model predicts, bit for bit, what the first fit to these records did."""
    return bool(np.array_equal(subject.predicted(workload), one_step(model, workload.probe), equal_nan=True))


def _state(identifier: Any) -> bytes:
    """Return everything that an identifier holds."""
    try:
        return pickle.dumps(identifier)
    except Exception as error:
        raise Broken(f"the identifier does not pickle: {type(error).__name__}: {error}") from error


def _deterministic(subject: Subject, workload: Workload) -> None:
    again = fit(subject.factory(), shown(workload))
    demand(_same(subject, again, workload), "two fits with the same data and rng differ")


def _refit(subject: Subject, workload: Workload) -> None:
    subject.predicted(workload)  # before any other fit
    used = subject.factory()
    fit(used, [workload.probe.measured()])
    again = fit(used, shown(workload))
    demand(_same(subject, again, workload), "a second fit differs from a fresh one: the first left a trace")


def _pickles(subject: Subject, workload: Workload) -> None:
    copy = fit(pickle.loads(_state(subject.factory())), shown(workload))
    demand(_same(subject, copy, workload), "a pickled identifier fits something else")


def _bad_data(factory: Factory, workload: Workload) -> None:
    _refused(factory, [], "no records")
    first = workload.first.measured()
    spec = first.spec
    other = PlantSpec(spec.inputs, spec.outputs, 3 * spec.sample_time, spec.states, spec.feedthrough)
    _refused(factory, [first, Trajectory(first.t * 3, first.u, first.y, other)], "records of two sample times")
    renamed = tuple(replace(channel, name=f"other {channel.name}") for channel in spec.outputs)
    foreign = PlantSpec(spec.inputs, renamed, spec.sample_time, spec.states, spec.feedthrough)
    _refused(factory, [first, Trajectory(first.t, first.u, first.y, foreign)], "records of other channels")
    _standstill(factory, workload)
    for short in (first[:1], first[:2], first[:3]):
        try:
            model = fit(factory(), [short])
        except HarnessError:
            continue
        predicted = one_step(model, workload.probe)[int(model.burn_in) + 1 :]
        demand(np.isfinite(predicted).all(), f"a record of {len(short)} samples gives a model that predicts no numbers")


def _standstill(factory: Factory, workload: Workload) -> None:
    """Demand a refusal, or a model that predicts numbers, from a record in which nothing moves."""
    first = workload.first.measured()
    try:
        model = fit(factory(), [Trajectory(first.t, 0 * first.u, np.tile(first.y[:1], (len(first), 1)), first.spec)])
        predicted = one_step(model, workload.probe)[int(model.burn_in) + 1 :]
    except HarnessError:
        return
    demand(np.isfinite(predicted).all(), "a record in which nothing moves gives a model that predicts no numbers")


def _refused(factory: Factory, records: list[Trajectory], what: str) -> None:
    """Demand a named refusal."""
    try:
        fit(factory(), records)
    except HarnessError:
        return
    raise Broken(f"{what} are accepted; expected a FitError or an InputError")


def _truth(subject: Subject, workload: Workload) -> None:
    trapped = [
        Trajectory(r.t, r.u, r.y, r.spec, np.full((len(r), max(len(r.spec.states), 1)), 1e6))
        for r in (workload.first, workload.second)
    ]
    for records in (trapped, [workload.first, workload.second]):
        model = fit(subject.factory(), records)
        demand(_same(subject, model, workload), "the true states in the records change the model")
