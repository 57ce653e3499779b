"""Small faults of units, fleets, convergence and scores that no other test would notice."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np
import pytest

from harness.cosim.convergence import halved
from harness.errors import InputError
from harness.fleet.changes import changes
from harness.fleet.row import FleetRow, FoundEffect
from harness.fleet.trends import new_effects
from harness.scoring.prediction import _score
from harness.scoring.regret import _scale
from harness.signals import Channel, PlantSpec, Trajectory
from harness.units import base_units, convert


@pytest.mark.parametrize(
    ("unit", "target", "factor"),
    [
        ("inlb", "N m", 0.1129848290),
        ("ftlb", "N m", 1.3558179483),
        ("rps", "rad/s", 2 * np.pi),
        ("dps", "rad/s", np.pi / 180),
        ("r/min", "rad/s", np.pi / 30),
        ("Ncm", "N m", 0.01),
    ],
)
def test_what_engineers_write_has_this_factor(unit: str, target: str, factor: float) -> None:
    assert convert(np.ones(1), unit, target)[0] == pytest.approx(factor, rel=1e-9)


def test_radians_keep_their_power() -> None:
    assert base_units("N m/rad")[0] == {"kg": 1, "m": 2, "s": -2, "rad": -1}
    assert base_units("rad^2")[0] == {"rad": 2}


@pytest.mark.parametrize("unit", ["Hz", "cps", "1/min"])
def test_cycles_are_no_rate_of_an_angle_by_themselves(unit: str) -> None:
    with pytest.raises(InputError, match="two readings"):
        convert(np.ones(1), unit, "rad/s")


def row(day: int, size: float | None, machine: str = "A") -> FleetRow:
    """Return a record with a friction of this size, or without."""
    effects = ()
    if size is not None:
        each = ((size,), (size - 0.02,), (size + 0.02,))
        effects = (
            FoundEffect("coulomb@q", "q", "Fc", size, size - 0.02, size + 0.02, "N m", (), ("Fc",), *each, ("N m",)),
        )
    when = (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    return FleetRow(job=f"{machine}{day}", record=f"{machine}-{day}", file="", machine=machine, date=when, status="ok",
               effects=effects)  # fmt: skip


def test_an_effect_that_was_away_is_not_new_when_it_is_back() -> None:
    assert new_effects([row(0, 0.1), row(1, None), row(2, 0.1)]) == []


def test_whoever_looks_at_more_machines_asks_for_more() -> None:
    sizes = [0.1, 0.101, 0.099, 0.1, 0.18, 0.181, 0.179, 0.18]
    one = [row(day, size) for day, size in enumerate(sizes)]
    still = [row(day, 0.1 + 0.001 * (-1) ** day, "B") for day in range(8)]
    alone, beside = changes(one), changes([*one, *still])
    assert [(found.machine, found.shape, found.row.record) for found in beside] == [("A", "step", "A-4")]
    assert beside[0].p / alone[0].p == pytest.approx(2.0)


def test_the_range_of_a_convergence_is_that_of_the_finest_run() -> None:
    def run(step: float | None) -> Trajectory:
        h = step or 0.5
        t = h * np.arange(round(1 / h) + 1)
        return Trajectory(t, np.zeros((len(t), 0)), (3.0 * t + h)[:, None], PlantSpec((), (Channel("x"),), h))

    found = halved(run, 2)
    assert found.ranges == pytest.approx([3.0])
    assert found.shares[:, 0] == pytest.approx([0.25 / 3, 0.125 / 3])


def test_always_the_most_frequent_category_scores_one() -> None:
    spec = PlantSpec((), (Channel("s", "1", 0.0, 1.0, kind="category"),), 1.0)
    y = np.array([[0.0], [0.0], [0.0], [0.0], [1.0]])
    score = _score(Trajectory(np.arange(5.0), np.zeros((5, 0)), y, spec), y, 0, None, "")
    assert score.nrmse == pytest.approx([1.0])


def test_an_angle_that_turns_over_has_the_scale_of_its_motion() -> None:
    spec = PlantSpec((), (Channel("theta", "rad", period=2 * np.pi),), 1.0)
    motion = np.pi + 0.1 * np.sin(np.arange(200.0))
    wrapped = (motion + np.pi) % (2 * np.pi) - np.pi
    record = Trajectory(np.arange(200.0), np.zeros((200, 0)), wrapped[:, None], spec)
    assert _scale([record]) == pytest.approx([np.std(motion)])
