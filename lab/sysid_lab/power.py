"""How surely records of an experiment tell what is hidden in them from its nearest rival: the power of the decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from scipy.special import ndtr

from harness.diagnosis.policy import POLICY, Policy
from harness.diagnosis.search.compare import difference, expected_difference, judged
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.ties import may_tie, refines, total
from harness.diagnosis.search.warm import own_values
from harness.effects.effect import Placed

RIVALS = 3  # Rivals of the truth that are fitted beside it: cost.
_USES = ("estimation", "validation")


def power_of(truth: Fit, rival: Fit, least: float, policy: Policy = POLICY) -> float:
    """Return the probability with which records of this experiment decide for the truth, against one rival.

    Other noise would give another difference of the log-likelihoods; its mean is the divergence of the two models
    (:func:`harness.diagnosis.search.compare.expected_difference`) less what their parameters cost, and its standard
    error is that of this one. What these records happened to say is not in it.

    Parameters
    ----------
    truth, rival : Fit
        Of the same records.
    least : float
        Log-likelihood that is asked at least; two standard errors are asked as well, as of every decision.
    policy : Policy

    Returns
    -------
    float
        From 0 to 1.
    """
    _, error = difference(truth, rival, _USES, policy)
    price = (truth.penalised - truth.log_likelihood("estimation")) - (
        rival.penalised - rival.log_likelihood("estimation")
    )
    mean = expected_difference(truth, rival, _USES) + price
    return float(ndtr((mean - max(least, policy.tie_z * error)) / max(error, 1e-9)))


@dataclass(frozen=True)
class Power:
    """What records of an experiment can tell of what is hidden in them.

    Attributes
    ----------
    shown : float
        Probability with which they decide for the truth against the model without what is hidden.
    told : float
        The least probability with which they decide for it against a rival.
    nearest : str
        That rival.
    """

    shown: float
    told: float = 1.0
    nearest: str = ""


def power(
    found: Any, oracle: Fit, truth: Sequence[Placed], plain: Callable[[str], str], policy: Policy = POLICY
) -> Power:
    """Return what an experiment can tell of the truth.

    The rivals are the likeliest candidates of the search, each fitted from where it ended beside all that the truth has
    besides.

    Parameters
    ----------
    found : Diagnosis
    oracle : Fit
        The fit with all that is there.
    truth : sequence of Placed
        What is hidden, of the effects of the oracle.
    plain : callable
        The name by which an effect counts, see :func:`sysid_lab.outcome.judge_answer`.
    policy : Policy
    """
    form, laws, hidden = found.form, found.form.laws, {str(placed) for placed in truth}
    others = [placed for placed in oracle.effects if str(placed) not in hidden]
    without = (form.fit(others, [oracle.values], found.nominal) if others else None) or found.nominal
    least = Power(power_of(oracle, without, 2 * policy.evidence, policy))
    for row in _rivals(found, {plain(name) for name in hidden}, {str(placed) for placed in others}, plain):
        starts = [{**oracle.values, **own_values(placed, row.fit)} for placed in row.added]
        fit = form.fit([*others, *row.added], [*starts, {**oracle.values, **row.fit.values}], without)
        if fit is None or not may_tie(
            judged(form, row.added, fit, found.nominal, found.nominal, policy), truth[-1], laws
        ):
            continue
        if any(refines(row.added, law, laws) for law in truth) and form.distance(fit, oracle) < policy.least:
            continue  # it is the truth, with a parameter that does nothing
        told = power_of(oracle, fit, policy.tie, policy)
        if told < least.told:
            least = replace(least, told=told, nearest=row.name)
    return least


def _rivals(found: Any, same: set[str], beside: set[str], plain: Callable[[str], str]) -> list[Any]:
    """Return the likeliest candidates of all rounds that are not the truth by another name, each once."""
    best: dict[str, Any] = {}
    for row in (row for past in found.outcome.rounds for row in past.candidates):
        names = {str(placed) for placed in row.added}
        if row.fit is None or row.comparison is None or names & beside or {plain(name) for name in names} & same:
            continue
        if row.name not in best or total(row) > total(best[row.name]):
            best[row.name] = row
    return sorted(best.values(), key=total, reverse=True)[:RIVALS]
