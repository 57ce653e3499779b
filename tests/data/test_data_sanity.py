"""What looks wrong is noticed, and what is right is left in peace."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.data.oddities import examined, lines
from harness.data.recipe.sanity import check_run, check_runs
from harness.errors import InputError
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory, Use

N, DT = 1200, 0.01
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("theta_rate", "rad/s")), DT)
MEASURED = (("theta", 0), ("theta", 1))


def swing(seed: int = 0, *, noise: float = 1e-3, closed_loop: bool = False, smooth: bool = False) -> np.ndarray:
    """Return columns u, theta, rate of a damped pendulum-like system."""
    rng = np.random.default_rng(seed)
    x, rows = np.array([0.3, 0.0]), []
    u, filtered = 0.0, 0.0
    for k in range(N):
        if smooth:
            filtered += 0.05 * (rng.normal() - filtered)
            u = 10 * filtered
        elif k % 7 == 0:
            u = rng.choice([-1.0, 1.0])
        force = u - (8.0 * x[0] + 2.0 * x[1] if closed_loop else 0.0)
        rows.append([force, x[0] + noise * rng.normal(), x[1] + 10 * noise * rng.normal()])
        for _ in range(4):
            x = x + DT / 4 * np.array([x[1], 5 * force - 0.8 * x[1] - 20 * np.sin(x[0])])
    return np.array(rows)


def record(columns: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(columns)) * DT, columns[:, :1], columns[:, 1:], SPEC)


@given(st.integers(0, 50), st.booleans(), st.booleans(), st.sampled_from([0.0, 1e-4, 1e-2]))
def test_good_records_raise_no_suspicion(seed: int, closed_loop: bool, smooth: bool, noise: float) -> None:
    columns = swing(seed, closed_loop=closed_loop, smooth=smooth, noise=noise)
    assert check_run(record(columns), MEASURED) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c[:1], "a record of 1 row: .*at least 20 rows"),
        (lambda c: np.tile(c[3], (N, 1)), "the input and the outputs never move"),
        (lambda c: np.column_stack([c[:, 0], np.tile(c[3, 1:], (N, 1))]), "the outputs never move"),
        (lambda c: c * [1, 180 / np.pi, 1], "degrees"),
        (lambda c: c * [1, 1, 180 / np.pi], "degrees"),
        (lambda c: c * [1, 1000, 1], "1000"),
        (lambda c: c * [1, 1, 1000], "1000"),
        (lambda c: c * [1, 1, 60 / (2 * np.pi)], "rpm"),
        (lambda c: c * [1, 1, -1], "sign"),
        (lambda c: c[:, [0, 2, 1]], "swapped"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, words: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=words):
        check_run(record(change(swing())), MEASURED)


def stuck(c: np.ndarray) -> np.ndarray:
    c = c.copy()
    c[400:460, 1] = c[400, 1]
    return c


def saturated(c: np.ndarray) -> np.ndarray:
    return np.column_stack([c[:, 0], np.minimum(c[:, 1], np.quantile(c[:, 1], 0.9)), c[:, 2]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (stuck, "stands still"),
        (saturated, "largest value"),
        (lambda c: np.column_stack([np.ones(N), c[:, 1:]]), "input u is constant"),
        (lambda c: np.column_stack([c[:, :2], np.ones(N)]), "output theta_rate never moves"),
        (lambda c: c * [1, 1, 2.2], "times the measured rate"),
    ],
)
def test_what_may_be_wrong_is_said(change, words: str) -> None:  # type: ignore[no-untyped-def]
    odd = record(change(swing()))
    notes = [*check_run(odd, MEASURED), *lines(examined(Dataset("x", (Run(odd),))).oddities or ())]
    assert any(words in note for note in notes), notes


@pytest.mark.parametrize("smooth", [False, True])
def test_a_swapped_input_is_suspected(smooth: bool) -> None:
    spec = PlantSpec(SPEC.inputs, SPEC.outputs[:1], DT)
    columns = swing(smooth=smooth)
    right = Trajectory(np.arange(N) * DT, columns[:, :1], columns[:, 1:2], spec)
    wrong = Trajectory(np.arange(N) * DT, columns[:, 1:2], columns[:, :1], spec)
    assert check_run(right, MEASURED[:1]) == []
    assert any("input and output swapped" in note for note in check_run(wrong, MEASURED[:1]))


@pytest.mark.parametrize(("factor", "units"), [(1500.0, "mrad"), (60.0, "deg")])
def test_an_angle_that_turns_between_samples_is_refused_with_the_units_it_may_be_in(factor: float, units: str) -> None:
    """18 rad from sample to sample are a third of a radian in degrees: what to declare is said, and where."""
    t = np.arange(N) * 0.02
    spec = PlantSpec(SPEC.inputs, SPEC.outputs[:1], 0.02)
    y = factor * np.sin(16.0 * t)[:, None]
    with pytest.raises(InputError, match="expected an angle in rad") as refused:
        check_run(Trajectory(t, np.cos(16.0 * t)[:, None], y, spec), MEASURED[:1])
    assert f"perhaps {units} (steps up to" in str(refused.value) or f"or {units} (steps" in str(refused.value)
    assert ("deg (steps" in str(refused.value)) == (units == "deg")
    assert "unit in dataset.toml" in str(refused.value)


def test_a_rate_by_its_name_is_held_against_its_position() -> None:
    """A bare file has columns theta and theta_rate: the second is no port of its own."""
    measured = (("theta", 0), ("theta_rate", 0))
    assert check_run(record(swing()), measured) == []
    with pytest.raises(InputError, match="degrees"):
        check_run(record(swing() * [1, 1, 180 / np.pi]), measured)
    speed = PlantSpec(SPEC.inputs, (SPEC.outputs[0], Channel("theta_rate", "1")), DT)  # something else of that name
    other = Trajectory(np.arange(N) * DT, swing()[:, :1], swing()[:, 1:] * [1, 180 / np.pi], speed)
    assert check_run(other, measured) == []


def test_a_torque_that_follows_a_rate_is_not_swapped_with_it() -> None:
    """Feedback on a rate that noise hides one sample ahead: the rate is the derivative of its position all the same."""
    rng, x, rows = np.random.default_rng(1), np.zeros(2), []
    for _ in range(N):
        read = x + [1e-4, 1e-2] * rng.normal(size=2)
        u = -1.0 * read[1] + 0.05 * rng.normal()
        rows.append([u, *read])
        for _ in range(4):
            x = x + DT / 4 * np.array([x[1], 0.3 * u + 8.0 * np.sin(0.02 * len(rows)) - 20 * x[0] - x[1]])
    columns = np.array(rows)
    columns[1:, 0] = columns[:-1, 0]  # recorded a sample late, as followers are
    alone = PlantSpec(SPEC.inputs, SPEC.outputs[1:], DT)
    t = np.arange(N) * DT
    assert any(
        "swapped" in one for one in check_run(Trajectory(t, columns[:, :1], columns[:, 2:], alone), MEASURED[1:])
    )
    assert check_run(record(columns), MEASURED) == []


def runs(*records: tuple[np.ndarray, Use]) -> list[Run]:
    return [Run(record(columns), use) for columns, use in records]


def test_runs_beside_each_other() -> None:
    a, b = swing(0), swing(1)
    assert check_runs(runs((a, "estimation"), (b, "validation"))) == []
    with pytest.raises(InputError, match=r"the validation data are the estimation data"):
        check_runs(runs((a, "estimation"), (a, "validation")))
    with pytest.raises(InputError, match=r"the test data are the validation data"):
        check_runs(runs((a, "estimation"), (b, "validation"), (b, "test")))
    for factor, words in ((1000.0, "wrong by 1000"), (180 / np.pi, "degrees")):
        notes = check_runs(runs((a, "estimation"), (b * [1, factor, factor], "validation")))
        assert any(words in note and "theta" in note for note in notes)
    big = a * [100, 1, 1], b * [100, 1, 1]
    notes = check_runs(runs((big[0], "estimation"), (big[1][:, [1, 0, 2]], "validation")))
    assert any("columns swapped" in note for note in notes)


def test_pieces_of_one_record_share_their_units_however_little_one_moves() -> None:
    a, b = swing(0), swing(1)
    pieces = runs((a, "estimation"), (b * [1, 1e-3, 1e-3], "estimation"))
    assert check_runs(pieces, [0, 0]) == []
    assert any("wrong by 1000" in note for note in check_runs(pieces))


@pytest.mark.parametrize(("factor", "said"), [(20000.0, True), (1.0, False)])
def test_counts_of_a_converter_under_a_physical_unit_are_said(factor: float, said: bool) -> None:
    columns = swing()
    columns[:, 0] = np.round(factor * columns[:, 0])
    notes = [note for note in check_run(record(columns), MEASURED) if "read as N m: if a converter counted" in note]
    assert bool(notes) == said
