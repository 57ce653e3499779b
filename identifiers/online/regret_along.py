"""Regret of an online identifier on records: against the batch minimiser, with the rate that theory gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from harness.errors import InputError
from harness.models.analysis import Findings, Takes
from harness.protocols import OnlineIdentifier
from harness.scoring.regret import Regret, regret
from harness.signals import Dataset
from identifiers.common.named import named

LAWS = {"log": "ln n", "root": "the root of n", "linear": "n", "bounded": "a constant"}


@dataclass(frozen=True)
class RegretAlong:
    """Regret of an online identifier along records, against the batch minimiser, beside the rate of theory.

    The estimation records are the stream. At lengths n the loss of the predictions so far is held against that of the
    best fixed model of these n samples. Theory says of some identifiers how fast that grows: the rise of the curve over
    that of theory is 1 where the theorem's conditions hold (white errors, no drift).

    Parameters
    ----------
    identifier : str
        Id of an online identifier.
    options : mapping
        Of it.
    points : int
        Lengths, evenly spaced in ln n; each costs a batch fit.
    """

    takes: ClassVar[Takes] = "data"

    identifier: str = "rls"
    options: Mapping[str, Any] = field(default_factory=dict)
    points: int = 24

    def of(self, subject: Dataset, *, rng: np.random.Generator) -> Findings:
        """Return the curve, theory's, and what they say."""
        online: Any = named("identifiers", self.identifier, self.options)
        if not isinstance(online, OnlineIdentifier):
            raise InputError(
                "identifier of a regret",
                expected="one that learns online",
                got=f"{self.identifier}, which is fitted to whole records",
                remedy="-O identifier=follow-the-leader -O 'options={identifier=...}' turns it into one",
            )
        found = regret(online, [record.measured() for record in subject.estimation], rng=rng, points=self.points)
        theory = found.theory
        rows = [
            {"samples": int(n), "regret": float(r), "theory": None if np.isnan(said) else float(said)}
            for n, r, said in zip(found.steps, found.curve, theory, strict=True)
        ]
        details = {"steps": found.steps, "curve": found.curve, "theory": theory, "over theory": found.over_theory}
        title = f"regret of {self.identifier} on {subject.name}"
        return Findings(title, rows, _words(found), details, lambda: _drawn(found, title))


def _words(found: Regret) -> list[str]:
    """Return in sentences what a regret says."""
    best = "the best fixed model" if found.exact else "the best fixed model that was found"
    words = [
        f"regret {found.total:.3g} over {found.losses.size} samples against {best}, {found.average:.3g} a sample "
        "(losses in variances of the outputs)"
    ]
    if found.growth is None:
        return [*words, "no theorem says how it grows"]
    source, law = found.growth.source, LAWS[found.growth.law]
    if found.over_theory is not None:
        return [*words, f"it rises {found.over_theory:.2f} times as fast as theory says, as {law}: {source}"]
    return [*words, f"theory lets it grow as {law} and gives no factor: {source}"]


def _drawn(found: Regret, title: str) -> Any:
    """Return a figure of the curve and of theory's."""
    from harness.plots import sheet

    figure = sheet(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(found.steps, found.curve, "o-", ms=3, label="against the best fixed model of so many samples")
    if np.isfinite(found.theory).any() and found.growth is not None:
        shape = "" if found.growth.factor is not None else ", its shape"
        axis.plot(found.steps, found.theory, "--", label=f"theory: {LAWS[found.growth.law]}{shape}")
    axis.set(xscale="log", xlabel="samples seen", ylabel="cumulative regret", title=title)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure
