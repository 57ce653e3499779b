"""How an answer counts: right, tied, wrong or missed; and which effects are exactly the same on a plant."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

from sysid_lab.truths.disturbances import UNNAMED, named

Group = frozenset[str]
STAND_IN = "said to be a stand-in"
_SAME: dict[str, tuple[tuple[Group, ...], ...]] = {
    "pendulum": (
        (
            frozenset({"gravity_tilt@base"}),
            frozenset({"sensor_offset@theta"}),
            frozenset({"eccentric_load@theta"}),
        ),
        (
            frozenset({"asymmetric_friction@theta"}),
            frozenset({"coulomb_friction@theta", "force_bias@theta"}),
        ),
        (
            frozenset({"input_delay@u"}),
            frozenset({"sensor_delay@theta"}),
        ),  # nothing but the input before the record tells a late input from a late reading of all there is
    ),
    "cart-pole": tuple(
        (
            frozenset({f"asymmetric_friction@{at}"}),
            frozenset({f"coulomb_friction@{at}", f"force_bias@{at}"}),
        )
        for at in ("x", "theta")
    ),
}
_DAHL: dict[str, tuple[tuple[Group, ...], ...]] = {
    plant: tuple((frozenset({f"coulomb_friction@{at}"}), frozenset({f"hysteresis@{at}"})) for at in places)
    for plant, places in (("pendulum", ("theta",)), ("cart-pole", ("x", "theta")))
}
"""The dry friction of hardware is Dahl's, which is the dictionary's hysteresis with beta = 1, term by term."""


_REFINED = {
    "lugre_coulomb_friction": "coulomb_friction",
    "lugre_friction": "stribeck_friction",
    "lugre_asymmetric_friction": "asymmetric_friction",
    "lugre_load_dependent_friction": "load_dependent_friction",
    "lugre_position_dependent_friction": "position_dependent_friction",
    "parallel_hysteresis": "hysteresis",
    "hardening_elasticity": "elasticity",
    "unilateral_backlash": "backlash",
}
"""Laws as hardware has them, and the laws that they refine: either name says what is hidden there."""
_ABSORBED = {"pendulum": frozenset({"input_gain@u"}), "cart-pole": frozenset({"input_gain@u", "sensor_offset@x"})}
"""Exactly the same as a common factor on all nominal parameters, which are free, or as another start."""


def has_double(truth: Collection[str], plant: str, engine: str = "") -> bool:
    """Return whether something else is exactly the same as the truth on a plant: no experiment tells it apart.

    Examples
    --------
    >>> has_double({"sensor_delay@theta"}, "pendulum"), has_double({"sensor_delay@theta"}, "cart-pole")
    (True, False)
    """
    wanted = frozenset(truth)
    if engine == "hardware" and "input_delay@u" in wanted:
        return False  # a command held by a slower clock
    same = (*_SAME[plant], *(_DAHL[plant] if engine == "hardware" else ()))
    return bool(wanted & _ABSORBED[plant]) or any(member <= wanted for family in same for member in family)


@dataclass(frozen=True)
class Answer:
    """What a diagnosis said.

    Attributes
    ----------
    verdict : str
        ``effects_found``, ``nothing_missing``, ``unexplained`` or ``model_does_not_fit``.
    accepted : tuple of str
        ``effect@place``.
    ties : tuple of tuple of frozenset
        For each accepted effect, all members of its tie set; a member may hold two effects.
    unseen : frozenset of str
        Effects that the report says this experiment cannot show.
    stand_in : bool
        The report says that the accepted effects imitate something that is not in the dictionary.
    """

    verdict: str
    accepted: tuple[str, ...]
    ties: tuple[tuple[Group, ...], ...] = ()
    unseen: Group = frozenset()
    stand_in: bool = False

    def without(self, name: str) -> Answer:
        """Return the answer without an effect that is there beside what is hidden; no fault of an answer either way.

        Examples
        --------
        >>> Answer("effects_found", ("sensor_cyclic_error@theta",)).without("sensor_cyclic_error@theta")
        Answer(verdict='nothing_missing', accepted=(), ties=(), unseen=frozenset(), stand_in=False)
        """
        if name not in self.accepted:
            return self
        kept = [(effect, tie) for effect, tie in zip(self.accepted, _padded(self), strict=True) if effect != name]
        left = self.verdict if kept or self.verdict != "effects_found" else "nothing_missing"
        verdict = "unexplained" if left == "nothing_missing" and self.stand_in else left
        return replace(
            self, verdict=verdict, accepted=tuple(effect for effect, _ in kept), ties=tuple(tie for _, tie in kept)
        )

    def by_plain_law(self) -> Answer:
        """Return the answer with laws that refine others by the names of these.

        Examples
        --------
        >>> Answer("effects_found", ("lugre_friction@x",)).by_plain_law().accepted
        ('stribeck_friction@x',)
        """

        def named_so(group: Group) -> Group:
            return frozenset(map(plain_law, group))

        ties = tuple(tuple(dict.fromkeys(map(named_so, tie))) for tie in self.ties)
        return replace(self, accepted=tuple(map(plain_law, self.accepted)), ties=ties, unseen=named_so(self.unseen))


def plain_law(name: str) -> str:
    """Return an effect with the name of the law that it refines, if it does.

    Examples
    --------
    >>> plain_law("lugre_friction@x"), plain_law("cogging@x")
    ('stribeck_friction@x', 'cogging@x')
    """
    law, _, at = name.partition("@")
    return f"{_REFINED.get(law, law)}@{at}"


@dataclass(frozen=True)
class Outcome:
    """The word and its reason.

    Attributes
    ----------
    word : str
        ``right``, ``tied``, ``wrong``, ``missed``, or ``flagged``: said that something is missing, and no effect named
        as the cause (none accepted, or the accepted ones called a stand-in).
    how : str
        What made it tied, wrong or flagged; for a right answer, that it was called a stand-in all the same.
    """

    word: str
    how: str = ""


def judge_answer(truth: Collection[str], answer: Answer, plant: str, engine: str = "", structure: str = "") -> Outcome:
    """Return how an answer counts.

    Right: the accepted set is the truth, effect and place. Tied: one member can be chosen for each accepted effect
    (from its tie set, or from its exactly equal family on this plant and engine) so that together they are the truth;
    or nothing was accepted, and the report says that the truth cannot be told from the nominal parameters. Other sets
    are wrong, unless the report calls them a stand-in: then something was flagged, as where it says that the model does
    not fit, whatever it was tried with. An effect that names how the nominal structure is wrong
    (:func:`sysid_lab.truths.disturbances.named`) may stand beside what is hidden; one without a name is missing all the
    same, and is flagged as any law outside the dictionary is. In hardware bristles carry the dry frictions, joints
    stiffen with their twist, flanks never pull and a hysteresis has several slip elements: laws that have this count as
    those that they refine.

    Examples
    --------
    >>> judge_answer({"gravity_tilt@base"}, Answer("effects_found", ("sensor_offset@theta",)), "pendulum").word
    'tied'
    >>> judge_answer({"coulomb_friction@x"}, Answer("effects_found", ("coulomb_friction@theta",)), "cart-pole").word
    'wrong'
    >>> judge_answer({"coulomb_friction@x"}, Answer("effects_found", ("hysteresis@x",)), "cart-pole", "hardware").word
    'tied'
    >>> judge_answer({"stribeck_friction@x"}, Answer("effects_found", ("lugre_friction@x",)), "cart-pole").word
    'wrong'
    >>> judge_answer({"backlash@x"}, Answer("model_does_not_fit", ("backlash@x",)), "cart-pole").word
    'flagged'
    """
    answer = answer.without(named(structure, plant))
    answer = answer.by_plain_law() if engine == "hardware" else answer
    wanted, accepted = frozenset(truth), frozenset(answer.accepted)
    if not accepted or answer.verdict == "model_does_not_fit":
        return _nothing_accepted(wanted, answer)
    if accepted == wanted:
        return Outcome("right", STAND_IN if answer.stand_in else "")
    if wanted:
        plain = [[frozenset({name}), *tie] for name, tie in zip(answer.accepted, _padded(answer), strict=True)]
        if _reaches(wanted, plain, ()):
            return Outcome("tied", "tie set")
        dahl = [family for family in _DAHL[plant] if engine == "hardware" and family[0] <= wanted]
        same = (*_SAME[plant], *dahl)
        if _reaches(wanted, plain, same):
            return Outcome("tied", "same family")
    covered = wanted & (accepted | {name for tie in answer.ties for group in tie for name in group})
    if answer.stand_in and (wanted or structure in UNNAMED):
        return Outcome("flagged", STAND_IN)
    if not wanted:
        return Outcome("wrong", "false alarm")
    if covered == wanted:
        return Outcome("wrong", "something else accepted beside the truth")
    return Outcome("wrong", "part of the truth" if covered else "another effect")


def _nothing_accepted(wanted: Group, answer: Answer) -> Outcome:
    """Return the outcome of an answer without effects."""
    if answer.verdict in ("unexplained", "model_does_not_fit"):
        return Outcome("flagged", answer.verdict.replace("_", " "))
    if not wanted:
        return Outcome("right")
    if wanted <= answer.unseen:
        return Outcome("tied", "said to be invisible")
    return Outcome("missed")


def _padded(answer: Answer) -> Sequence[tuple[Group, ...]]:
    """Return the tie sets, empty ones where none is told."""
    return [*answer.ties, *(() for _ in range(len(answer.accepted) - len(answer.ties)))]


def _reaches(wanted: Group, choices: Iterable[Sequence[Group]], same: Sequence[Sequence[Group]]) -> bool:
    """Return True if one choice for each accepted effect gives the truth, up to what is exactly the same."""
    for chosen in product(*choices):
        union: Group = frozenset().union(*chosen)
        if union == wanted or any(group == wanted for group in _equal(union, same)):
            return True
    return False


def _equal(names: Group, same: Sequence[Sequence[Group]]) -> Iterable[Group]:
    """Yield sets that are exactly the same as this one, one exchange in each family."""
    found = {names}
    for family in same:
        for group in tuple(found):
            found |= {(group - old) | new for old in family if old <= group for new in family}
    return found
