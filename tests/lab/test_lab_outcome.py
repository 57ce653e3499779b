"""How answers count, and the exact bounds."""

from __future__ import annotations

import pytest
from scipy import stats
from sysid_lab.outcome import Answer, judge_answer
from sysid_lab.pages.statistics import clopper_pearson, upper_bound

from harness.errors import InputError


def group(*names):
    return frozenset(names)


@pytest.mark.parametrize(
    ("truth", "answer", "word"),
    [
        ({"coulomb_friction@x"}, Answer("effects_found", ("coulomb_friction@x",)), "right"),
        ({"coulomb_friction@x"}, Answer("effects_found", ("coulomb_friction@theta",)), "wrong"),
        (set(), Answer("nothing_missing", ()), "right"),
        (set(), Answer("unexplained", ()), "flagged"),
        (set(), Answer("effects_found", ("force_bias@x",)), "wrong"),
        ({"dead_zone@u"}, Answer("nothing_missing", ()), "missed"),
        ({"dead_zone@u"}, Answer("unexplained", ()), "flagged"),
        (set(), Answer("model_does_not_fit", ()), "flagged"),
        ({"dead_zone@u"}, Answer("model_does_not_fit", ()), "flagged"),
        ({"input_gain@u"}, Answer("nothing_missing", (), (), group("input_gain@u")), "tied"),
        (
            {"stribeck_friction@x"},
            Answer("effects_found", ("coulomb_friction@x",), ((group("stribeck_friction@x"),),)),
            "tied",
        ),
        (
            {"stribeck_friction@x"},
            Answer("effects_found", ("coulomb_friction@x", "cogging@x"), ((group("stribeck_friction@x"),), ())),
            "wrong",
        ),
        ({"asymmetric_friction@x"}, Answer("effects_found", ("coulomb_friction@x", "force_bias@x")), "tied"),
        ({"coulomb_friction@x", "force_bias@x"}, Answer("effects_found", ("asymmetric_friction@x",)), "tied"),
        (
            {"coulomb_friction@x", "input_delay@u"},
            Answer("effects_found", ("coulomb_friction@x",)),
            "wrong",
        ),
        ({"gravity_tilt@base"}, Answer("effects_found", ("sensor_offset@theta",)), "wrong"),
    ],
)
def test_an_answer_counts_as_it_should(truth, answer, word):
    assert judge_answer(truth, answer, "cart-pole").word == word


@pytest.mark.parametrize(
    ("truth", "name"),
    [("hysteresis@x", "parallel_hysteresis@x"), ("elasticity@x", "hardening_elasticity@x"),
     ("backlash@x", "unilateral_backlash@x"), ("stribeck_friction@x", "lugre_friction@x")],
)  # fmt: skip
def test_what_hardware_has_may_be_named_by_the_law_that_says_so(truth: str, name: str) -> None:
    found = Answer("effects_found", (name,))
    assert judge_answer({truth}, found, "cart-pole", "hardware").word == "right"
    assert judge_answer({truth}, found, "cart-pole", "laws").word == "wrong", "there the plain law is the truth"


def test_a_stand_in_is_no_confident_name() -> None:
    two = ("coulomb_friction@x", "stribeck_friction@x")
    assert judge_answer({"root_friction@x"}, Answer("effects_found", two), "cart-pole").word == "wrong"
    assert judge_answer({"root_friction@x"}, Answer("effects_found", two, stand_in=True), "cart-pole").word == "flagged"
    right = judge_answer(set(two), Answer("effects_found", two, stand_in=True), "cart-pole")
    assert (right.word, right.how) == ("right", "said to be a stand-in")
    assert judge_answer((), Answer("effects_found", two, stand_in=True), "cart-pole").word == "wrong"


def test_a_wrong_structure_without_a_name_is_missing_as_any_law_outside_the_dictionary() -> None:
    drag = Answer("effects_found", ("quadratic_drag@x",))
    flagged = Answer("effects_found", ("quadratic_drag@x",), stand_in=True)
    assert judge_answer((), drag, "cart-pole", structure="tiring-drive").word == "wrong"
    assert judge_answer((), flagged, "cart-pole", structure="tiring-drive").word == "flagged"
    assert judge_answer((), flagged, "cart-pole", structure="bent-scale").word == "wrong"


def test_tilt_and_offset_are_the_same_on_one_joint_only():
    answer = Answer("effects_found", ("stribeck_friction@theta", "sensor_offset@theta"))
    assert judge_answer({"stribeck_friction@theta", "gravity_tilt@base"}, answer, "pendulum").word == "tied"


@pytest.mark.parametrize(("found", "of"), [(0, 300), (1, 300), (7, 40), (40, 40)])
def test_bounds_are_those_of_the_binomial_distribution(found, of):
    bound = upper_bound(found, of)
    if found < of:
        assert stats.binom.cdf(found, of, bound) == pytest.approx(0.05)
    ours = clopper_pearson(found, of)
    theirs = stats.binomtest(found, of).proportion_ci(0.95, method="exact")
    assert ours == pytest.approx((theirs.low, theirs.high))


def test_impossible_counts_are_refused():
    with pytest.raises(InputError):
        upper_bound(3, 2)


def test_naming_how_the_structure_is_wrong_is_no_fault() -> None:
    encoder = "sensor_cyclic_error@theta"
    for accepted, truth, word in (
        ((encoder,), (), "right"),
        (("backlash@theta", encoder), ("backlash@theta",), "right"),
        ((encoder,), ("backlash@theta",), "missed"),
        (("cogging@theta", encoder), ("backlash@theta",), "wrong"),
    ):
        answer = Answer("effects_found", accepted)
        assert judge_answer(truth, answer, "pendulum", "", "eccentric-encoder").word == word
        assert judge_answer(truth, answer, "pendulum", "", "bent-scale").word == "wrong"
    damping = Answer("effects_found", ("position_dependent_damping@x",))
    assert judge_answer((), damping, "cart-pole", "", "uneven-damping").word == "right"
    assert judge_answer((), damping, "pendulum", "", "uneven-damping").word == "wrong"
    imitated = Answer("effects_found", (encoder,), stand_in=True)
    assert judge_answer(("backlash@theta",), imitated, "pendulum", "", "eccentric-encoder").word == "flagged"
