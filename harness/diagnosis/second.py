"""A second opinion by free runs, where the records themselves deny what is likeliest beside an unmeasured force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from harness.diagnosis.contested import nearer
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.kinds import Kind
from harness.diagnosis.misfit import overwhelmed
from harness.diagnosis.runs.simple_fits import SimpleFits
from harness.signals import Dataset

__all__ = ["halved", "second_opinion"]

JUDGED = "so the model is judged by its free runs: what they do not show is not looked for"


def second_opinion(
    first: Diagnosis, kind: Kind, simple: SimpleFits | None, ask: Callable[[Kind, Dataset], Diagnosis]
) -> Diagnosis | None:
    """Return the diagnosis by free runs that takes the place of a first one, or None where the first one stands.

    A likelihood with an unmeasured force may be carried by that force: where it would do most of what moves a mass,
    where one effect alone runs far nearer to the validation records than the answer, and where a model that lacks
    nothing runs far further from the validation records than from the others. Output error has no such force (Ljung
    1999, sec. 7.4), sees less, and errs otherwise. It stands where it brings free runs nearer.

    Parameters
    ----------
    first : Diagnosis
    kind : Kind
        That the first one was made with.
    simple : SimpleFits or None
        What compares the two in free runs.
    ask : callable
        Makes a diagnosis of data with a kind.
    """
    other = kind.by_free_runs() if first.form.latent else None
    if other is None:
        return None
    policy, weak = first.policy, overwhelmed(first.form, first.final, first.policy)
    if weak:
        forces = " and ".join(f"{100 * share:.0f} % of what moves {port}" for port, share in weak.items())
        why = f"an unmeasured force of {forces} would explain these readings whatever the model is"
        again = ask(other, first.dataset)
        stands = not again.misfit
    elif first.rival:
        why = (
            "what is likeliest beside an unmeasured force runs further from the validation records than "
            f"{first.rival} alone"
        )
        again = ask(other, first.dataset)
        stands = not again.misfit and nearer(simple, again.final, first.final, policy)
    elif first.outcome.withdrawn:
        names = " and ".join(str(one.placed) for one in first.outcome.withdrawn)
        why = f"what is likeliest beside an unmeasured force, {names}, runs further from the validation records"
        again = ask(other, first.dataset)
        found = again.verdict == "effects_found" or (first.misfit and not again.misfit)
        stands = bool(found) and nearer(simple, again.final, first.final, policy)
    elif first.astray:
        why = (
            f"free runs of a model that lacks nothing err {first.runs.further:.2g} times as far on the validation "
            "records as on the others: every record is halved, the first parts to fit and the others to validate"
        )
        again = ask(other, halved(first.dataset))
        stands = again.verdict == "effects_found" and nearer(simple, again.final, first.final, policy)
    else:
        return None
    if not stands:
        return None
    words = f"{why}, {JUDGED}"
    return replace(again, alarms=(words, *again.alarms), warnings=[words, *again.warnings])


def halved(dataset: Dataset) -> Dataset:
    """Return the data with the first half of every estimation and validation run to fit, the other to validate.

    Parameters
    ----------
    dataset : Dataset

    Returns
    -------
    Dataset

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
