"""The list of deliberate faults against the checks: almost all are caught, and nobody sound is blamed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import faults
import pytest
import sound

from harness.conformance import (
    CheckResult,
    check_identifier,
    check_online_identifier,
    check_plant,
    check_scenario,
    identifier_checks,
    run_checks,
)

KINDS = ("linear", "linear, state measured", "pendulum, rate measured")
RUN: dict[str, Callable[[Callable[[], Any]], list[CheckResult]]] = {
    "identifiers": lambda make: check_identifier(make, examples=2),
    "online": lambda make: check_online_identifier(make, examples=2),
    "plants": check_plant,
    "scenarios": check_scenario,
}
MISSED: frozenset[str] = frozenset()
"""Faults that no check finds; at most one of the thirty."""


def test_the_list_has_thirty_faults() -> None:
    assert len({str(fault) for fault in faults.FAULTS}) == 30
    assert len(MISSED) <= 1


@pytest.mark.parametrize("fault", faults.FAULTS, ids=str)
def test_a_fault_is_caught_with_a_reason(fault: faults.Fault) -> None:
    found = [result for result in RUN[fault.kind](fault.make) if not result.passed]
    assert bool(found) == (str(fault) not in MISSED)
    assert all(result.reason and "\n" not in result.reason for result in found)


@pytest.mark.parametrize("identifier", [*sound.SOUND, sound.Sound], ids=lambda one: one.__name__)
def test_no_sound_identifier_is_blamed(identifier: Callable[[], Any]) -> None:
    if identifier.__name__.startswith("Scikit"):
        pytest.importorskip("sklearn", reason="scikit-learn is not installed: pip install scikit-learn")
    if identifier is sound.Sippy:
        pytest.importorskip("sippy_unipi", reason="SIPPY is not installed: pip install sippy-unipi")
    kinds = (
        KINDS[:2] if identifier.__name__ in ("ScikitTree", "ScikitRidge", "Sippy", "FiniteImpulseResponse") else KINDS
    )
    results = check_identifier(identifier, kinds=kinds, examples=2)
    assert [f"{result.name}: {result.reason}" for result in results if not result.passed] == []


@pytest.mark.parametrize(
    ("kind", "part"), [("online", sound.SoundOnline), ("plants", sound.Lag), ("scenarios", sound.Noise)]
)
def test_no_other_sound_part_is_blamed(kind: str, part: Callable[[], Any]) -> None:
    assert [f"{result.name}: {result.reason}" for result in RUN[kind](part) if not result.passed] == []


def test_a_declared_shortcoming_is_said_and_strict() -> None:
    class OneRecord(faults.FirstRecordOnly):
        expected_failures: ClassVar[dict[str, str]] = {"all_records_used": "it takes one record"}

    checks = {check.name: check for check in identifier_checks(kinds=KINDS[:1], examples=1)}
    (result,) = run_checks([checks["all_records_used"]], OneRecord)
    assert result.passed
    assert "it takes one record" in result.reason

    declared = {"deterministic": "so it says", "typo": "no check has this name"}
    typo, result = run_checks([checks["deterministic"]], sound.Sound, expected_failures=declared)
    assert not result.passed
    assert "passes: remove that" in result.reason
    assert not typo.passed


def test_a_plug_in_of_its_own_is_tested_in_three_lines() -> None:
    check = identifier_checks(kinds=KINDS[:1], examples=1)[0]
    check(sound.Sound)
    with pytest.raises(AssertionError, match="it predicts better"):
        {one.name: one for one in identifier_checks(kinds=KINDS[:1])}["beats_trivial"](faults.PredictsZero)
