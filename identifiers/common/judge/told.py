"""What records do not determine of a model, said in its notes: asked once, of every fit that learns what inputs do."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from harness.errors import HarnessError
from harness.judgement import ALONE, NEW, Feedback, feedback_of, law_of, reached_at_once
from harness.models.determined import KEY
from harness.scoring import predict
from harness.signals import Dataset, Run, Trajectory
from identifiers.common.excitation import excited_lags, unexcited
from identifiers.common.judge.loops import ANSWERED, doubt_of_loop
from identifiers.common.judge.own_record import Readings, doubt_of_own_record

ASKED = 4
"""Lags of the inputs that a linear model of two states asks for: fewer tell no model that does not say its
frequencies."""
MOVED = 10
"""Lags, or moves that the past does not foretell, that such a model asks for as well: of one step, or a line or two, it
has the answer to these alone. Four steps of a size are 12 moves, five lines 10 lags."""
GUESSED, GUESSES = 0.25, 100
"""What a model bends by over what two levels of an input do, from which on it is said, and samples asked for that."""
UNTOLD = 0.97
"""What an input's own past leaves of it, from which on it is white (0.98 of 1000 samples): a controller's command is
neither that nor told by no earlier output (``ALONE``), in any of 252 loops that are moved by a tenth of the input and
more (benchmarks/feedback_judge.py, base 300000)."""
CHECKED = 5_000  # Samples that are looked at.

Fit = TypeVar("Fit", bound=Callable[..., Any])


def told(fit: Fit) -> Fit:
    """Return a ``fit`` whose model warns of what its records do not determine.

    Inputs that move too little for a model that does not say its frequencies, a controller alone or a loop that hides
    the plant, and a model that its own records contradict. Readings that are none are noted (``odd_readings``), and
    warned of where the model contradicts the others, or none is left to ask. Nothing is asked where the identifier's
    ``least_excitation`` is 0, or the fit warns already.

    For plug-ins too: the model is a dataclass with a dictionary ``notes``, where the finding stands under ``warning``.

    - ``fit``: of :class:`harness.protocols.Identifier`
    - returns the same fit
    """

    @functools.wraps(fit)
    def judged(self: Any, trajectories: Sequence[Trajectory], *, rng: np.random.Generator) -> Any:
        model = fit(self, trajectories, rng=rng)
        if getattr(self, "least_excitation", 1.0) <= 0 or model.notes.get("warning") or model.notes.get("warnings"):
            return model
        records = _some(trajectories)
        if not records or records[0].spec.nu == 0:
            return model
        records, readings, said = _looked(records)
        feedback = feedback_of(records)
        doubt: str | None = _controlled(records, feedback) or _at_once(records, feedback)
        doubt = doubt or _unmoved(model, records, feedback)
        if not (doubt or said):
            doubt = doubt_of_loop(model, records, feedback)
        if not doubt:
            doubt = doubt_of_own_record(model, records, feedback, readings)
        if said and (doubt is None or doubt):
            doubt = f"the records hold readings that are none: {said}; load_dataset and examined leave them out" + (
                f" ({doubt})" if doubt else ""
            )
        found = {"odd_readings": said} if said else {}
        found |= {"warning": doubt} if doubt else {}
        return replace(model, notes={**model.notes, **found}) if found else model

    return cast(Fit, judged)


def _looked(records: list[Trajectory]) -> tuple[list[Trajectory], list[Readings], str]:
    """Return records with what is no reading mended, which values are some, and in words what is not.

    It is what ``sysid check-data`` says, and commands leave out.
    """
    from harness.data.oddities import examined, lines  # SciPy's statistics take a second to load

    looked = examined(Dataset("records", tuple(map(Run, records))))
    found = looked.oddities or ()
    said = lines(found)
    readings = [np.ones(record.y.shape, dtype=bool) for record in records]
    if not said:
        return records, readings, ""
    mended = [run.trajectory for run in looked.runs]
    for record, good in zip(mended, readings, strict=True):
        if record.missing is not None:
            good &= ~record.missing
    outputs = [channel.name for channel in records[0].spec.outputs]
    for odd in found:
        if odd.fault and odd.channel in outputs:
            readings[odd.run][list(odd.rows), outputs.index(odd.channel)] = False
    more = f" (and {len(said) - 1} more)" if len(said) > 1 else ""
    return [replace(record, missing=None) for record in mended], readings, said[0] + more


def _controlled(records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return the law of a controller, in words, that the inputs follow with nothing beside it; empty if there is none.

    Our own fits refuse such records; this is for those that do not ask.
    """
    if not (feedback.found or feedback.unforeseen < NEW) or (law := law_of(records)) is None:
        return ""
    return (
        f"{law.text} up to {law.departure:.1e} of full size: what the inputs do without the controller is not in the "
        "records; add an excitation to what it commands"
    )


def _at_once(records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return what is wrong where outputs of the same sample, and nothing before, tell an input."""
    spec = records[0].spec
    if reached_at_once(records):
        return (
            "the outputs respond to the inputs of the same sample, as this model cannot: declare feedthrough = true, "
            "or remove what the inputs add to the readings (crosstalk); a relay that switches on them looks alike"
        )
    if spec.feedthrough or not feedback.found or feedback.share <= ANSWERED or feedback.unforeseen < UNTOLD:
        return ""
    before = feedback_of([replace(record, spec=replace(spec, feedthrough=True)) for record in records])
    if before.probability < ALONE:
        return ""
    return (
        "an input follows the outputs of the same sample, and nothing earlier predicts it: either an output "
        "responds within the sample (declare feedthrough = true, or the model is wrong), or a controller "
        "acts at once; the records cannot tell which"
    )


def _unmoved(model: Any, records: Sequence[Trajectory], feedback: Feedback) -> str:
    """Return what is wrong where the inputs move too little for a model that no frequencies say enough of."""
    if model.notes.get(KEY) is not None and getattr(model, "matrices", None) is not None:
        return ""
    if poor := unexcited(records, ASKED):
        return poor
    lags = excited_lags(records, MOVED)
    if min(lags, feedback.moves) >= MOVED:
        return _guessed(model, records)
    moved = f"{feedback.moves:.0f} moves" if feedback.moves < lags else f"{lags} lags"
    return (
        f"the inputs excite no more than {moved}; a model without an order then knows the response to such inputs "
        "only; use a richer input (more steps, lines, noise), or a linear model of low order"
    )


def _guessed(model: Any, records: Sequence[Trajectory]) -> str:
    """Return what is wrong where a model bends between the only two levels of an input, or beyond them.

    Two levels tell no curve: half way between them, and half a step beyond, an affine model predicts what its answers
    to both foretell, and another one a guess (Ljung 1999, sec. 13.3).
    """
    record, u = records[0][:GUESSES], np.concatenate([one.u for one in records])
    for column, channel in enumerate(record.spec.inputs):
        levels = np.unique(u[:, column])
        if levels.size != 2 or channel.kind != "real":
            continue
        given = [np.where(np.arange(u.shape[1]) == column, level, record.u) for level in _beside(*levels)]
        try:
            with np.errstate(all="ignore"):
                ahead = [predict(model, replace(record, u=one), 1)[int(model.burn_in) + 1 :] for one in given]
        except HarnessError:  # a model that predicts nothing of these records says so elsewhere
            return ""
        low, high, between, beyond = ahead
        bent = [np.mean((between - 0.5 * (low + high)) ** 2), np.mean((beyond - 1.5 * high + 0.5 * low) ** 2)]
        if max(bent) > GUESSED**2 * np.mean((high - low) ** 2):
            return (
                f"{channel.name} takes two levels, and the model bends between them or beyond: its response to "
                "other levels is a guess; use an input with more levels, or a model that is linear in it"
            )
    return ""


def _beside(low: float, high: float) -> tuple[float, float, float, float]:
    """Return two levels, half way between them and half their distance beyond."""
    return low, high, 0.5 * (low + high), high + 0.5 * (high - low)


def _some(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Return records without holes, up to so many samples in all."""
    some, left = [], CHECKED
    for record in trajectories:
        if left > 0 and record.missing is None:
            some.append(record[:left])
            left -= len(record)
    return some
