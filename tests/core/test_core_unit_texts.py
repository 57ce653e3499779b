"""A unit's text comes from anybody's file: it is read in bounded time, or refused in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.errors import InputError
from harness.units import base_units, convert, fits
from harness.units.conversion import COMMON, SECONDS
from harness.units.grammar import DEEPEST, factors, product

SOUND = (
    "N m",
    "rad/s",
    "kg*m^2/s^2",
    "W/(m^2 K)",
    "V/Hz^(1/2)",
    "m/s²",
    "°/s",
    "degC",
    "%",
    "µm",
    "kgm2",
    "N·m",
    "1/s",
)
MUTATIONS = st.sampled_from([*"()[]{}^*/.+-,;:#\n\r\t\0\\\"'`!?=<>|&~$@%°²⁹⁻019eEjJ_ ", "^9^9^9", "**", "//", "1/0",
                             "e999", "lambda", "if ", "((", "9" * 30, "\u2028", "\U0001f600", "\u0301"])  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn) -> str:
    text = draw(st.sampled_from(SOUND))
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(text)))
        text = text[:place] + draw(MUTATIONS) + text[place + draw(st.integers(0, 2)) :]
    return text


@settings(deadline=None, max_examples=400)
@given(mutated() | st.text(max_size=30))
def test_a_text_is_a_unit_or_refused(text: str) -> None:
    for call in (lambda: base_units(text), lambda: fits(text, "rad"), lambda: convert(np.ones(2), text, "m")):
        said = _refusal(call)
        assert "\n" not in said
        assert len(said) < 400


def _refusal(call: Callable[[], Any]) -> str:
    try:
        call()
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    "text",
    ["9^9^9", "m^9^9", "m(", "m)", "1/0", "m/0", "m # s", "m\ns", "m^99", "m^(1/0)", "1e3", "m**1e9",
     "(" * 50 + "m" + ")" * 50,
     "m" * 100, "m ** (9**9)", "__import__('os')", "m!", "10 m", "", "/s", "m*", "m//s", "m^^2"],
)  # fmt: skip
def test_what_is_no_unit_is_refused(text: str) -> None:
    if text:
        with pytest.raises(InputError, match="unknown unit"):
            base_units(text)
    with pytest.raises(ValueError, match=r"."):
        factors(text)


@pytest.mark.parametrize(
    ("text", "value", "target"),
    [("N m", 1.0, "J"), ("kgm2/s2", 1.0, "J"), ("W/m²K", 1.0, "W*K/m^2"), ("V/Hz**0.5", 1.0, "V/Hz^(1/2)"),
     ("deg C", 300.15, "K"), ("degC/min", 1 / 60, "K/s"), ("Δ°C", 27.0, "K"), ("%", 0.01, "1"), 
     ("m per s", 3.6, "km/h"),
     ("square mm", 1e-6, "m^2"), ("s^{-1}", 60.0, "1/min"), ("µm⋅ms⁻¹", 1e-3, "m/s"),
 ("(N m)/(rad/s)", 1.0, "N m s/rad"),
     ("m s^-2.5", 1.0, "m/s^(5/2)"), ("rpm", np.pi / 30, "rad/s"), ("((m))", 1.0, "m"), ("1.0", 1.0, "1"),
     ("km/h", 1 / 3.6, "m/s"), ("kmph", 1 / 3.6, "m/s"), ("mVolts", 1e-3, "V"), ("mBar", 100.0, "Pa"), ("kts",
      1852 / 3600, "m/s"), ("Deg/s", np.pi / 180, "rad/s"), ("rads/s", 1.0, "rad/s"), ("hrs", 3600.0, "s")],
)  # fmt: skip
def test_what_engineers_write_is_read(text: str, value: float, target: str) -> None:
    given = 27.0 if "C" in text and "min" not in text else 1.0
    assert convert(np.array([given]), text, target)[0] == pytest.approx(value, rel=1e-12)


PARTS = st.tuples(st.sampled_from(["m", "kg", "s", "rad", "K"]), st.integers(-4, 4).filter(bool))


@given(st.lists(PARTS, min_size=1, max_size=4))
def test_powers_of_a_quotient_change_their_sign(parts: list[tuple[str, int]]) -> None:
    product = " ".join(f"{name}^{power}" for name, power in parts)
    assert factors(f"1/({product})") == [(name, -power) for name, power in factors(product)]


@pytest.mark.parametrize(
    ("text", "powers", "factor", "offset"),
    [("degC", {"K": 1}, 1.0, 273.15), ("degF", {"K": 1}, 5 / 9, 459.67 * 5 / 9), ("[mm]", {"m": 1}, 1e-3, 0.0),
     (" [ N m ] ", {"kg": 1, "m": 2, "s": -2}, 1.0, 0.0), ("deg/s", {"rad": 1, "s": -1}, np.pi / 180, 0.0),
     ("mV^(1/2)", {"kg": 0.5, "m": 1, "s": -1.5, "A": -0.5}, 1e-3**0.5, 0.0), ("", {}, 1.0, 0.0), ("-", {}, 1.0, 0.0),
     ("SEC", {"s": 1}, 1.0, 0.0), ("RPM", {"rad": 1, "s": -1}, np.pi / 30, 0.0), ("mS", {"A": 2, "kg": -1, "m": -2,
      "s": 3}, 1e-3, 0.0), ("MS", {"A": 2, "kg": -1, "m": -2, "s": 3}, 1e6, 0.0)],
)  # fmt: skip
def test_what_goes_into_an_fmu(text: str, powers: dict[str, float], factor: float, offset: float) -> None:
    """Powers of the SI units, factor and offset: value in SI = factor * value + offset (FMI 3.0, sec. 2.4.5)."""
    found = base_units(text)
    assert found[0] == powers
    assert found[1:] == (pytest.approx(factor, rel=1e-12), pytest.approx(offset, rel=1e-12))


@pytest.mark.parametrize("text", ["KM", "NF", "SV", "HZ"])
def test_a_short_sign_is_another_one_with_capitals(text: str) -> None:
    with pytest.raises(InputError, match="unknown unit"):
        base_units(text)


@pytest.mark.parametrize(
    "text",
    ["%RH", "pct", "cfm", "Gs", "ma", "ua", "pps", "pk", "pt", "rd", "gr", "b", "B", "c", "mil", "Ra", "km ua",  # odd
     "mPas", "mAs", "As", "kgs", "Pas", "MVolts"],  # no plurals of mPa and A; mega- is no milli-
)  # fmt: skip
def test_letters_of_which_a_library_would_make_an_odd_unit_are_none(text: str) -> None:
    """A percentage is no 1e25 H, a flow in cubic feet a minute no fermi, and humidity no henry."""
    with pytest.raises(InputError, match="unknown unit"):
        base_units(text)


def test_what_is_known_as_a_unit_before_it_is_read_is_one() -> None:
    assert all(fits(text, text) for text in COMMON)
    assert {unit: base_units(unit)[1] for unit in SECONDS} == pytest.approx(SECONDS, rel=1e-15)
    for unit, size in SECONDS.items():
        for target, factor in (("s", size), ("min", size / 60.0), ("ms", size * 1e3)):
            assert convert(np.array([7.0]), unit, target)[0] == pytest.approx(7.0 * factor)


def test_two_readings_go_by_what_is_expected_or_are_refused() -> None:
    for text, target, value in (
        ("NM", "N m", 1.0),
        ("NM", "m", 1e-9),
        ("MM", "mm", 1.0),
        ("C", "degC", 27.0),
        ("mg", "mm/s^2", 9.80665),
        ("mg", "kg", 1e-6),
        ("ms-2", "m/s^2", 1.0),
        ("oz", "N", 0.278014),
        ("ms⁻¹", "cm/s", 100.0),
        ("ms^-1", "1/s", 1e3),
        ("lb", "kg", 0.453592),
    ):
        given = np.array([27.0 if text == "C" else 1.0])
        assert convert(given, text, target)[0] == pytest.approx(value, rel=1e-6)
    for text in ("NM", "MM", "C", "F", "mg", "ug", "lbs", "fps", "a", "ms-2", "ms⁻¹", "ms^-2"):
        with pytest.raises(InputError, match=rf"the unit '{re.escape(text)}' has two readings"):
            base_units(text)
    with pytest.raises(InputError, match=r"unit does not fit|two readings"):
        convert(np.ones(1), "NM", "V")


def test_parentheses_are_nested_so_far_and_no_further() -> None:
    assert factors("(" * DEEPEST + "m" + ")" * DEEPEST) == [("m", 1)]
    for deep in (DEEPEST + 1, DEEPEST + 8):
        with pytest.raises(ValueError, match="parentheses in parentheses"):
            factors("(" * deep + "m" + ")" * deep)


@pytest.mark.parametrize("unit", ["dB", "dBm", "dBW", "dBu", "Np", "octave"])
@pytest.mark.parametrize("use", [lambda unit: convert(np.ones(2), unit, "W"), base_units])
def test_a_logarithm_is_refused_as_its_reference_is_open(unit: str, use: Callable[[str], Any]) -> None:
    with pytest.raises(InputError, match=r"logarithm.*unit = '1'|unit does not fit"):
        use(unit)


def test_a_unit_with_another_zero_is_no_logarithm() -> None:
    assert convert(np.array([20.0]), "degC", "K") == pytest.approx([293.15])
    assert base_units("degF")[1:] == pytest.approx((5 / 9, 459.67 * 5 / 9))


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ([("N*m", 1)], "N*m"),
        ([("N*m", 1), ("1", 2), ("s", 0)], "N*m"),
        ([("m/s", 2)], "m^2/s^2"),
        ([("m/s", -1)], "s/m"),
        ([("m", 1), ("m", -1)], "1"),
        ([], "1"),
        ([("m?", 2), ("s", -3)], "(m?)^2/(s)^3"),
        ([("m?", -2)], "1/(m?)^2"),
        ([("m?", 1), ("s", 1)], "(m?) (s)"),
    ],
)
def test_a_product_of_units_is_reckoned_and_one_alone_stays_as_it_was_written(
    parts: list[tuple[str, int]], text: str
) -> None:
    assert product(parts) == text


@pytest.mark.parametrize("degree", ["Deg", "deg.", "degrees", "DEG", "°", "grad", "Degree"])
@pytest.mark.parametrize(("scale", "meant"), [("C", "degC"), ("F", "degF"), ("K", "K")])
def test_a_degree_beside_the_letter_of_a_scale_is_one_of_temperature(degree: str, scale: str, meant: str) -> None:
    """Campbell's loggers write Deg C: as an angle times a charge it passed for a unit."""
    for joint in (" ", "_"):
        written = f"{degree}{joint}{scale}"
        assert convert(np.array([20.0]), written, "K") == pytest.approx(convert(np.array([20.0]), meant, "K"))
    assert convert(np.ones(1), f"W/{degree} {scale}", "W/K") == pytest.approx(convert(np.ones(1), f"W/{meant}", "W/K"))
