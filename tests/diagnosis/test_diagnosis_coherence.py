"""What is called periodic repeats: a line whose amplitude and phase change along the records is a disturbance."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.forms.coherence import in_parts, wandering
from harness.diagnosis.forms.directions import Direction
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.fit import Column, Linearised
from harness.effects import builtin
from harness.physics import load_model
from harness.signals import FloatArray
from harness.study.plan import Task
from harness.study.records import make_records

N, DT = 2000, 0.01
T = np.arange(N) * DT
PARTS = POLICY.line_parts


def line(parts: int = PARTS) -> list[Column]:
    """Sine and cosine of 1 Hz, on one record of each use, in parts."""
    whole = np.stack([np.sin(2 * np.pi * T), np.cos(2 * np.pi * T)], axis=1)
    edges = np.linspace(0, N, parts + 1).astype(int)
    found = []
    for use in range(2):
        for first, last in itertools.pairwise(edges):
            columns = [np.zeros((N, 2)), np.zeros((N, 2))]
            columns[use][first:last] = whole[first:last]
            found.append(Column(None, {}, ("in phase", "quarter turn"), *columns))
    return found


def evidence(estimation: FloatArray, validation: FloatArray) -> float:
    """For a line that wanders, where a constant one is already free."""
    constant = np.sum([one.estimation for one in line()], axis=0)
    nuisance = {"estimation": constant, "validation": np.zeros((N, 2))}
    residual = {"estimation": estimation, "validation": validation}
    linear = Linearised(residual, nuisance, ("a", "b"), spread=np.zeros((2, 0)))
    return wandering(linear, line())


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.0, 5.0), phase=st.floats(-3.0, 3.0))
def test_a_line_that_keeps_its_phase_is_none_that_wanders(seed: int, size: float, phase: float) -> None:
    rng = np.random.default_rng(seed)
    steady = size * np.sin(2 * np.pi * T + phase)
    assert evidence(*(steady + rng.standard_normal(N) for _ in range(2))) < POLICY.evidence


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.floats(1.5, 4.5), use=st.sampled_from([0, 1]))
def test_a_phase_that_changes_within_one_record_is_seen(seed: int, turn: float, use: int) -> None:
    rng = np.random.default_rng(seed)
    records = [rng.standard_normal(N) for _ in range(2)]
    records[use] += 0.4 * np.sin(2 * np.pi * T + turn * (T > T[N // 2]))
    assert evidence(*records) > POLICY.evidence


def test_the_parts_of_a_direction_are_the_direction() -> None:
    rng = np.random.default_rng(0)
    forces = {use: [rng.standard_normal((n, 2, 2)) for n in (101, 50)] for use in ("estimation", "validation")}
    nothing = {use: [np.zeros((len(one), 1, 2)) for one in records] for use, records in forces.items()}
    parts = in_parts(Direction(None, {}, ("a", "b"), forces, nothing), PARTS)
    assert len(parts) == 4 * PARTS
    for use, records in forces.items():
        for number, whole in enumerate(records):
            each = [one.forces[use][number] for one in parts]
            np.testing.assert_array_equal(np.sum(each, axis=0), whole)
            assert sum(bool(one.any()) for one in each) == PARTS


@pytest.mark.parametrize("hidden", [False, True])
def test_noise_at_the_resonance_is_no_periodic_disturbance_and_a_sine_is(hidden: bool) -> None:
    """Under the unknown force of the second record free runs err more with the sine than without, by chance."""
    task = (
        Task("confusion", "pendulum", "fmu", ("periodic_disturbance@theta",), "quarter", "high", 0.02, 0, 150_000)
        if hidden
        else Task("none", "pendulum", "bullet", (), "", "drawn", 0.02, 18, 150_000, shape="resonance")
    )
    tried = [builtin()[name] for name in ("periodic_disturbance", "cogging")]
    found = diagnose(make_records(task).dataset, load_model("pendulum"), dictionary=tried)
    assert [str(one.placed) for one in found.outcome.accepted] == ["periodic_disturbance@theta"] * hidden
    assert not found.outcome.withdrawn
    reasons = [text for one in found.outcome.rounds[0].candidates for text in one.reasons]
    assert any("amplitude and phase change along the records" in text for text in reasons) is not hidden
