"""Dry friction whose level is another one on the day of the validation records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.runs.compare import seen_values
from harness.physics import load_model
from harness.signals import Dataset


@pytest.mark.parametrize(("seed", "level", "other"), [(3, 0.06, 0.036), (4, 0.05, 0.07)])
def test_friction_of_another_day_is_named_and_told_with_its_own_level(
    foreign_pendulum: Callable[..., Dataset], seed: int, level: float, other: float
) -> None:
    """It was tied with richer laws, its levels were no knowledge of the validation day, and free runs ran with them."""
    first, then = (
        foreign_pendulum(seed, lambda q, v, u, t, level=level: -level * float(np.tanh(v / 0.005)))
        for level in (level, other)
    )
    found = diagnose(Dataset("two days", (first.runs[0], then.runs[1])), load_model("pendulum"))
    accepted = [one.placed.effect.name for one in found.outcome.accepted]
    assert accepted == ["coulomb_friction"]
    assert found.final.values["coulomb_friction@theta.Fc"] == pytest.approx(level, rel=0.05)
    assert found.final.day["coulomb_friction@theta.Fc"] == pytest.approx(other, rel=0.1)
    assert any("coulomb_friction@theta.Fc differs between the records" in words for words in found.warnings)
    assert not found.disagree  # the records want no other machine
    held = seen_values(found.runs.output, found.final.effects, found.final.values)
    assert found.runs.after is not None
    assert held is not None
    errors = [np.mean(np.concatenate(list(one.validation)) ** 2) for one in (found.runs.after, held)]
    assert errors[0] < 0.1 * errors[1]


def test_a_zero_that_is_set_anew_each_day_is_named_with_both(foreign_pendulum: Callable[..., Dataset]) -> None:
    """Nothing was missing, "explained": the two days deny each other's zero."""
    data = foreign_pendulum(11)
    runs = (
        replace(run, trajectory=replace(run.trajectory, y=run.trajectory.y + zero))
        for run, zero in zip(data.runs, (0.03, -0.02), strict=True)
    )
    found = diagnose(replace(data, runs=tuple(runs)), load_model("pendulum"))
    assert [one.placed.effect.name for one in found.outcome.accepted] == ["sensor_offset"]
    assert found.final.values["sensor_offset@theta.offset"] == pytest.approx(0.03, abs=1e-3)
    assert found.final.day["sensor_offset@theta.offset"] == pytest.approx(-0.02, abs=1e-3)


def test_a_law_that_only_one_day_has_is_no_nothing_missing(foreign_pendulum: Callable[..., Dataset]) -> None:
    first, then = (foreign_pendulum(21, lambda q, v, u, t, k=k: -k * q**3) for k in (0.15, -0.02))
    found = diagnose(Dataset("two days", (first.runs[0], then.runs[1])), load_model("pendulum"))
    assert found.verdict == "unexplained"


def test_estimation_records_of_machines_that_differ_are_not_explained(foreign_pendulum: Callable[..., Dataset]) -> None:
    """Their mean was told, and that nothing is missing: a damper that was changed between two of three records."""
    first, then, last = (
        foreign_pendulum(seed, lambda q, v, u, t, b=b: -b * v) for seed, b in ((1, 0), (2, 0.03), (3, 0))
    )
    data = Dataset("two dampers", (first.runs[0], then.runs[0], last.runs[1]))
    found = diagnose(data, load_model("pendulum"))
    assert found.grade == "proxy_or_incomplete"
    assert found.verdict == "unexplained"
    assert any(
        "estimation record 2 of 2 wants other parameters" in words and ", b " in words for words in found.warnings
    )
    alike = diagnose(Dataset("one damper", (first.runs[0], last.runs[0], last.runs[1])), load_model("pendulum"))
    assert alike.verdict == "nothing_missing"
    assert alike.grade == "explained"


def test_a_sign_that_turns_is_no_other_day(foreign_pendulum: Callable[..., Dataset]) -> None:
    """What brakes in one record and drives in the other is no friction: its level differs by more than days do."""
    first, then = (
        foreign_pendulum(5, lambda q, v, u, t, level=level: -level * float(np.tanh(v / 0.005)))
        for level in (0.05, -0.05)
    )
    found = diagnose(Dataset("two days", (first.runs[0], then.runs[1])), load_model("pendulum"))
    assert not found.outcome.accepted
    assert found.verdict != "nothing_missing"
