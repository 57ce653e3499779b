"""Names that are no diagnosis: two friction laws at one joint, and a rest that can still be predicted."""

from __future__ import annotations

import numpy as np
import pytest

from harness.diagnosis.adequacy import Adequacy, Predictable, nothing_left
from harness.diagnosis.report_summary import summary
from harness.diagnosis.stand_in import DRY, stand_in_reasons
from harness.effects import builtin
from harness.effects.effect import Placed


def placed(*names: str) -> list[Placed]:
    known = builtin()
    return [Placed(known[one.partition("@")[0]], one.partition("@")[2]) for one in names]


def left(rest: float) -> Adequacy:
    best = Predictable("theta'", 0.3, 0.001, np.ones(1), np.ones(3), np.ones((10, 1)))
    word = "explained" if rest <= 1.15 else "mostly_explained" if rest <= 2 else "proxy_or_incomplete"
    return Adequacy(word, rest, rest > 1.15, best, (best,), np.zeros(5))  # type: ignore[arg-type]


def test_the_friction_laws_are_those_of_the_dictionary() -> None:
    assert set(builtin()) >= DRY


@pytest.mark.parametrize(
    "names",
    [
        ("coulomb_friction@x", "stribeck_friction@x"),
        ("asymmetric_friction@x", "stribeck_friction@x"),
        ("force_bias@x", "hysteresis@x", "coulomb_friction@x"),
    ],
)
def test_two_friction_laws_at_one_joint_are_a_description(names: tuple[str, ...]) -> None:
    reasons = stand_in_reasons(placed(*names), nothing_left(), 1.0)
    assert len(reasons) == 1
    assert "imitate" in reasons[0]


@pytest.mark.parametrize(
    "names",
    [
        (),
        ("stribeck_friction@x",),
        ("coulomb_friction@x", "quadratic_drag@x"),
        ("coulomb_friction@x", "force_bias@x"),
        ("coulomb_friction@x", "load_dependent_friction@x"),
        ("coulomb_friction@x", "coulomb_friction@theta"),
        ("linear_spring@x", "cubic_spring@x"),
    ],
)
def test_effects_that_act_together_are_no_stand_in(names: tuple[str, ...]) -> None:
    assert stand_in_reasons(placed(*names), nothing_left(), 1.1) == ()


@pytest.mark.parametrize(
    ("rest", "ratio", "flagged"),
    [
        (1.0, 50.0, False),  # a disturbance that nothing predicts
        (1.08, 1.1, False),  # rounded corners, within the sensor's noise
        (1.08, 1.25, True),  # predicted beyond its null, and more than the sensor
        (1.08, None, False),
        (1.3, 1.4, True),
        (1.3, None, True),
        (3.0, 4.0, True),
    ],
)
def test_a_rest_that_can_be_predicted_makes_a_stand_in(rest: float, ratio: float | None, flagged: bool) -> None:
    assert bool(stand_in_reasons(placed("quadratic_drag@x"), left(rest), ratio)) is flagged
    assert stand_in_reasons([], left(rest), ratio) == ()


def test_the_verdict_line_says_stand_in() -> None:
    error = {"simulation_error": {"validation": {"x": {"rms": 0.2, "unit": "m"}}}}
    data = {
        "model": "cart",
        "verdict": "effects_found",
        "adequacy": "explained",
        "errors": {"before": error, "after": error},
        "effects": [{"name": "coulomb_friction", "at": "x"}],
        "tie_sets": [[{}]],
        "stand_in": {"flagged": False, "reasons": []},
        "disturbance": {},
    }
    assert summary(data).startswith("cart lacks coulomb friction at x")
    said = summary({**data, "stand_in": {"flagged": True, "reasons": ["two laws imitate it"]}})
    assert said.startswith("coulomb friction at x stands in for what cart lacks")
    assert "two laws imitate it" in said


@pytest.mark.parametrize(
    ("ratio", "predictable", "said"),
    [(29.0, False, True), (1.6, False, False), (None, False, False), (29.0, True, False)],
)
@pytest.mark.parametrize("verdict", ["effects_found", "nothing_missing"])
def test_the_verdict_line_does_not_call_much_more_than_noise_explained(
    ratio: float | None, predictable: bool, said: bool, verdict: str
) -> None:
    error = {"simulation_error": {"validation": {"x": {"rms": 0.2, "unit": "m"}}}}
    text = summary(
        {
            "model": "cart",
            "verdict": verdict,
            "adequacy": "explained",
            "errors": {"before": error, "after": error},
            "effects": [{"name": "backlash", "at": "x"}],
            "tie_sets": [[{}]],
            "stand_in": {"flagged": False, "reasons": []},
            "disturbance": {"x": {"ratio_to_noise": ratio, "predictable": predictable}},
        }
    )
    assert ("29 times the noise, cannot be predicted" in text) is said
    assert ("the residual is explained" in text) is (not said and verdict == "effects_found")
