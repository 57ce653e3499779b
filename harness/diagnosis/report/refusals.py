"""The sentences of refusals: why a candidate is not in the answer, in the words of a control engineer."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from harness.diagnosis.search.refusal import Kind, Refusal

_SENTENCES: dict[Kind, Callable[[Refusal], str]] = {
    Kind.NOT_SIMULATED: lambda r: "with it the model cannot be simulated along these records",
    Kind.COST: lambda r: "it was not tried to the end: the search had cost what it may",
    Kind.STOPPED: lambda r: (
        "its fit was stopped early: its steps would not bring it within reach of the best rival, or of what its "
        "parameters cost"
    ),
    Kind.UNCONVERGED: lambda r: "its fit did not converge",
    Kind.EVIDENCE: lambda r: (
        f"too little evidence: {r.numbers[0]:.1f} in log-likelihood on the estimation records (its parameters paid) "
        f"and {r.numbers[1]:.1f} on the validation records, {r.numbers[2]:.1f} asked of both together"
    ),
    Kind.ESTIMATION: lambda r: (
        f"the estimation records alone speak against it: {r.numbers[0]:.1f} in log-likelihood, its parameters paid, "
        f"{r.numbers[1]:g} asked"
    ),
    Kind.VALIDATION: lambda r: (
        f"the validation records do not confirm it: they gain {r.numbers[0]:.1f} in log-likelihood, "
        f"{r.numbers[1]:.1f} asked of them alone"
    ),
    Kind.COLOURED: lambda r: (
        f"an error that drifts explains these free runs as well: beside one it gains {r.numbers[0]:.1f} in "
        f"log-likelihood on the estimation records (its parameters paid) and {r.numbers[1]:.1f} on the validation "
        f"records, {r.numbers[2]:.1f} asked of both together"
    ),
    Kind.SHARE: lambda r: (
        f"it brings {100 * r.numbers[0]:.1f} % of what all effects together bring: next to nothing changes by it"
    ),
    Kind.SIZE: lambda r: (
        f"it changes {100 * r.numbers[0]:.2g} % of rates or readings, {100 * r.numbers[1]:g} % asked: nobody would "
        "miss it"
    ),
    Kind.AGAIN: lambda r: (
        f"it does not happen once: beside it the force that nobody measured jumps {r.numbers[0]:.0f} more times there"
    ),
    Kind.LASTING: lambda r: (
        f"it does not happen once: beside it {100 * r.numbers[0]:.0f} % of the error that lasts from sample to sample "
        "goes on"
    ),
    Kind.INCOHERENT: lambda r: (
        f"it does not repeat: amplitude and phase change along the records (evidence {r.numbers[0]:.1f})"
    ),
    Kind.SIGN: lambda r: f"{r.subject} = {r.numbers[0]:.3g} has a sign that physics forbids",
    Kind.BOUND: lambda r: f"{r.subject} ended on its bound, {r.numbers[0]:.3g}: these data do not determine it",
    Kind.UNDETERMINED: lambda r: (
        f"{r.subject} = {r.numbers[0]:.3g} is not determined by these data: the law is what it is without it"
    ),
    Kind.TRADED: lambda r: f"it only trades with {r.subject}, which these data tell without it and not beside it",
    Kind.LAW: lambda r: f"its values break its own law, which asks that {r.subject}",
    Kind.UNSEEN: lambda r: (
        f"beside it something moves {r.numbers[0]:.2g} times as fast as these samples can show: faster ones may"
    ),
    Kind.OTHER_LAW: lambda r: (
        f"beside it {r.subject} would be no such law any more: {'' if r.cause is None else refusal_text(r.cause)}"
    ),
    Kind.WITHDRAWN: lambda r: (
        "with it the model runs no nearer to the validation records than the nominal one at its nearest, or further"
    ),
}


def refusal_text(refusal: Refusal) -> str:
    """Return why a candidate is refused, in words.

    Examples
    --------
    >>> refusal_text(Refusal(Kind.SIGN, "Fc", (-0.1,)))
    'Fc = -0.1 has a sign that physics forbids'
    """
    return _SENTENCES[refusal.kind](refusal)


def refusals_text(refusals: Iterable[Refusal]) -> str:
    """Return all reasons in one line."""
    return "; ".join(map(refusal_text, refusals))
