"""Names that are no diagnosis: two friction laws at one joint, and what is left can still be predicted."""

from __future__ import annotations

import pytest

from harness.diagnosis.stand_in import stand_in_reasons
from harness.effects import builtin, effect
from harness.effects.effect import Placed


def placed(*names: str) -> list[Placed]:
    known = builtin()
    return [Placed(known[one.partition("@")[0]], one.partition("@")[2]) for one in names]


def test_a_law_of_others_counts_as_they_say_of_it() -> None:
    """Two laws of the whole dry friction of a joint were no stand-in if one was a plug-in's."""

    @effect("coordinate", whole="dry friction")
    def my_dry(f, s, p, q, v):  # type: ignore[no-untyped-def]
        return -v

    mine, ours = Placed(my_dry, "x"), *placed("coulomb_friction@x")
    assert stand_in_reasons([mine, ours], None)
    assert not stand_in_reasons([mine, *placed("coulomb_friction@theta")], None)


@pytest.mark.parametrize(
    "names",
    [
        ("coulomb_friction@x", "stribeck_friction@x"),
        ("asymmetric_friction@x", "stribeck_friction@x"),
        ("force_bias@x", "hysteresis@x", "coulomb_friction@x"),
    ],
)
def test_two_friction_laws_at_one_joint_are_a_description(names: tuple[str, ...]) -> None:
    (reason,) = stand_in_reasons(placed(*names), None)
    assert "imitate" in reason


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
    assert stand_in_reasons(placed(*names), None) == ()


def test_what_can_still_be_predicted_makes_a_stand_in_of_any_effect() -> None:
    (reason,) = stand_in_reasons(placed("quadratic_drag@x"), "x over x_rate")
    assert "x over x_rate" in reason
    assert stand_in_reasons([], "x over x_rate") == (), "nothing was named"
