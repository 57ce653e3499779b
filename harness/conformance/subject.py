"""One identifier under check: the kinds of data that it accepts, and its fits, each made once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from harness.conformance.results import demand
from harness.conformance.running import fit, one_step
from harness.conformance.workloads import Workload, draw_workload, kinds_for
from harness.errors import HarnessError
from harness.signals import FloatArray, Trajectory

Factory = Callable[[], Any]
SLOW = 1.0  # Seconds for a fit to two records, beyond which an identifier is checked on two systems only.
SURVEY = 12
"""Systems in a survey: a share of them is told from none of them with room to spare, in a second for a quick fit."""


def shown(workload: Workload) -> list[Trajectory]:
    """Return the records that a fit sees."""
    return [workload.first.measured(), workload.second.measured()]


@dataclass(eq=False)
class Subject:
    """An identifier under check."""

    factory: Factory  # Returns a fresh identifier each time
    among: tuple[str, ...]  # Kinds of data to try
    examples: int  # Systems for each check
    kinds: tuple[str, ...] = ()
    models: dict[Workload, Any] = field(default_factory=dict)
    predictions: dict[Workload, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        started = time.perf_counter()
        self.kinds, refused = kinds_for(lambda w: fit(self.factory(), shown(w)), self.among)
        why = "; ".join(f"{kind}: {reason}" for kind, reason in refused.items())
        demand(self.kinds, f"it refuses every kind of data ({why})")
        self.slow = (time.perf_counter() - started) / len(self.kinds) > SLOW
        if self.slow:  # or did the first fit import much?
            started = time.perf_counter()
            kinds_for(lambda w: fit(self.factory(), shown(w)), self.kinds[:1])
            self.slow = time.perf_counter() - started > SLOW
        if self.slow:
            self.examples = min(self.examples, 2)

    def model(self, workload: Workload) -> Any:
        """Return the model of a workload's two records, fitted once."""
        if workload not in self.models:
            self.models[workload] = fit(self.factory(), shown(workload))
        return self.models[workload]

    def predicted(self, workload: Workload) -> FloatArray:
        """Return the one-step predictions (N, ny) of that model on the probe, as it made them first."""
        if workload not in self.predictions:
            self.predictions[workload] = one_step(self.model(workload), workload.probe)
        return self.predictions[workload]

    @property
    def each(self) -> int:
        """Systems of a kind in a survey."""
        return 1 if self.slow else max(2, SURVEY // len(self.kinds))

    def surveyed(self, noise: float = 0.0) -> list[Workload]:
        """Return the systems of a survey, ``each`` of every accepted kind; none is fitted yet."""
        return [draw_workload(kind, 100 + seed, noise=noise) for kind in self.kinds for seed in range(self.each)]

    def survey(self, noise: float = 0.0) -> Iterator[Workload]:
        """Return the systems of a survey, one after the other, those that are refused left out."""
        for workload in self.surveyed(noise):
            try:
                self.model(workload)
            except HarnessError:
                continue
            yield workload


class Subjects:
    """The identifiers that one list of checks has met."""

    def __init__(self, among: tuple[str, ...], examples: int) -> None:
        self.among, self.examples = among, examples
        self.met: dict[int, Subject] = {}

    def __call__(self, factory: Factory) -> Subject:
        """Return the subject of a factory (kept alive with it, so that its id stays its own)."""
        if id(factory) not in self.met:
            self.met[id(factory)] = Subject(factory, self.among, self.examples)
        return self.met[id(factory)]
