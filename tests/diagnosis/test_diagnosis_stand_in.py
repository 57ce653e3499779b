"""Names that are no diagnosis: two friction laws at one joint, and what is left can still be predicted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from harness.diagnosis.search.compare import Judged, compared
from harness.diagnosis.search.fit import Fit
from harness.diagnosis.search.outcome import Outcome
from harness.diagnosis.search.table import Accepted, Round
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


@pytest.mark.parametrize(("true_size", "denied"), [(1.0, False), (0.9, False), (0.5, True), (0.0, True)])
@pytest.mark.parametrize("seed", range(3))
def test_an_effect_of_another_size_in_the_validation_records_is_a_stand_in(
    true_size: float, denied: bool, seed: int
) -> None:
    """A bent scale of a circuit gained 2272 where it was fitted, and 9 of 61 promised where it was not."""
    law = np.sin(np.arange(2000) / 7.0)
    (spring,) = placed("cubic_spring@x")
    fits = {}
    for name, taken in (("base", 0.0), ("with", 1.0)):  # innovations of variance 1, of a law of size 1
        terms, innovations = {}, {}
        for use, size in (("estimation", 1.0), ("validation", true_size)):
            e = np.random.default_rng([seed, use == "validation"]).normal(size=len(law)) + (size - taken) * law
            terms[use], innovations[use] = [-0.5 * e**2], [(e[:, None], np.ones((len(law), 1)))]
        own = {"effects": () if name == "base" else (spring,), "penalised": sum(t[0].sum() for t in terms.values())}
        fits[name] = cast(Fit, SimpleNamespace(terms=terms, innovations=innovations, **own))
    row = Judged((spring,), fits["with"], compared(fits["with"], fits["base"]), ())
    outcome = Outcome(
        cast(Any, None), fits["base"], fits["with"], (Accepted(spring, ((spring,),), 1.0, 1.0),),
        (Round(fits["base"], cast(Any, None), (row,)),),
    )  # fmt: skip
    found = dict(outcome.denied())
    assert ("cubic_spring@x" in found) is denied
    if denied:
        assert found["cubic_spring@x"] == pytest.approx(true_size, abs=0.15)
