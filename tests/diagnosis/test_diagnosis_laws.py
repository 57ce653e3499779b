"""Laws that are taken for one another by their names: each is found in records of other people's engines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.diagnosis import diagnose
from harness.diagnosis.search.leftover import Axis, Leftover
from harness.physics import load_model
from harness.study.plan import Task
from harness.study.records import make_records

TASK = Task("confusion", "pendulum", "bullet", (), "nominal", "high", 0.0, 0, 0)


@pytest.mark.parametrize(
    ("effect", "held", "within"),
    [
        ("maxwell_element@theta", ("k", "tau"), 0.15),
        ("position_dependent_damping@theta", ("c2",), 0.15),
        ("input_compression@u", ("c",), 0.15),
        ("sensor_nonlinearity@theta", ("b",), 0.15),
    ],
)
def test_what_imitates_other_effects_gets_its_own_name(effect: str, held: tuple[str, ...], within: float) -> None:
    """Hidden behind Bullet's pendulum, found by the whole dictionary, with its size."""
    records = make_records(replace(TASK, effects=(effect,)))
    found = diagnose(records.dataset, load_model("pendulum"))
    assert [str(one.placed) for one in found.outcome.accepted] == [effect]
    assert (found.verdict, found.grade) == ("effects_found", "explained")
    for name in held:
        assert found.final.values[f"{effect}.{name}"] == pytest.approx(records.hidden[0].named[name], rel=within)


def test_a_force_over_speed_and_command_together_is_seen() -> None:
    """A drive that tires at speed: no axis alone shows it, and no effect has its law."""
    task = Task("outside", "pendulum", "laws", ("tiring_drive@theta",), "nominal", "high", 0.0, 1, 0)
    found = diagnose(make_records(task).dataset, load_model("pendulum"))
    assert found.verdict == "unexplained"
    assert found.leftover.best is not None
    assert found.leftover.best.name == "theta over theta_rate and u"


def test_a_damper_that_warms_up_is_seen_and_not_named() -> None:
    """Its mean is in the nominal damping; what is left follows the speed, and changes sign within every record."""
    task = Task("outside", "pendulum", "laws", ("warming_damper@theta",), "nominal", "high", 0.0, 2, 0)
    found = diagnose(make_records(task).dataset, load_model("pendulum"))
    assert found.verdict == "unexplained"
    assert found.leftover.best is not None
    assert found.leftover.best.name == "theta over theta_rate, changing with time"


@pytest.mark.parametrize(
    ("name", "evidence", "validation", "error", "told"),
    [
        ("x over v", 2.0, 9.0, 5.0, True),
        ("x over v", 2.0, 7.0, 5.0, False),
        ("x over v", 20.0, 4.0, 5.0, False),
        ("x over v, changing with time", 2.0, 90.0, 5.0, False),
        ("x over v, changing with time", 90.0, 9.0, 1.0, False),
        ("x over v, changing with time", 90.0, 50.0, 30.0, False),
        ("x over v, changing with time", 11.0, 11.0, 5.0, True),
    ],
)
def test_what_drifts_must_show_in_either_use(
    name: str, evidence: float, validation: float, error: float, told: bool
) -> None:
    axis = Axis(name, evidence, validation, error, (), np.zeros(0))
    assert Leftover((axis,)).best is (axis if told else None)
