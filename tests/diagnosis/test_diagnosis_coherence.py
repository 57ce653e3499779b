"""What is called periodic repeats: a line whose amplitude and phase change along the records is a disturbance."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sysid_lab.plan import Task
from sysid_lab.records import make_records

from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.directions.coherence import answering, in_parts, incoherence, of_inputs, without
from harness.diagnosis.directions.directions import Direction
from harness.diagnosis.policy import POLICY
from harness.diagnosis.search.fit import WAVE, Column, Linearised
from harness.diagnosis.search.refusal import Kind
from harness.effects import builtin
from harness.physics import load_model
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory

N, DT = 2000, 0.01
T = np.arange(N) * DT
PARTS = POLICY.line_parts


def line(parts: int) -> list[Column]:
    """Sine and cosine of 1 Hz, on one record of each use, in parts."""
    whole = np.stack([np.sin(2 * np.pi * T), np.cos(2 * np.pi * T)], axis=1)
    edges = np.linspace(0, N, parts + 1).astype(int)
    found = []
    for use in range(2):
        for first, last in itertools.pairwise(edges):
            columns = [np.zeros((N, 2)), np.zeros((N, 2))]
            columns[use][first:last] = whole[first:last]
            found.append(Column(None, {}, WAVE, *columns, kind="wave"))
    return found


def evidence(estimation: FloatArray, validation: FloatArray) -> float:
    """For a line that is drawn anew in parts, beside a constant force that is free."""
    nuisance = {use: np.ones((N, 1)) for use in ("estimation", "validation")}
    residual = {"estimation": estimation, "validation": validation}
    linear = Linearised(residual, nuisance, ("bias",), spread=np.ones((1, 1)))
    return incoherence(linear, line(1), [line(parts) for parts in PARTS])


def answer(lines: Sequence[FloatArray], inputs: Sequence[FloatArray], seed: int) -> float:
    """Evidence that lines of 1 Hz in two records are a part of the answer to their inputs."""
    rng = np.random.default_rng(seed)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    uses = ("estimation", "validation")
    records = {use: [Trajectory(T, u[:, None], u[:, None], spec)] for use, u in zip(uses, inputs, strict=True)}
    wave = np.stack([np.sin(2 * np.pi * T), np.cos(2 * np.pi * T)], axis=1)[:, None]
    whole = Direction(None, {}, WAVE, {use: [wave] for use in uses}, {use: [0 * wave] for use in uses})
    (part,) = of_inputs(whole, records, 2 * np.pi)
    column = Column(None, {}, WAVE, *(part.forces[use][0][:, 0] for use in uses), kind="wave")
    residual = {use: one + rng.standard_normal(N) for use, one in zip(uses, lines, strict=True)}
    nuisance = {use: np.ones((N, 1)) for use in uses}
    return answering(Linearised(residual, nuisance, ("bias",), spread=np.ones((1, 1))), line(1), [[column]])


def multisine(rng: np.random.Generator, at: tuple[float, ...] = (0.4, 1.0, 1.7)) -> tuple[FloatArray, FloatArray]:
    """Return an input with lines [Hz], and the line of 1 Hz of the answer of a plant to it."""
    turns = rng.uniform(-np.pi, np.pi, len(at))
    u = np.sum([np.sin(2 * np.pi * f * T + turn) for f, turn in zip(at, turns, strict=True)], axis=0)
    return u, np.sin(2 * np.pi * T + turns[min(1, len(at) - 1)] + 0.8)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.3, 5.0))
def test_a_line_that_goes_with_the_input_in_every_record_is_no_periodic_force(seed: int, size: float) -> None:
    """What the model lacks of an answer, in records whose inputs have other phases."""
    rng = np.random.default_rng(seed)
    inputs, answers = zip(*(multisine(rng) for _ in range(2)), strict=True)
    assert answer([size * one for one in answers], inputs, seed) > 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.5, 5.0), phases=st.tuples(st.floats(-3, 3), st.floats(-3, 3)))
def test_a_force_that_the_input_has_nothing_to_do_with_stays_periodic(
    seed: int, size: float, phases: tuple[float, float]
) -> None:
    rng = np.random.default_rng(seed)
    lines = [size * np.sin(2 * np.pi * T + phase) for phase in phases]
    apart = [multisine(rng, (0.4, 1.7, 2.3))[0] for _ in range(2)]
    assert answer(lines, apart, seed) < 0
    noise = [rng.standard_normal(N) for _ in range(2)]  # which has this frequency, among all others
    assert answer(lines, noise, seed) < 0


def test_a_force_at_a_line_of_the_input_is_told_by_its_phases() -> None:
    rng = np.random.default_rng(3)
    inputs, answers = zip(*(multisine(rng) for _ in range(2)), strict=True)
    assert answer([answers[0], np.roll(answers[1], 25)], inputs, 3) < 0  # a quarter of a period later in one of them


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(0.2, 5.0), phase=st.floats(-3.0, 3.0))
def test_a_line_that_keeps_its_phase_is_none_that_wanders(seed: int, size: float, phase: float) -> None:
    rng = np.random.default_rng(seed)
    steady = size * np.sin(2 * np.pi * T + phase)
    assert evidence(*(steady + rng.standard_normal(N) for _ in range(2))) < 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), phase=st.floats(-3.0, 3.0), anew=st.floats(0.0, 0.05))
def test_a_line_that_a_model_error_bends_a_little_still_repeats(seed: int, phase: float, anew: float) -> None:
    """The change itself is far beyond chance: what counts is that the line is larger."""
    rng = np.random.default_rng(seed)
    records = []
    for _ in range(2):
        steps = anew * np.repeat(rng.standard_normal((8, 2)), N // 8, axis=0)
        bent = np.sin(2 * np.pi * T + phase) * (1 + steps[:, 0]) + np.cos(2 * np.pi * T + phase) * steps[:, 1]
        records.append(3.0 * bent + rng.standard_normal(N))
    assert evidence(*records) < 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.floats(1.5, 4.5), use=st.sampled_from([0, 1]))
def test_a_phase_that_changes_within_one_record_is_seen(seed: int, turn: float, use: int) -> None:
    rng = np.random.default_rng(seed)
    steady = np.sin(2 * np.pi * T)
    records = [steady + rng.standard_normal(N) for _ in range(2)]
    records[use] += np.sin(2 * np.pi * T + turn * (T > T[N // 2])) - steady
    assert evidence(*records) > 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), seconds=st.sampled_from([1.25, 2.5, 5.0]))
def test_noise_in_a_band_is_seen_however_soon_it_loses_its_phase(seed: int, seconds: float) -> None:
    """Over 5 s nothing is left of a line whose phase is lost within 1.25 s, which makes its changes look small."""
    rng = np.random.default_rng(seed)
    length = round(seconds / DT)
    records = []
    for _ in range(2):
        share = np.repeat(rng.standard_normal((N // length, 2)), length, axis=0)
        band = share[:, 0] * np.sin(2 * np.pi * T) + share[:, 1] * np.cos(2 * np.pi * T)
        records.append(0.5 * band + rng.standard_normal(N))
    assert evidence(*records) > 0


def test_a_fit_without_its_line_has_it_in_its_innovations_and_not_among_what_is_free() -> None:
    rng = np.random.default_rng(0)
    uses = ("estimation", "validation")
    (column,) = [Column(None, {}, WAVE, *(rng.standard_normal((50, 2)) for _ in uses), kind="wave")]
    linear = Linearised(
        {use: rng.standard_normal(50) for use in uses},
        {use: rng.standard_normal((50, 4)) for use in uses},
        ("b", "line.A", "line.phi"),
        rng.standard_normal((3, 3)),
    )
    phases = {"estimation": 0.0, "validation": 0.5 * np.pi}
    left = without(linear, ("line.A", "line.phi"), column, 2.0, phases)
    assert left.names == ("b",)
    np.testing.assert_array_equal(left.spread, linear.spread[:1])
    for number, use in enumerate(uses):
        np.testing.assert_array_equal(left.nuisance[use], linear.nuisance[use][:, [0, 3]])
        added = linear.residual[use] - left.residual[use]
        np.testing.assert_allclose(added, 2.0 * getattr(column, use)[:, number])


def test_the_parts_of_a_direction_are_the_direction() -> None:
    rng = np.random.default_rng(0)
    forces = {use: [rng.standard_normal((n, 2, 2)) for n in (101, 50)] for use in ("estimation", "validation")}
    nothing = {use: [np.zeros((len(one), 1, 2)) for one in records] for use, records in forces.items()}
    parts = in_parts(Direction(None, {}, ("a", "b"), forces, nothing), 4)
    assert len(parts) == 4 * 4
    for use, records in forces.items():
        for number, whole in enumerate(records):
            each = [one.forces[use][number] for one in parts]
            np.testing.assert_array_equal(np.sum(each, axis=0), whole)
            assert sum(bool(one.any()) for one in each) == 4


TRUE = ("periodic_disturbance@theta",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "hidden"),
    [
        (Task("none", "pendulum", "bullet", (), "", "drawn", 0.02, 18, 150_000, shape="resonance"), False),
        (Task("none", "pendulum", "fmu", (), "", "drawn", 0.02, 46, 220_000, shape="drifting-sine"), False),
        (Task("confusion", "pendulum", "fmu", TRUE, "quarter", "high", 0.02, 0, 150_000), True),
    ],
)
def test_noise_in_a_band_is_no_periodic_disturbance_and_a_sine_is(task: Task, hidden: bool) -> None:
    """Under the unknown force of the last record free runs err more with the sine than without, by chance."""
    tried = [builtin()[name] for name in ("periodic_disturbance", "cogging")]
    found = diagnose(make_records(task).dataset, load_model("pendulum"), dictionary=tried)
    assert [str(one.placed) for one in found.outcome.accepted] == ["periodic_disturbance@theta"] * hidden
    assert not found.outcome.withdrawn
    reasons = [refusal.kind for one in found.outcome.rounds[0].candidates for refusal in one.refusals]
    assert (Kind.INCOHERENT in reasons) is not hidden
