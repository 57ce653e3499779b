"""Do all records agree on the parameters? If not, one model cannot be that of all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.diagnosis.forms.fit_records import likelihood_detail
from harness.diagnosis.forms.predictive import predicted
from harness.diagnosis.policy import Policy
from harness.diagnosis.search.fit import Fit
from harness.effects.effect import Placed
from harness.errors import FitError
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import LikelihoodFit, Point
from harness.signals import FloatArray, Trajectory


@dataclass(frozen=True, eq=False)
class Apart:
    """Records with parameters of their own, against those that the estimation records leave them."""

    gain: float  # Log-likelihood that they gain
    terms: Sequence[FloatArray] = field(repr=False)  # sequence of array (K,): The same by record and sample
    name: str  # The parameter that moves farthest, in standard deviations; empty if none does
    value: float  # What these records want it to be
    alone: str = ""  # Which of the estimation records this is; empty for the validation records

    def matters(self, policy: Policy) -> bool:
        """Return True if the records disagree by evidence, and not in a few places only.

        Examples
        --------
        >>> from harness.diagnosis.policy import POLICY
        >>> even = np.full(2000, 0.1)
        >>> Apart(200.0, [even], "J", 0.05).matters(POLICY), Apart(2.0, [even / 100], "J", 0.05).matters(POLICY)
        (True, False)
        """
        sums = np.concatenate(
            [np.add.reduceat(terms, np.linspace(0, len(terms), policy.blocks, endpoint=False).astype(int))
             for terms in self.terms]
        )  # fmt: skip
        error = float(np.sqrt(len(sums)) * sums.std(ddof=1))
        return self.gain > max(policy.misfit_gain, policy.tie_z * error)

    def words(self, values: Mapping[str, float]) -> str:
        """Return what to tell a user; ``values`` are those of the estimation records."""
        moved = f", {self.name} {values[self.name]:.4g} -> {self.value:.4g}" if self.name else ""
        return (
            f"{self.which} (log-likelihood {self.gain:.0f} higher{moved}): another machine, another load, or something "
            "that changes between records"
        )

    @property
    def which(self) -> str:
        """Who wants other parameters than whom."""
        if self.alone:
            return f"{self.alone} wants other parameters than all of them together"
        return "the validation records want other parameters than the estimation records"


def apart(likelihood: Likelihood, fit: Fit, point: Point, alone: str = "") -> Apart | None:
    """Return how much likelier records are with parameters of their own; None if that diverges.

    Noise, initial states and phases are their own in either case, and at their maximum, and shared parameters are as
    uncertain as the estimation records leave them: a noise that fits better is no other machine.

    - ``likelihood``: of these records
    - ``point``: where they are likeliest with the parameters of the fit
    - ``alone``: which estimation record this is
    """
    own = [name for name in likelihood.names if name not in fit.free or name in fit.own]
    try:
        before = likelihood.maximise(point, free=own, exact=False)
        after = likelihood.past_forces(likelihood.maximise(before, exact=False))
        shared = min(
            before.terms,
            _within_spread(likelihood, fit, after, fit.effects if alone or fit.day else ()),
            key=lambda terms: sum(float(part.sum()) for part in terms),
        )
    except (FitError, ArithmeticError, np.linalg.LinAlgError):
        return None
    gains = [mine - free for mine, free in zip(shared, after.terms, strict=True)]
    moved = _moved(fit, after)
    farthest = max(moved, key=lambda name: moved[name], default="")
    return Apart(
        float(sum(gain.sum() for gain in gains)), gains, farthest, after.parameters.get(farthest, np.nan), alone
    )


def most_apart(
    likelihood: Callable[[str, Sequence[Trajectory]], Likelihood], fit: Fit, records: Mapping[str, Sequence[Trajectory]]
) -> Apart | None:
    """Return :func:`apart` of the validation records or of one of several estimation records, whichever gains most.

    - ``likelihood``: of records of a use
    - ``records``: by use
    """
    points, runs = likelihood_detail(fit).points, records["estimation"]
    found = [apart(likelihood("validation", records["validation"]), fit, points["validation"])]
    for k, run in enumerate(runs if len(runs) > 1 else ()):
        point = replace(points["estimation"], x0=[points["estimation"].x0[k]])
        found.append(apart(likelihood("estimation", [run]), fit, point, f"estimation record {k + 1} of {len(runs)}"))
    return max((one for one in found if one is not None), key=lambda one: one.gain, default=None)


def _within_spread(likelihood: Likelihood, fit: Fit, after: LikelihoodFit, days: Sequence[Placed]) -> list[FloatArray]:
    """Return minus the log-density of every sample beside the noise that other parameters want.

    Parameters are where they are likeliest within what the estimation records leave open; how far that is costs, spread
    evenly. Noise has several maxima: what it is beside other parameters it may be beside these. Of these effects
    (``days``) friction and zeros may be those of another day.
    """
    start = likelihood_detail(fit).best.point.p.copy()
    for name in fit.own:
        k = likelihood.system.parameter_names.index(name)
        start[k] = after.point.p[k]
    best = likelihood_detail(fit).best
    expected = predicted(likelihood, replace(after.point, p=start), best, fit.free, list(fit.own), days)
    paths = likelihood.filtered(expected.point)
    if paths is None:
        raise FitError("validation", expected="a finite state", got="divergence", remedy="refit the model")
    price = 0.5 * float(expected.moved @ expected.moved) / sum(len(passed.terms) for passed in paths)
    return [passed.terms + price for passed in paths]


def _moved(fit: Fit, after: LikelihoodFit) -> dict[str, float]:
    """Return how far the parameters moved, in standard deviations of both."""
    moved = {}
    for name in set(fit.free).difference(fit.own):
        spread = float(np.hypot(fit.deviations[name], after.deviation(name) if name in after.names else 0.0))
        change = after.parameters[name] - fit.values[name]
        if name in fit.logarithmic:
            change = float(np.log(max(after.parameters[name], 1e-300) / max(fit.values[name], 1e-300)))
        if 0 < spread < np.inf:
            moved[name] = abs(change) / spread
    return moved
