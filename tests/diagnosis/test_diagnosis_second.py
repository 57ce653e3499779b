"""When a diagnosis is made again by free runs, and when the second one stands."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from harness.diagnosis.contested import explains_nothing
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.policy import POLICY
from harness.diagnosis.second import halved, searched_unless_carried, second_opinion
from harness.diagnosis.steps import untold
from harness.effects import builtin
from harness.effects.effect import Placed
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory

SPEC = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
RECORD = Trajectory(np.arange(8) * 0.5, np.zeros((8, 1)), np.arange(8.0)[:, None], SPEC)
DATA = Dataset("x", (Run(RECORD), Run(RECORD, "validation"), Run(RECORD, "test")))


@dataclass(frozen=True)
class Answer:
    """What of a diagnosis a second opinion looks at."""

    verdict: str = "unexplained"
    rival: str = ""
    astray: bool = False
    further: float = 7.0
    force: float = 0.1
    misfit: tuple[str, ...] = ()
    latent: bool = True
    error: float = 1.0
    withdrawn: tuple[str, ...] = ()
    warnings: list[str] = field(default_factory=list)
    alarms: tuple[str, ...] = ()
    dataset: Dataset = DATA
    policy: Any = POLICY

    @property
    def form(self) -> Any:
        return SimpleNamespace(latent=self.latent, noise_model=SimpleNamespace(force_scale=np.ones(1)))

    @property
    def final(self) -> Any:
        noise = SimpleNamespace(s=np.array([self.force]), w=np.zeros(1))
        passes = SimpleNamespace(forces=(SimpleNamespace(port="q"),))
        points = {"estimation": SimpleNamespace(noise=noise)}
        return SimpleNamespace(detail=SimpleNamespace(points=points, passes=passes), error=self.error)

    @property
    def outcome(self) -> Any:
        return SimpleNamespace(withdrawn=tuple(SimpleNamespace(placed=name) for name in self.withdrawn))

    @property
    def runs(self) -> Any:
        """The others leave 1, the validation records ``further``, and of that a fit the share that its error says."""

        def cured_by(fit: Any, policy: Any) -> bool:
            return bool(fit.error * self.further <= policy.further)

        return SimpleNamespace(further=self.further, cured_by=cured_by)


class Runs:
    """Compares free runs as the fits say; the nominal model leaves 1."""

    def seen(self, fit: Any) -> float:
        return float(fit.error)

    def further(self, mine: float, other: float, policy: Any, share: float) -> bool:
        return mine - other > share


@pytest.fixture(autouse=True)
def plain_details(monkeypatch: pytest.MonkeyPatch) -> None:
    for room in ("misfit", "forms.fit_records"):
        monkeypatch.setattr(f"harness.diagnosis.{room}.likelihood_detail", lambda fit: fit.detail)


def opinion(first: Answer, again: Answer) -> tuple[Any, list[str]]:
    """Return what stands in the place of a first diagnosis, and of what another was asked."""
    asked: list[str] = []

    def ask(*, halves: bool = False, hope: Any = None) -> Diagnosis | None:
        asked.append("halves" if halves else "whole")
        found = SimpleNamespace(model=again.final, nominal=Answer(error=first.error).final)
        return None if hope is not None and not hope(found) else cast(Diagnosis, again)

    return second_opinion(cast(Diagnosis, first), cast(Any, Runs()), ask), sorted(set(asked))


def test_nothing_is_asked_again_without_a_reason() -> None:
    assert opinion(Answer(), Answer()) == (None, [])


@pytest.mark.parametrize(
    ("nominal", "first", "again", "calls", "instead"),
    [
        (0.1, 2.0, Answer(), ["whole search"], False),  # no force carries the nominal model
        (2.0, 0.1, Answer(), ["until lost"], False),  # its first effect takes the force away
        (2.0, 2.0, Answer(), ["until lost", "free runs"], True),
        (2.0, 2.0, Answer(misfit=("leaves 90 %",)), ["until lost", "free runs", "goes on"], False),
    ],
)
def test_nothing_is_built_on_a_model_that_a_force_carries_before_free_runs_were_asked(
    nominal: float, first: float, again: Answer, calls: list[str], instead: bool
) -> None:
    done: list[str] = []

    def searched(lost: Any = None, begun: Any = None) -> Any:
        done.append("goes on" if begun else "until lost" if lost else "whole search")
        assert lost is None or lost(Answer(force=2.0).final)
        return SimpleNamespace(model=Answer(force=first).final)

    def asked() -> Any:
        done.append("free runs")
        return again

    form = Answer().form
    outcome, other = searched_unless_carried(
        form, Answer(force=nominal).final, POLICY, searched, cast(Any, cache(asked))
    )
    assert done == calls
    assert outcome is not None
    assert (other is not None) == instead
    assert not instead or "200 % of what moves q" in other.warnings[0]


def test_a_force_that_explains_everything_gives_way_to_free_runs_that_follow() -> None:
    found, asked = opinion(Answer(force=2.0, misfit=("too much",)), Answer(verdict="nothing_missing"))
    assert found.verdict == "nothing_missing"
    assert "200 % of what moves q" in found.warnings[0]
    assert found.alarms[0] == found.warnings[0], "the page says so first"
    assert asked == ["whole"]
    assert opinion(Answer(force=2.0), Answer(misfit=("leaves 90 %",)))[0] is None


def test_a_rival_asks_again_and_what_comes_clearly_nearer_stands() -> None:
    found, _ = opinion(Answer(rival="coulomb_friction@q"), Answer(verdict="effects_found", error=0.2))
    assert found.verdict == "effects_found"
    assert "coulomb_friction@q alone" in found.warnings[0]
    assert opinion(Answer(rival="coulomb_friction@q"), Answer(error=0.8))[0] is None


def test_what_free_runs_take_back_is_looked_for_by_free_runs() -> None:
    first = Answer(withdrawn=("elasticity@q", "sensor_cyclic_error@q"))
    found, asked = opinion(first, Answer(verdict="effects_found", error=0.2))
    assert "elasticity@q and sensor_cyclic_error@q, runs no nearer" in found.warnings[0]
    assert asked == ["whole"]
    assert opinion(first, Answer(verdict="effects_found", error=0.8))[0] is None, "it comes no nearer"
    assert opinion(first, Answer(verdict="nothing_missing", error=0.2))[0] is None, "something is missing"
    astray = Answer(withdrawn=first.withdrawn, misfit=("leaves 80 %",))
    assert opinion(astray, Answer(verdict="nothing_missing", error=0.2))[0] is not None, "free runs follow"
    assert opinion(astray, Answer(misfit=("leaves 70 %",), error=0.2))[0] is None


@pytest.mark.parametrize(
    "reason", [{"rival": "coulomb_friction@q"}, {"withdrawn": ("elasticity@q",)}, {"astray": True}]
)
def test_a_search_that_leads_no_nearer_is_not_graded(reason: dict[str, Any]) -> None:
    """What is made of its answer, and what may be wrong with columns, was a third of the work and thrown away."""
    hopes: list[bool] = []

    def ask(*, halves: bool = False, hope: Any = None) -> Diagnosis | None:
        assert halves is bool(reason.get("astray"))
        for model, nominal in ((0.8, 1.0), (0.2, 1.0), (1.0, 0.2)):
            hopes.append(hope(SimpleNamespace(model=Answer(error=model).final, nominal=Answer(error=nominal).final)))
        return None

    assert second_opinion(cast(Diagnosis, Answer(**reason)), cast(Any, Runs()), ask) is None
    assert hopes == [False, True, True], "the answer may become the nominal model, when it is held against free runs"


def test_where_the_validation_records_go_further_each_record_is_halved() -> None:
    found, asked = opinion(Answer(astray=True), Answer(verdict="effects_found", error=0.2))
    assert "7 times as large" in found.warnings[0]
    assert asked == ["halves"]
    assert opinion(Answer(astray=True), Answer(error=0.2))[0] is None  # it explains nothing either
    two_machines = Answer(astray=True, further=30.0)
    assert opinion(two_machines, Answer(verdict="effects_found", error=0.2))[0] is None, (
        "as far as six times the others"
    )


def test_halves_hold_every_sample_once() -> None:
    parts = halved(DATA).runs
    assert [run.use for run in parts] == ["estimation", "estimation", "validation", "validation", "test"]
    np.testing.assert_array_equal(parts[0].trajectory.y[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(parts[3].trajectory.y[:, 0], [4, 5, 6, 7])
    kept = np.concatenate([parts[0].trajectory.y, parts[2].trajectory.y])
    np.testing.assert_array_equal(kept, RECORD.y)
    assert parts[-1].trajectory is RECORD


@pytest.mark.parametrize(
    ("nearer", "quieter", "kinds", "nothing"),
    [(False, False, {"force"}, True), (True, False, {"force"}, False), (False, True, {"force"}, False),
     (False, False, {"output"}, False), (False, False, {"force", "output"}, True)],
)  # fmt: skip
def test_what_helps_neither_free_runs_nor_the_unmeasured_force_explains_nothing(
    monkeypatch: pytest.MonkeyPatch, nearer: bool, quieter: bool, kinds: set[str], nothing: bool
) -> None:
    """An elastic joint that only whitened a drifting sine was named, as a stand-in."""
    effect = SimpleNamespace(placed=SimpleNamespace(effect=SimpleNamespace(kinds=kinds)))
    model = np.array([0.2 if quieter else 0.3])
    outcome: Any = SimpleNamespace(nominal=np.array([0.3]), model=model, accepted=[effect])
    form: Any = SimpleNamespace(noise_model=SimpleNamespace(force_scale=np.ones(1)))
    monkeypatch.setattr("harness.diagnosis.contested.latent_shares", lambda fit, scale: fit / scale)
    seen: Any = SimpleNamespace(nearer=lambda policy: nearer)
    assert explains_nothing(form, outcome, seen, POLICY) is nothing


@pytest.mark.parametrize(("deviation", "nothing"), [(0.02, False), (0.3, True)])
def test_what_coloured_errors_do_not_tell_from_none_is_no_name(deviation: float, nothing: bool) -> None:
    """A supply sag around an FMU was named, of which nothing was known once the error's colour counted."""
    drag = Placed(builtin()["quadratic_drag"], "q")
    name = drag.name("c")
    fit = SimpleNamespace(values={name: 0.2}, free=(name,), on_bound=(), beside={}, logarithmic=frozenset(),
                          deviations={name: 0.01})  # fmt: skip
    wide = SimpleNamespace(**{**vars(fit), "deviations": {name: deviation}})
    form: Any = SimpleNamespace(with_deviations=lambda model: wide, damping=lambda model, at: None)
    outcome: Any = SimpleNamespace(model=fit, accepted=[SimpleNamespace(placed=drag)])
    assert untold(form, outcome) is nothing
