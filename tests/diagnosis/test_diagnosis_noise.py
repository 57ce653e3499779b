"""The noise floor: right where it is claimed, null where it cannot be known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from harness.diagnosis import black_box, noise
from harness.diagnosis.black_box import fit_black_box, one_step_error
from harness.signals import Channel, Dataset, PlantSpec, Run, Trajectory


def record(u: np.ndarray, y: np.ndarray, dt: float = 0.01) -> Trajectory:
    spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), dt)
    return Trajectory(np.arange(len(y)) * dt, u.reshape(-1, 1), y.reshape(-1, 1), spec)


def dataset(*runs: Trajectory, declared: dict[str, float] | None = None) -> Dataset:
    uses = ("estimation", "validation")
    return Dataset("made", tuple(Run(r, use) for r, use in zip(runs, uses, strict=True)), noise=declared or {})


def smooth(n: int, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(lfilter([1e-4], np.poly([0.99, 0.98, 0.97, 0.95]), rng.standard_normal(n + 1000))[1000:])


def test_white_sensor_on_an_oversampled_signal_is_read_off_the_fourth_difference() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        runs = []
        for _ in range(2):
            y = smooth(4000, rng)
            runs.append(record(rng.standard_normal(4000), y + 0.02 * y.std() * rng.standard_normal(4000)))
        floor = noise.noise_floors(dataset(*runs))[0]
        assert floor.source == "fourth_difference"
        assert floor.value == pytest.approx(0.02 * y.std(), rel=0.4)


def test_a_fast_signal_or_a_coloured_sensor_refuses_the_fourth_difference() -> None:
    rng = np.random.default_rng(0)
    fast = lfilter([1.0], [1.0, -0.5], rng.standard_normal(4000))
    assert not noise.top_octave(np.asarray(fast)).flat
    line = smooth(4000, rng) + 0.01 * np.sin(2.6 * np.arange(4000)) + 0.001 * rng.standard_normal(4000)
    assert not noise.top_octave(line).flat


def test_declared_noise_comes_first() -> None:
    rng = np.random.default_rng(1)
    r = record(rng.standard_normal(500), smooth(500, rng) + 1e-3 * rng.standard_normal(500))
    floor = noise.noise_floors(dataset(r, r, declared={"q": 0.5}))[0]
    assert (floor.value, floor.source) == (0.5, "declared")


def test_repeated_periods_give_the_noise_once_the_transient_has_died() -> None:
    rng = np.random.default_rng(2)
    u = np.tile(rng.standard_normal(500), 6)
    clean = np.asarray(lfilter([0.5], [1.0, -0.8], u))
    y = clean + 0.3 * rng.standard_normal(u.size)
    assert noise.period_of(u.reshape(-1, 1)) == 500
    assert noise.repeated_periods(u.reshape(-1, 1), y) == pytest.approx(0.3, rel=0.1)
    growing = np.exp(np.arange(u.size) / 300.0)
    assert noise.repeated_periods(u.reshape(-1, 1), growing) is None
    assert noise.period_of(np.zeros((100, 1))) is None


def test_black_box_reaches_the_noise_of_a_linear_system_and_is_not_believed_elsewhere() -> None:
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(2):
        u = rng.standard_normal(3000)
        y = np.asarray(lfilter([0.0, 1.0, 0.5], [1.0, -1.2, 0.5], u))
        runs.append(record(u, y + 0.05 * y.std() * rng.standard_normal(3000)))
    box = fit_black_box(dataset(*runs))
    assert box.validated
    assert box.free_run[0] == pytest.approx(0.05 * y.std(), rel=0.25)
    floor = noise.noise_floors(dataset(*runs))[0]
    assert floor.source == "black_box"


def overlapping(rng: np.random.Generator, n: int = 3000, more: int = 400) -> np.ndarray:
    """Return realisations of a waveform, each running on over its own beginning."""
    waves = [np.asarray(lfilter([1.0], [1.0, -0.5], rng.standard_normal(n))) for _ in range(3)]
    return np.concatenate([np.concatenate([one, one[:more]]) for one in waves])


def test_an_input_that_comes_back_after_another_motion_shows_the_noise() -> None:
    rng = np.random.default_rng(4)
    u = overlapping(rng)
    clean = np.asarray(lfilter([0.1], np.poly([0.95 + 0.2j, 0.95 - 0.2j]), u)).real
    y = clean + 0.03 * clean.std() * np.asarray(lfilter([0.8], [1.0, -0.6], rng.standard_normal(u.size)))
    measured = u + 0.02 * u.std() * rng.standard_normal(u.size)  # a measured input never repeats exactly
    assert noise.period_of(u[:, None]) is None
    assert noise.repeated_stretches(measured[:, None], y) == pytest.approx(0.03 * clean.std(), rel=0.25)
    floor = noise.noise_floors(dataset(record(measured, y), record(measured, y)))[0]
    assert (floor.source, "come back" in floor.note) == ("repeated_periods", True)


def test_what_repeats_from_its_beginning_or_never_settles_shows_no_noise() -> None:
    rng = np.random.default_rng(5)
    u = overlapping(rng)
    y = np.asarray(lfilter([0.1], [1.0, -0.9], u))
    same = y + 0.02 * np.sin(np.arange(u.size))  # a loop makes its motion, and so its force, repeat: no transient
    for first in (0, 3400, 6800):
        same[first + 3000 : first + 3400] = same[first : first + 400]
    same += 0.001 * rng.standard_normal(u.size)
    assert noise.repeated_stretches(u[:, None], same) is None
    assert noise.repeated_stretches(u[:, None], np.cumsum(u)) is None
    assert noise.repeated_stretches(rng.standard_normal((3000, 1)), rng.standard_normal(3000)) is None
    assert noise.repeated_stretches(np.zeros((3000, 1)), rng.standard_normal(3000)) is None


def test_a_black_box_whose_free_run_is_far_from_its_one_step_error_is_no_floor() -> None:
    rng = np.random.default_rng(6)
    runs = []
    for _ in range(2):
        u = rng.standard_normal(4000)
        force = np.asarray(lfilter([0.3], [1.0, -0.7], u)) + 0.5 * rng.standard_normal(4000)
        runs.append(record(u, np.asarray(lfilter([1.0], [1.0, -1.9, 0.92], force))))
    box = fit_black_box(dataset(*runs))
    assert box.validated
    assert box.free_run[0] > noise.PREDICTED * box.innovations[0]
    floor = noise.noise_floors(dataset(*runs))[0]
    assert (floor.value, floor.source) == (None, None)
    assert "not only noise" in floor.note


def test_a_black_box_with_a_coloured_error_is_not_run_freely(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    u = [rng.standard_normal(800) for _ in "ab"]
    runs = [record(one, np.asarray(lfilter([1.0], [1.0, -0.9], one))) for one in u]
    monkeypatch.setattr(black_box, "max_autocorrelation", lambda x: 0.9)
    monkeypatch.setattr(black_box, "_free_run", lambda *_: pytest.fail("its free run costs more than all the rest"))
    box = fit_black_box(dataset(*runs))
    assert not box.validated
    assert box.free_run == (None,)


def test_quantisation_bounds_the_floor_from_below() -> None:
    y = np.round(np.sin(np.arange(5000) * 0.001) * 50) / 50
    assert noise.fourth_difference(y) == pytest.approx(0.02 / np.sqrt(12), rel=0.01)


def test_recordings_refuse_the_fourth_difference(recordings_folder) -> None:  # type: ignore[no-untyped-def]
    from scipy.io import loadmat

    silverbox = loadmat(recordings_folder / "silverbox" / "SNLS80mV.mat")["V2"].ravel()[40650:105712]
    assert noise.fourth_difference(silverbox) == pytest.approx(2.35e-3, rel=0.05)
    assert not noise.top_octave(silverbox).flat
    emps = loadmat(recordings_folder / "emps" / "DATA_EMPS.mat")["qm"].ravel()
    assert noise.fourth_difference(emps) == pytest.approx(27e-9, rel=0.05)
    assert not noise.top_octave(emps).flat
    dryer = np.loadtxt(recordings_folder / "hair_dryer" / "dryer.dat")[:, 1]
    assert noise.fourth_difference(dryer) == pytest.approx(0.025, rel=0.06)
    assert not noise.top_octave(dryer).flat


def test_the_one_step_error_is_the_innovation_and_the_fourth_difference_must_come_near_it() -> None:
    rng = np.random.default_rng(7)
    runs = [
        record(np.zeros(3000), np.asarray(lfilter([1.0], [1.0, -1.6, 0.7], rng.standard_normal(3000)))) for _ in "ab"
    ]
    assert one_step_error(dataset(*runs))[0] == pytest.approx(1.0, rel=0.05)
    short = [record(np.zeros(9), rng.standard_normal(9)) for _ in "ab"]
    assert one_step_error(dataset(*short))[0] == np.inf


def test_a_plant_disturbed_beyond_its_white_sensor_has_another_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(2):
        y = smooth(4000, rng)
        runs.append(record(rng.standard_normal(4000), y + 0.02 * y.std() * rng.standard_normal(4000)))
    white = noise.noise_floors(dataset(*runs))[0]
    assert white.source == "fourth_difference"
    assert white.value is not None
    assert one_step_error(dataset(*runs))[0] < 0.8 * noise.PREDICTED * white.value
    monkeypatch.setattr(noise, "one_step_error", lambda data: np.array([3.0 * white.value]))
    floor = noise.noise_floors(dataset(*runs))[0]
    assert floor.source != "fourth_difference"
    assert "one sample ahead" in floor.note
