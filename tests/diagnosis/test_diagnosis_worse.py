"""An answer that runs further from the validation records than the model without it is taken back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from sysid_lab.plan import plan
from sysid_lab.records import make_records

from harness.diagnosis import diagnose
from harness.diagnosis.policy import POLICY
from harness.diagnosis.runs.compare import FreeRuns
from harness.effects import builtin
from harness.physics import load_model


def shown(*validation: np.ndarray[Any, Any]) -> Any:
    return SimpleNamespace(finite=bool(all(np.isfinite(one).all() for one in validation)), validation=validation)


def runs(before: Any, after: Any) -> FreeRuns:
    return FreeRuns(cast(Any, None), cast(Any, None), before, after, 0.0, 0.0, np.ones(1), np.zeros(1), 0)


@pytest.mark.parametrize("seed", range(5))
def test_worse_is_more_than_chance_over_the_records(seed: int) -> None:
    rng = np.random.default_rng(seed)
    old = [rng.normal(size=(1000, 2)) for _ in range(2)]
    other = [rng.normal(size=(1000, 2)) for _ in range(2)]
    burst = [old[0].copy(), old[1]]
    burst[0][500:550] *= 8.0  # one block of forty
    assert runs(shown(*old), shown(*(1.3 * one for one in old))).worse(POLICY)
    assert runs(shown(*old), shown(*(np.nan * one for one in old))).worse(POLICY)
    assert runs(shown(*old), None).worse(POLICY)
    for after in (shown(*old), shown(*(0.5 * one for one in old)), shown(*burst)):
        assert not runs(shown(*old), after).worse(POLICY)
    assert not runs(shown(*old), shown(*(0.97 * one for one in other))).worse(POLICY)
    assert not runs(None, shown(*old)).worse(POLICY)


@pytest.mark.parametrize("seed", range(5))
def test_nearer_is_more_than_chance_and_worth_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    old = [rng.normal(size=(1000, 2)) for _ in range(2)]
    burst = [old[0].copy(), old[1]]
    burst[0][500:550] *= 8.0  # one block of forty
    still = shown(*old)
    assert runs(still, shown(*(0.9 * one for one in old))).nearer(POLICY), "19 % of the mean square"
    assert not runs(still, shown(*(0.99 * one for one in old))).nearer(POLICY), "surely nearer, by 2 % of it"
    assert not runs(shown(*burst), still).nearer(POLICY), "chance"
    assert not runs(still, shown(*(1.1 * one for one in old))).nearer(POLICY)
    assert not runs(still, None).nearer(POLICY)
    assert not runs(still, still).nearer(POLICY)
    assert runs(shown(*(np.nan * one for one in old)), still).nearer(POLICY), "it ran away before"


def test_idle_is_what_brings_no_free_run_nearer() -> None:
    old = [np.random.default_rng(1).normal(size=(1000, 2)) for _ in range(2)]
    assert runs(shown(*old), shown(old[0], 1.001 * old[1])).idle(POLICY)
    assert not runs(shown(*old), shown(old[0], 0.999 * old[1])).idle(POLICY)
    assert not runs(shown(*old), None).idle(POLICY), "what runs away is worse"
    assert not runs(None, shown(*old)).idle(POLICY)
    same = shown(*old)
    assert not runs(same, same).idle(POLICY), "nothing was added"


@pytest.mark.slow
def test_an_encoder_that_errs_is_given_no_friction() -> None:
    """Twice a turn by 2 mrad: the likelihood finds a force for it, with which the model runs further away."""
    tasks = plan("false-alarms", base=0, plants=("pendulum",), records=None, cells=4, alarms=400)
    task = next(one for one in tasks if one.key == "none|pendulum|bullet|none||drawn|0|8|0|eccentric-encoder")
    records = make_records(task)
    others = [one for name, one in builtin().items() if name != "sensor_cyclic_error"]
    found = diagnose(records.dataset, load_model("pendulum"), dictionary=others)
    assert not any("friction" in one.placed.effect.name for one in found.outcome.accepted)
    assert found.stand_in, "what free runs find in its place is said to stand in for it"
    assert found.grade == "proxy_or_incomplete"
    named = diagnose(records.dataset, load_model("pendulum"))
    assert [str(one.placed) for one in named.outcome.accepted] == ["sensor_cyclic_error@theta"]
    assert abs(named.final.values["sensor_cyclic_error@theta.A"]) == pytest.approx(0.002, rel=0.05)
    assert named.final.values["sensor_cyclic_error@theta.k"] == pytest.approx(2.0, rel=0.03)
    assert (named.verdict, named.grade) == ("effects_found", "explained")
