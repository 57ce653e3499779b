"""Where records determine a linear model, and where its order alone speaks."""

import numpy as np
import pytest

from harness import registry
from harness.models.determined import bands_of, determined_bands, outside
from harness.signals import Channel, PlantSpec, Trajectory

SPEC = PlantSpec((Channel("u", "V"),), (Channel("y", "m"),), 0.05)
A, B = 0.9, 0.5


def answered(u, size=0.02, seed=1):
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = A * y[k] + B * u[k]
    noise = size * np.random.default_rng(seed).normal(size=len(u))
    return Trajectory(0.05 * np.arange(len(u)), u[:, None], (y + noise)[:, None], SPEC)


@pytest.mark.parametrize(
    "identifier", ["n4sid", "ho-kalman", "prediction-error", "arx", "dmdc", "least-squares", "edmdc"]
)
def test_every_linear_model_carries_its_frequencies(identifier):
    u = np.random.default_rng(0).normal(size=1500)
    model = registry.create("identifiers", identifier).fit([answered(u, 1e-3)], rng=np.random.default_rng(0))
    bands = bands_of(model)["y per u"]
    assert not outside(bands, np.array([0.1, 1.0, 5.0])).any()


def test_two_lines_determine_their_neighbourhood_alone():
    t = 0.05 * np.arange(4000)
    data = answered(np.sin(2 * np.pi * 0.5 * t) + np.sin(2 * np.pi * 3.0 * t))
    truth = tuple(np.full((1, 1), value) for value in (A, B, 1.0, 0.0))
    bands = determined_bands(truth, [data])["y per u"]
    assert outside(bands, np.array([0.5, 1.3, 3.0, 8.0])).tolist() == [False, True, False, True]


def test_a_model_that_the_data_contradict_is_not_determined():
    data = answered(np.random.default_rng(0).normal(size=3000))
    wrong = tuple(np.full((1, 1), value) for value in (A, -B, 1.0, 0.0))
    assert determined_bands(wrong, [data])["y per u"] == []


def test_lines_of_a_short_record_do_not_fill_what_lies_between_them():
    k = np.arange(1000)
    data = answered(np.sin(2 * np.pi * 0.0113 * k) + np.sin(2 * np.pi * 0.1637 * k), 1e-3)
    truth = tuple(np.full((1, 1), value) for value in (A, B, 1.0, 0.0))
    bands = determined_bands(truth, [data])["y per u"]
    assert outside(bands, np.array([0.0113, 0.06, 0.1637, 0.3]) / 0.05).tolist() == [False, True, False, True]


def test_a_model_whose_phase_the_data_contradict_is_not_determined_there():
    data = answered(np.random.default_rng(0).normal(size=3000))
    late = (np.array([[A, B], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    bands = determined_bands(late, [data])["y per u"]  # one sample later than the truth
    assert outside(bands, np.array([0.5, 2.8])).tolist() == [False, True]


@pytest.mark.parametrize("rich", [False, True])
def test_the_command_says_where_alone_the_records_speak(rich, tmp_path, sysid):
    k = np.arange(1000)
    lines = np.sin(2 * np.pi * 0.0113 * k) + np.sin(2 * np.pi * 0.1637 * k)
    data = answered(np.random.default_rng(0).normal(size=1000) if rich else lines, 1e-3)
    table = np.column_stack([data.t, data.u, data.y])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="t,u,y", comments="")
    said = sysid("identify", tmp_path / "run.csv", "--input", "u", "--output", "y", "--identifier", "arx").out
    assert ("elsewhere only its order does" in said) != rich
