"""First steps of a fit by likelihood: from many starts, which of them go on, and how far each may still come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.named import per_record
from harness.diagnosis.policy import POLICY
from harness.errors import FitError
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import LikelihoodFit, Point


def looked(
    likelihood: Likelihood,
    points: Sequence[Point],
    *,
    spare: bool = True,
    free: Sequence[str] | None = None,
    hope: float = -np.inf,
) -> list[LikelihoodFit]:
    """Return where first steps lead from some points, likeliest first; those that fall behind take fewer.

    Everything stands on the nominal model: no step is spared there. What lies below the hope and gains so much
    with a step that it may come to it goes on.
    """
    halved = spare and (len(points) > 1 or hope > -np.inf)
    tried = stepped(likelihood, points, EFFORT.looks if halved else EFFORT.first_steps, free)
    near = in_sight(tried) if halved else []
    if any(may_reach(fit, hope) for fit in near):
        more = stepped(likelihood, near, EFFORT.first_steps - EFFORT.looks, free)
        tried = sorted([*more, *tried[len(near) :]], key=lambda fit: fit.nll)
    for _ in range(EFFORT.onward):  # from afar the first steps do not get there
        first = tried[0] if tried else None
        if first is None or -first.nll >= hope or not may_reach(first, hope):
            break
        more = stepped(likelihood, [first], EFFORT.first_steps, free)
        tried = sorted([*more, *tried[1:]], key=lambda fit: fit.nll)
    return tried


def from_instants(
    likelihood: Likelihood, fit: LikelihoodFit, *, free: Sequence[str] | None = None, reach: float = np.inf
) -> LikelihoodFit:
    """Return a fit that goes on from a likelier instant of what happens once in a record, if there is one.

    Along an instant the likelihood is a staircase, whose treads are where nothing moves: steps stop on any of them.
    """
    if fit.beyond:
        return fit
    longest = max(len(record) for record in likelihood.records) * likelihood.filter.dt
    for name in set(per_record(likelihood.system.effects, "instant")).intersection(fit.names):
        k = likelihood.system.parameter_names.index(name)

        def at(instant: float, k: int = k, near: Point = fit.point) -> Point:
            p = near.p.copy()
            p[k] = instant
            return replace(near, p=p)

        span = longest / EFFORT.instants
        best = min((span * (number + 0.5) for number in range(EFFORT.instants)), key=lambda t: likelihood.nll(at(t)))
        while span > likelihood.filter.dt and likelihood.nll(at(best)) < fit.nll - POLICY.tie:
            span /= EFFORT.closer
            steps = span * np.arange(1 - EFFORT.closer, EFFORT.closer)
            best = min(best + steps, key=lambda t: likelihood.nll(at(t)))
        if likelihood.nll(at(best)) < fit.nll - POLICY.tie:
            moved = likelihood.maximise(at(best), free=free, reach=reach, exact=False)
            fit = moved if moved.nll < fit.nll else fit
    return fit


def stepped(
    likelihood: Likelihood, points: Sequence[Point | LikelihoodFit], most: int, free: Sequence[str] | None = None
) -> list[LikelihoodFit]:
    """Return where a few steps lead from each point, likeliest first; without those that cannot be simulated."""
    fits: list[LikelihoodFit] = []
    for point in points:
        try:
            fits.append(likelihood.maximise(point, most=most, free=free, exact=False))
        except (FitError, ArithmeticError, np.linalg.LinAlgError):
            continue
    return sorted(fits, key=lambda fit: fit.nll)


def settled(likelihood: Likelihood, points: Sequence[Point]) -> list[Point]:
    """Return points with initial states and noise that suit their parameters, which stay where they are.

    Values that were fitted to other readings lie near a maximum, first guesses of states and noise do not: from these,
    steps of all at once lead the values away to where a force does what an effect did.
    """
    free = [name for name in likelihood.names if name not in likelihood.system.parameter_names]
    return [fit.point for fit in stepped(likelihood, points, EFFORT.first_steps, free)] or list(points)


def hopeful(fit: LikelihoodFit, least: float) -> LikelihoodFit:
    """Return a fit, left on its way where its maximum is known and lies below a log-likelihood."""
    return replace(fit, converged=False, beyond=True) if fit.converged and -fit.nll < least else fit


def in_sight(tried: Sequence[LikelihoodFit]) -> list[LikelihoodFit]:
    """Return which fits, likeliest first, are near the first one or may come to where it is."""
    return [fit for fit in tried if fit.nll < tried[0].nll + EFFORT.close or may_reach(fit, -tried[0].nll)]


def may_reach(fit: LikelihoodFit, hope: float) -> bool:
    """Return whether as many steps again, each as good as the last one, would come to a log-likelihood."""
    return not fit.converged and -fit.nll + EFFORT.first_steps * fit.pace >= hope
