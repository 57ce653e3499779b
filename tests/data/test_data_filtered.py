"""Readings that were filtered before they were written: told by what the filter takes away, and counted once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.signal import butter, lfilter

import harness
from harness.data.oddities import DataCheck, examined
from harness.data.oddities.filtered import filter_of
from harness.diagnosis.records.thinning import thinned_dataset
from harness.physics.models import pendulum
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

DT, N, NOISE = 0.01, 1000, 1e-3
VALUES = {"J": 0.06, "b": 0.04, "mgl": 0.9}


def swing(seed: int, n: int = N) -> tuple[FloatArray, FloatArray]:
    """Return the torque and the readings of a pendulum."""
    rng, t = np.random.default_rng(seed), np.arange(n) * DT
    tones = 2 * np.pi * np.geomspace(0.1, 3.0, 15)
    u = 0.09 * np.sin(np.outer(t, tones) + rng.uniform(0, 6.3, 15)).sum(axis=1)
    system = pendulum().system()
    y = system.simulator(DT).rollout(system.vector(VALUES), [0.0, 0.0], u[:, None])[:, 0]
    return u, np.asarray(y + NOISE * rng.standard_normal(n))


def mean(y: FloatArray, rows: int) -> FloatArray:
    """Return the mean of every reading and those before it."""
    return np.convolve(np.pad(y, (rows - 1, 0), mode="edge"), np.full(rows, 1.0 / rows), "valid")


@pytest.mark.parametrize("rows", range(3, 9))
def test_a_mean_over_some_rows_is_told_by_a_null_of_its_own(rows: int) -> None:
    told = 0
    for seed in range(40):
        u, y = swing(seed)
        found = filter_of(mean(y, rows), u[:, None])
        if found is not None:
            told += 1
            assert abs(found.null * rows - round(found.null * rows)) < 0.1
            assert found.mean
    assert told >= 30


@pytest.mark.parametrize("order", range(2, 5))
def test_a_digital_low_pass_is_told(order: int) -> None:
    told = 0
    for seed, edge in enumerate(np.linspace(0.1, 0.7, 40)):
        u, y = swing(seed)
        found = filter_of(lfilter(*butter(order, edge), y), u[:, None])
        told += found is not None and not found.mean and 2 <= found.every <= 7
    assert told >= 30


@given(
    seed=st.integers(0, 10_000),
    hold=st.integers(1, 40),
    noise=st.sampled_from([0.0, 1e-4, 0.1]),
    n=st.integers(300, 1500),
)
@settings(max_examples=40, deadline=None)
def test_what_was_sampled_has_no_null_but_those_of_its_inputs(seed: int, hold: int, noise: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(n // hold + 1), hold)[:n]
    y = np.zeros(n)
    for k in range(2, n):
        y[k] = 1.7 * y[k - 1] - 0.75 * y[k - 2] + u[k - 1] + 0.4 * u[k - 2]
    assert filter_of(y + noise * y.std() * rng.standard_normal(n), u[:, None]) is None
    assume(noise > 0.0)
    assert filter_of(rng.standard_normal(n), np.zeros((n, 0))) is None


@pytest.mark.parametrize("seed", range(6))
def test_a_thermometer_of_coarse_steps_has_no_filter(seed: int) -> None:
    """It is refreshed every twelve rows and mostly reads the same: rectangles, whose spectra have nulls."""
    warmth = np.where(np.random.default_rng(seed).random(100) < 0.2, 26.1, 26.0).repeat(12)
    assert filter_of(warmth, np.zeros((len(warmth), 0))) is None


def test_a_record_of_a_slower_sensor_is_not_thinned() -> None:
    """Every third reading counts: every second row would keep one in six."""
    u, y = swing(1, 6000)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT / 10)
    t, missing = np.arange(6000) * DT / 10, (np.arange(6000) % 3 > 0)[:, None]
    whole, third = (
        Dataset("x", (Run(Trajectory(t, u[:, None], y[:, None], spec, missing=rows)),)) for rows in (None, missing)
    )
    assert thinned_dataset(whole).factor == 2
    assert thinned_dataset(third).factor == 1


@pytest.mark.parametrize("kind", ["mean", "low-pass"])
def test_the_loop_names_the_filter_and_keeps_the_parameters(kind: str, tmp_path: Path) -> None:
    for use, seed in (("estimation", 11), ("validation", 12)):
        u, y = swing(seed)
        y = mean(y, 6) if kind == "mean" else lfilter(*butter(2, 0.12), y)
        rows = np.column_stack([np.arange(N) * DT, u, y])
        np.savetxt(tmp_path / f"{use}.csv", rows, delimiter=",", header="time [s],u [N m],theta [rad]", comments="")
    report = harness.close_loop(
        tmp_path / "estimation.csv", validation=tmp_path / "validation.csv", model="pendulum",
        dictionary="sensor_filter?; sensor_lag?; sensor_delay?; elastic_load?; coulomb_friction?; actuator_lag?",
    ).data  # fmt: skip
    assert [effect["name"] for effect in report["effects"]] == ["sensor_filter"]
    assert {odd["kind"] for odd in report["oddities"]} == {"filtered"}
    for name, true in VALUES.items():
        value = report["parameters"]["after"][name]
        assert abs(value["value"] - true) < 0.75 * (value["high"] - value["low"])


def test_a_page_marks_no_rows_of_a_signal_that_is_odd_throughout() -> None:
    u, y = swing(3)
    late, spec = mean(y, 6), PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
    late[500] += 1.0
    records = [Trajectory(np.arange(N) * DT, u[:, None], z[:, None], spec) for z in (mean(y, 6), late)]
    check = DataCheck(examined(Dataset("made", (Run(records[0], "estimation"), Run(records[1], "validation")))))
    kinds = [{odd.kind for odd in check.oddities if odd.run == run} for run in (0, 1)]
    assert kinds == [{"filtered"}, {"spike"}]
    page = check.html()
    assert page.count("<svg") == 1
    assert "run 1: theta [rad], 1 odd row" in page
    assert "reported" in page
