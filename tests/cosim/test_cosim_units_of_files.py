"""Units that a file defines by base units: what they become in SI, and when a number means the same in two of them."""

from __future__ import annotations

import pytest

from harness.cosim.structure.conversion import Chain, LinearConversion, Unit, change_of_unit, named_unit, unit_of


@pytest.mark.parametrize(
    ("text", "powers", "factor", "offset", "si"),
    [
        ("m", {"m": 1}, 1.0, 0.0, "m"),
        ("N.m", {"kg": 1, "m": 2, "s": -2}, 1.0, 0.0, "N m"),
        ("mm", {"m": 1}, 1e-3, 0.0, "m"),
        ("furlong", {"m": 1}, 201.168, 0.0, "m"),
        ("degC", {"K": 1}, 1.0, 273.15, "K"),
        ("Hz", {"s": -1}, 1.0, 0.0, "Hz"),
        ("my Hz", {"s": -1}, 1.0, 0.0, "1/s"),
        ("W/m2/K", {"kg": 1, "s": -3, "K": -1}, 2.0, 0.0, "kg/(s^3*K)"),
        ("x", {}, 1.0, 0.0, "1"),
    ],
)
def test_a_unit_has_the_name_that_is_known_or_its_powers(
    text: str, powers: dict[str, float], factor: float, offset: float, si: str
) -> None:
    made = unit_of(text, powers, factor, offset)
    assert (made.si, made.factor, made.offset) == (si, factor, offset)


def test_a_bare_number_has_no_unit() -> None:
    assert named_unit("-", "1", 1.0, 0.0) is None
    assert named_unit("%", "1", 0.01, 0.0) is not None, "a hundredth is one"
    assert named_unit("x", "1", 1.0, 5.0) is not None
    assert named_unit("m", "nothing known", 1.0, 0.0) is None


def test_one_name_with_one_factor_is_one_unit_whatever_its_powers() -> None:
    right, wrong = Unit("N", "N", 1.0, 0.0, (("kg", 1.0),)), Unit("N", "N", 1.0, 0.0, (("m", 1.0),))
    assert change_of_unit(right, wrong) == LinearConversion()
    for other in (Unit("n", "N", 1.0, 0.0, wrong.powers), Unit("N", "N", 2.0, 0.0, wrong.powers),
                  Unit("N", "N", 1.0, 2.0, wrong.powers)):  # fmt: skip
        assert change_of_unit(right, other) is None
    doubled = Unit("N", "N", 2.0, 6.0, right.powers)
    assert change_of_unit(right, doubled) == LinearConversion(0.5, -3.0)
    assert change_of_unit(doubled, right) == LinearConversion(2.0, 6.0)


def test_a_chain_of_nothing_is_nothing() -> None:
    assert Chain().then(LinearConversion()).steps == ()
    there = Chain().then(LinearConversion(1.8, 32.0))
    assert there.then(LinearConversion(1 / 1.8, -32.0 / 1.8)).steps == ()
    assert there(10.0) == 50.0
    assert there.linear == LinearConversion(1.8, 32.0)
    assert Chain().then(LinearConversion(1.0, 1e-9)).steps == (LinearConversion(1.0, 1e-9),), "small is not rounding"
