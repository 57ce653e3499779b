"""Small faults of units that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

import numpy as np
import pytest

from harness.errors import InputError
from harness.units import base_units, convert, told
from harness.units.grammar import DEEPEST, HIGHEST, LONGEST, factors


def test_a_unit_may_be_as_long_as_deep_and_as_high_as_is_said() -> None:
    assert (LONGEST, DEEPEST, HIGHEST) == (80, 4, 9)
    for most, too_much in (("m" * 80, "m" * 81), ("((((m))))", "(((((m)))))"), ("m^9", "m^10"), ("m^-9", "m^-10")):
        assert factors(most)
        with pytest.raises(ValueError, match=r"."):
            factors(too_much)


@pytest.mark.parametrize(
    ("unit", "target", "given", "expected"),
    [("g", "kg", 2.0, 0.002), ("g", "m/s^2", 2.0, 19.6133), ("C", "A s", 3.0, 3.0), ("C", "K", 3.0, 276.15),
     ("NM", "N m", 2.0, 2.0), ("NM", "m", 2.0, 2e-9)],
)  # fmt: skip
def test_of_two_readings_the_one_that_fits_is_taken(unit: str, target: str, given: float, expected: float) -> None:
    assert convert(np.array([given]), unit, target)[0] == pytest.approx(expected)


@pytest.mark.parametrize(("unit", "target"), [("g", "1"), ("grad", "rad"), ("au", "V")])
def test_of_two_readings_neither_or_both_are_refused(unit: str, target: str) -> None:
    with pytest.raises(InputError, match=r"unit does not fit|two readings"):
        convert(np.ones(1), unit, target)


@pytest.mark.parametrize(
    ("unit", "scale", "offset"), [("degC", 1.0, 273.15), ("degF", 5 / 9, 459.67 * 5 / 9), ("mm", 1e-3, 0.0)]
)
def test_a_unit_is_a_scale_and_an_offset_from_si(unit: str, scale: float, offset: float) -> None:
    _, found_scale, found_offset = base_units(unit)
    assert (found_scale, found_offset) == (pytest.approx(scale), pytest.approx(offset))


@pytest.mark.parametrize(("unit", "target"), [("1", "rad"), ("-", "rad"), ("1/s", "rad/s"), ("s^-1", "rad/s")])
def test_a_plain_number_is_an_angle_in_radians(unit: str, target: str) -> None:
    assert convert(np.array([2.0]), unit, target).tolist() == [2.0]


@pytest.mark.parametrize(
    ("unit", "target"), [("%", "rad"), ("count", "rad"), ("tick", "rad"), ("Hz", "rad/s"), ("1/min", "rad/s")]
)
def test_a_share_a_count_or_a_frequency_is_no_angle(unit: str, target: str) -> None:
    with pytest.raises(InputError, match=r"unit does not fit|two readings"):
        convert(np.ones(1), unit, target)


@pytest.mark.parametrize(
    ("size", "unit", "own", "found"),
    [
        (3.0, "N m", "NM", (3.0, "NM")),
        (3e-9, "m", "NM", (3.0, "NM")),
        (3.0, "V", "NM", (3.0, "V")),
        (3.0, "m", "K", (3.0, "m")),
        (3.0, "K", "degF", (5.4, "degF")),
    ],
)
def test_a_user_is_told_a_size_in_the_reading_of_his_unit_that_fits(
    size: float, unit: str, own: str, found: tuple[float, str]
) -> None:
    value, shown = told(size, unit, own)
    assert (value, shown) == (pytest.approx(found[0]), found[1])
    values, shown = told(np.array([[size, 0.0]]), unit, own)
    assert values == pytest.approx(np.array([[found[0], 0.0]]))
    assert shown == found[1]
