"""Records refuse what does not fit, and nobody can change a record that others share."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.errors import FitError, InputError, PlantError
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory, residual

SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("omega", "rad/s")), 0.1)


def record(n: int = 5, **changes: np.ndarray) -> Trajectory:
    parts = {"t": np.arange(n) * 0.1, "u": np.ones((n, 1)), "y": np.zeros((n, 2))} | changes
    return Trajectory(parts["t"], parts["u"], parts["y"], SPEC)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"u": np.zeros(5)}, ["shape of u", "(5, 1)", "(5,)", "first axis"]),
        ({"u": np.zeros((5, 2))}, ["shape of u", "(5, 1)", "(5, 2)"]),
        ({"y": np.zeros((2, 5))}, ["shape of y", "(5, 2)", "(2, 5)"]),
        ({"y": np.array([[0, 0]] * 4 + [[0, np.nan]])}, ["y[4, 1]", "finite", "nan"]),
        ({"u": np.array([[0.0]] * 4 + [[np.inf]])}, ["u[4, 0]", "inf"]),
        ({"t": np.array([0, 0.1, 0.2, 0.35, 0.4])}, ["t[3]", "0.3 s", "0.35 s", "resample"]),
    ],
)
def test_a_record_that_does_not_fit_is_refused_in_words(changes: dict[str, np.ndarray], words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        record(**changes)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_record_is_refused() -> None:
    with pytest.raises(InputError, match="empty record"):
        record(0)


def test_a_record_is_a_read_only_copy() -> None:
    source = np.zeros((5, 2))
    kept = record(y=source)
    source[0] = 9.0
    assert kept.y[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        kept.y[0] = 1.0


def test_accumulated_time_is_uniform_enough_over_a_long_record() -> None:
    n = 200_000
    spec = PlantSpec((), (Channel("q"),), 0.001)
    t = np.arange(n) * 0.001
    assert len(Trajectory(t, np.zeros((n, 0)), np.zeros((n, 1)), spec)) == n
    with pytest.raises(InputError, match="not uniform"):
        Trajectory(t * 1.0001, np.zeros((n, 0)), np.zeros((n, 1)), spec)


def test_measured_hides_the_truth_and_slices_keep_time() -> None:
    full = Trajectory(np.arange(4) * 0.1, np.zeros((4, 1)), np.zeros((4, 2)), SPEC, x=np.ones((4, 3)))
    assert full.measured().x is None
    part = full[1:3]
    assert part.t.tolist() == pytest.approx([0.1, 0.2])
    assert part.x is not None
    assert part.x.shape == (2, 3)
    with pytest.raises(InputError, match="step 1"):
        full[::2]


@given(
    a=st.floats(-1e3, 1e3),
    b=st.floats(-1e3, 1e3),
    period=st.floats(0.1, 10.0),
)
def test_a_periodic_residual_is_the_shortest_way_round(a: float, b: float, period: float) -> None:
    channels = [Channel("angle", "rad", period=period), Channel("x", "m")]
    got = residual(channels, np.array([a, a]), np.array([b, b]))
    assert -period / 2 - 1e-9 <= got[0] <= period / 2 + 1e-9
    turns = (a - b - got[0]) / period
    assert turns == pytest.approx(round(turns), abs=1e-6)
    assert got[1] == a - b


def test_a_data_set_holds_runs_of_one_plant() -> None:
    other = Trajectory(np.arange(3.0), np.zeros((3, 0)), np.zeros((3, 1)), PlantSpec((), (Channel("q"),), 1.0))
    with pytest.raises(InputError, match="another language"):
        Dataset("mixed", (Run(record()), Run(other)))
    with pytest.raises(InputError, match="without runs"):
        Dataset("none", ())


@pytest.mark.parametrize(
    "make",
    [
        lambda: Channel(" "),
        lambda: Channel("u", minimum=1.0, maximum=0.0),
        lambda: Channel("theta", period=0.0),
        lambda: Channel("s", kind="category"),
        lambda: Channel("u").categories,
        lambda: PlantSpec((Channel("u"), Channel("u")), (Channel("y"),), 1.0),
        lambda: PlantSpec((), (), 1.0),
        lambda: PlantSpec((), (Channel("y"),), 0.0),
        lambda: PlantSpec((), (Channel("y"),), float("nan")),
    ],
)
def test_specs_that_mean_nothing_are_refused(make: object) -> None:
    with pytest.raises(InputError):
        make()  # type: ignore[operator]


def test_errors_travel_between_processes() -> None:
    one = FitError("too short", expected="10 samples", got="3", remedy="record more", file="a.csv", place="row 3")
    again = pickle.loads(pickle.dumps(one))
    assert type(again) is FitError
    assert str(again) == str(one)
    assert again.place == "row 3"
    plant = pickle.loads(pickle.dumps(PlantError("gone", status="timeout")))
    assert (str(plant), plant.status) == ("gone", "timeout")
    assert one.located(file="b.csv").file == "a.csv"
    assert InputError("w", expected="e", got="g", remedy="r").located(place="p").place == "p"


def test_complex_numbers_are_refused_and_not_cut() -> None:
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    t, column = np.arange(3.0), np.ones((3, 1))
    with pytest.raises(InputError, match=r"numbers of u: expected real numbers, got complex"):
        Trajectory(t, column * 1j, column, spec)
    with pytest.raises(InputError, match=r"numbers of y"):
        Trajectory(t, column, column + 0j, spec)
