"""A second opinion by free runs, where the records themselves deny what is likeliest beside an unmeasured force."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol

from harness.diagnosis.contested import nearer
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.misfit import overwhelmed
from harness.diagnosis.policy import Policy
from harness.diagnosis.runs.simple_fits import SimpleFits
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.signals import Dataset

JUDGED = "so the model is judged by its free runs: what they do not show is not looked for"
Hope = Callable[[Outcome], bool]
"""Whether what a search found may still become the answer: else it is not graded."""


class Again(Protocol):
    """Makes the diagnosis of the same data by free runs, once; or of the halves of every record."""

    def __call__(self, *, halves: bool = False, hope: Hope | None = None) -> Diagnosis | None:
        """Return it; None where there is no hope for what its search found."""


def searched_unless_carried(
    form: WholeForm, nominal: Fit, policy: Policy, searched: Callable[..., Outcome], again: Again | None
) -> tuple[Outcome, Diagnosis | None]:
    """Return what a search by likelihood finds, and a diagnosis by free runs that takes its place, or None.

    Where an unmeasured force does most of what moves the nominal model, and what a first effect makes of it, nothing is
    built on that effect before free runs were asked; where these do not follow either, the search goes on.

    - ``searched``: the search; takes ``lost`` and ``begun``, see :func:`harness.diagnosis.search.search.search`
    - ``again``: None where nothing judges by free runs
    """
    if again is None or not overwhelmed(form, nominal, policy):
        return searched(), None
    outcome = searched(lost=lambda fit: bool(overwhelmed(form, fit, policy)))
    weak = overwhelmed(form, outcome.model, policy)
    if not weak:
        return outcome, None
    other = again()
    if other is None or other.misfit:
        return searched(begun=outcome), None
    return outcome, _told(other, _carried(weak))


def second_opinion(first: Diagnosis, simple: SimpleFits | None, again: Again) -> Diagnosis | None:
    """Return the diagnosis by free runs that takes the place of a first one, or None where the first one stands.

    A likelihood with an unmeasured force may be carried by that force: where it would do most of what moves a mass,
    where one effect alone runs far nearer to the validation records than the answer, and where a model that lacks
    nothing runs far further from the validation records than from the others. Output error has no such force (Ljung
    1999, sec. 7.4), sees less, and errs otherwise. It stands where it brings free runs nearer; what the halves of all
    records tell has to bring the validation records as near as the others were, or they are of another machine.

    The search by free runs comes first, and is all where its answer would not be taken.

    - ``simple``: what compares the two in free runs
    """
    policy, weak = first.policy, overwhelmed(first.form, first.final, first.policy)
    if weak:
        other = again()
        return None if other is None or other.misfit else _told(other, _carried(weak))

    def comes_nearer(found: Outcome) -> bool:
        """Return whether a search led nearer to the validation records, or the nominal model by itself."""
        return any(nearer(simple, fit, first.final, policy) for fit in (found.model, found.nominal))

    halves = False
    if first.rival:
        why = (
            "the likeliest answer beside an unmeasured force is further from the validation records than "
            f"{first.rival} alone"
        )
    elif first.outcome.withdrawn:
        names = " and ".join(str(one.placed) for one in first.outcome.withdrawn)
        why = f"the likeliest answer beside an unmeasured force, {names}, runs no nearer to the validation records"
    elif first.astray:
        halves, why = (
            True,
            (
                "the likelihood finds nothing missing, but the error of free runs is "
                f"{first.runs.further:.2g} times as large on the validation records as on the others: every record is "
                "halved, the first parts to fit and the others to validate"
            ),
        )
    else:
        return None
    other = again(halves=halves, hope=comes_nearer)
    if other is None or not _able(first, other) or not nearer(simple, other.final, first.final, policy):
        return None
    return _told(other, why)


def _able(first: Diagnosis, other: Diagnosis) -> bool:
    """Return whether a diagnosis by free runs is an answer to what speaks against the first one."""
    found = other.verdict == "effects_found"
    if first.rival:
        return not other.misfit
    if first.outcome.withdrawn:
        return found or bool(first.misfit and not other.misfit)
    return found and first.runs.cured_by(other.final, first.policy)


def _carried(weak: Mapping[str, float]) -> str:
    """Return why a likelihood says nothing where unmeasured forces do these shares of what moves ports."""
    forces = " and ".join(f"{100 * share:.0f} % of what moves {port}" for port, share in weak.items())
    return f"with an unmeasured force of {forces}, any model would explain these readings"


def _told(again: Diagnosis, why: str) -> Diagnosis:
    """Return a diagnosis by free runs that says first why it takes another's place."""
    words = f"{why}, {JUDGED}"
    return replace(again, alarms=(words, *again.alarms), warnings=[words, *again.warnings])


def halved(dataset: Dataset) -> Dataset:
    """Return the data with the first half of every estimation and validation run to fit, the other to validate.

    Examples
    --------
    >>> import numpy as np
    >>> from harness.signals import Channel, PlantSpec, Run, Trajectory
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
    >>> record = Trajectory(np.arange(6) * 0.5, np.zeros((6, 1)), np.ones((6, 1)), spec)
    >>> data = halved(Dataset("x", (Run(record), Run(record, "validation"), Run(record, "test"))))
    >>> [(run.use, len(run.trajectory)) for run in data.runs]
    [('estimation', 3), ('estimation', 3), ('validation', 3), ('validation', 3), ('test', 6)]
    """
    parted = [run for run in dataset.runs if run.use != "test"]
    first = [replace(run, trajectory=run.trajectory[: len(run.trajectory) // 2], use="estimation") for run in parted]
    last = [replace(run, trajectory=run.trajectory[len(run.trajectory) // 2 :], use="validation") for run in parted]
    return replace(dataset, runs=(*first, *last, *(run for run in dataset.runs if run.use == "test")))
