"""Why a candidate is refused, as a value: what decides is its kind and its numbers; sentences belong to the report."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum


class Kind(Enum):
    """Kinds of refusal."""

    NOT_SIMULATED = "not simulated"
    """No start was found from which the model with it can be simulated along the records."""
    COST = "cost"
    """The search had cost what it may before it was tried to the end."""
    STOPPED = "stopped"
    """Its fit was left on its way: its steps did not bring it near the best rival, or to what its parameters cost."""
    UNCONVERGED = "unconverged"
    EVIDENCE = "evidence"
    """Both uses together gain too little: ``numbers`` are both gains and what is asked."""
    ESTIMATION = "estimation"
    """The estimation records alone gain too little: the gain and what is asked."""
    VALIDATION = "validation"
    """The validation records alone gain too little: the gain and what is asked."""
    COLOURED = "coloured"
    """Of free runs: beside an error that remembers, it gains too little: both gains and what is asked."""
    SHARE = "share"
    """It brings a negligible share of what all effects bring."""
    SIZE = "size"
    """It changes a negligible share of rates or readings: the share and what is asked."""
    INCOHERENT = "incoherent"
    """Amplitude and phase of a line change along the records: the evidence for that."""
    ANSWERING = "answering"
    """A line stands to the input in all records as an answer to it would: the evidence for that."""
    SIGN = "sign"
    """A parameter, the ``subject``, has a sign that its law does not have: the value."""
    BOUND = "bound"
    """A parameter, the ``subject``, lies on its bound: the bound."""
    UNDETERMINED = "undetermined"
    """The main parameter, the ``subject``, is not told from nothing, or from e times as much: its value."""
    TRADED = "traded"
    """Beside it the records tell no more what they told without it: the ``subject``, parameters that it trades with."""
    LAW = "law"
    """What its law asks of its values does not hold: the sentence of the law is the ``subject``."""
    UNSEEN = "unseen"
    """Something of the model is over sooner than the readings show: how many times as fast it is."""
    OTHER_LAW = "other law"
    """Beside it an effect that was found before, the ``subject``, is no law any more: ``cause`` says why."""
    AGAIN = "again"
    """What is said to happen once, the ``subject``, happens again: how often the force at its place jumps beside it."""
    LASTING = "lasting"
    """What is said to happen once, the ``subject``, leaves lasting errors of free runs: their share of those before."""
    WITHDRAWN = "withdrawn"
    """It was accepted, and taken back: with it the model runs no nearer to the validation records."""

    FULL_RATE = "full rate"
    """It was accepted at the rate of the search, and dropped: what it gains of all readings, and what is asked."""


WANT_OF_EVIDENCE = frozenset({Kind.EVIDENCE, Kind.ESTIMATION, Kind.VALIDATION, Kind.COLOURED, Kind.SHARE, Kind.SIZE})
"""Kinds that say nothing against a candidate but that the data do not ask for it."""
LINE_RIVALS = (Kind.INCOHERENT, Kind.ANSWERING)
"""What a line that is drawn once in a record is held against: one that is drawn anew, and the input's own."""


@dataclass(frozen=True)
class Refusal:
    """One reason to refuse a candidate.

    Parameters
    ----------
    kind : Kind
    subject : str
        The parameter, effect or sentence of a law that it is about.
    numbers : tuple of float
        See :class:`Kind`.
    cause : Refusal, optional
        Why, of another law.

    Examples
    --------
    >>> refused = Refusal(Kind.SIGN, "Fc", (-0.1,))
    >>> only([refused], WANT_OF_EVIDENCE), only([], WANT_OF_EVIDENCE)
    (False, True)
    """

    kind: Kind
    subject: str = ""
    numbers: tuple[float, ...] = ()
    cause: Refusal | None = None


def only(refusals: Iterable[Refusal], kinds: Collection[Kind]) -> bool:
    """Return True if every refusal is of one of these kinds; none at all is."""
    return all(refusal.kind in kinds for refusal in refusals)


def subjects(refusals: Iterable[Refusal], kind: Kind) -> set[str]:
    """Return what the refusals of a kind are about."""
    return {refusal.subject for refusal in refusals if refusal.kind is kind}
