"""The sentences of refusals: why a candidate is not in the answer, in the words of a control engineer."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from harness.diagnosis.search.refusal import Kind, Refusal

_SENTENCES: dict[Kind, Callable[[Refusal], str]] = {
    Kind.NOT_SIMULATED: lambda r: "with it the model cannot be simulated on these records",
    Kind.COST: lambda r: "it was not tried to the end: the search had reached its cost limit",
    Kind.STOPPED: lambda r: (
        "its fit was stopped early: its steps would not bring it within reach of the best rival, or of the cost of "
        "its parameters"
    ),
    Kind.UNCONVERGED: lambda r: "its fit did not converge",
    Kind.EVIDENCE: lambda r: (
        f"too little evidence: {r.numbers[0]:.1f} in log-likelihood on the estimation records (cost of parameters off) "
        f"and {r.numbers[1]:.1f} on the validation records; {r.numbers[2]:.1f} needed in total"
    ),
    Kind.ESTIMATION: lambda r: (
        f"the estimation records alone speak against it: {r.numbers[0]:.1f} in log-likelihood (cost of parameters "
        f"off), {r.numbers[1]:g} needed"
    ),
    Kind.VALIDATION: lambda r: (
        f"the validation records do not confirm it: they gain {r.numbers[0]:.1f} in log-likelihood, "
        f"{r.numbers[1]:.1f} needed from them alone"
    ),
    Kind.COLOURED: lambda r: (
        f"a drifting error explains these free runs as well: with one in the model it gains {r.numbers[0]:.1f} in "
        f"log-likelihood on the estimation records (cost of parameters off) and {r.numbers[1]:.1f} on the validation "
        f"records; {r.numbers[2]:.1f} needed in total"
    ),
    Kind.SHARE: lambda r: f"it brings only {100 * r.numbers[0]:.1f} % of what all effects bring together",
    Kind.SIZE: lambda r: (
        f"it changes rates or readings by {100 * r.numbers[0]:.2g} %, {100 * r.numbers[1]:g} % needed: nobody would "
        "miss it"
    ),
    Kind.AGAIN: lambda r: (
        f"it does not happen only once: with it the unmeasured force still jumps {r.numbers[0]:.0f} more times there"
    ),
    Kind.LASTING: lambda r: (
        f"it does not happen only once: with it {100 * r.numbers[0]:.0f} % of the lasting error from sample to sample "
        "goes on"
    ),
    Kind.INCOHERENT: lambda r: (
        f"it does not repeat: amplitude and phase change along the records (evidence {r.numbers[0]:.1f})"
    ),
    Kind.ANSWERING: lambda r: (
        "the input has this frequency too, and the wave goes with it in every record: it may be a part of the plant's "
        f"answer that the model lacks (evidence {r.numbers[0]:.1f})"
    ),
    Kind.SIGN: lambda r: f"{r.subject} = {r.numbers[0]:.3g} has a sign that physics forbids",
    Kind.BOUND: lambda r: f"{r.subject} ended on its bound, {r.numbers[0]:.3g}: these data do not determine it",
    Kind.UNDETERMINED: lambda r: (
        f"{r.subject} = {r.numbers[0]:.3g} is not determined by these data: the law is the same without it"
    ),
    Kind.TRADED: lambda r: f"it only trades with {r.subject}, which these data determine without it but not with it",
    Kind.LAW: lambda r: f"its values break its own law, which requires that {r.subject}",
    Kind.UNSEEN: lambda r: (
        f"with it something moves {r.numbers[0]:.2g} times as fast as these samples can show: sample faster"
    ),
    Kind.OTHER_LAW: lambda r: (
        f"with it {r.subject} would no longer be such a law: {'' if r.cause is None else refusal_text(r.cause)}"
    ),
    Kind.WITHDRAWN: lambda r: (
        "with it the model comes no closer to the validation records than the nominal one at its best"
    ),
    Kind.FULL_RATE: lambda r: (
        f"only the lower rate of the search asked for it: of all readings it gains {r.numbers[0]:.1f} in "
        f"log-likelihood (cost of parameters off), {r.numbers[1]:g} needed"
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
