"""Records cut from a running plant with a dead time, and readings that are missing, under a linear nominal model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete

import harness
from harness.diagnosis.close import close_loop
from harness.diagnosis.records.starts import dead_times, with_known_starts
from harness.physics import load_model
from harness.signals import Channel, Dataset, FloatArray, PlantSpec, Run, Trajectory

SPEC = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)


def plant(dead: int, seed: int, *, pole: float = 0.9, hold: int = 5, cut: int = 300, samples: int = 1500) -> Trajectory:
    """Return readings of a lag with a dead time, the rows before ``cut`` left out."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], size=(cut + samples) // hold + 1), hold)[: cut + samples]
    y = np.zeros(cut + samples)
    for k in range(1, len(y)):
        y[k] = pole * y[k - 1] + 2.0 * (1.0 - pole) * (u[k - 1 - dead] if k > dead else 0.0)
    y += 0.02 * rng.standard_normal(len(y))
    return Trajectory(np.arange(samples, dtype=float), u[cut:, None], y[cut:, None], SPEC)


def pair(dead: int, *, cut: int = 300) -> Dataset:
    """Return an estimation and a validation record."""
    return Dataset("cut", (Run(plant(dead, 1, cut=cut)), Run(plant(dead, 2, cut=cut), "validation")))


@settings(max_examples=25, deadline=None)
@given(dead=st.integers(0, 40), pole=st.floats(0.5, 0.97), hold=st.integers(1, 8), seed=st.integers(0, 10_000))
def test_the_dead_time_is_that_of_the_plant(dead: int, pole: float, hold: int, seed: int) -> None:
    (found,) = dead_times([plant(dead, seed, pole=pole, hold=hold)])
    assert found == (dead + 1 if dead else 1) or (found == 1 and dead < 4)  # a short one may hide in a slow lag


@settings(max_examples=25, deadline=None)
@given(hold=st.integers(5, 60), direct=st.floats(0.2, 3.0), seed=st.integers(0, 10_000))
def test_an_input_that_acts_at_once_in_even_steps_has_no_dead_time(hold: int, direct: float, seed: int) -> None:
    """A step says that the next one comes ``hold`` rows later, and what it comes from."""
    rng, n = np.random.default_rng(seed), 3000
    u, slow = np.repeat(rng.uniform(-1.0, 2.0, n // hold + 1), hold)[:n], np.zeros(n)
    for k in range(1, n):
        slow[k] = 0.97 * slow[k - 1] + 0.03 * u[k - 1]
    y = slow + direct * u + 0.01 * rng.standard_normal(n)
    assert max(dead_times([Trajectory(np.arange(n, dtype=float), u[:, None], y[:, None], SPEC)])) < 2


@settings(max_examples=25, deadline=None)
@given(stiffness=st.floats(3e3, 3e4), load=st.floats(0.3, 1.5), seed=st.integers(0, 10_000))
def test_a_resonance_is_no_dead_time(stiffness: float, load: float, seed: int) -> None:
    """A few lags follow a mass and its load badly through noise, and inputs of a period ago help them."""
    rng, dt = np.random.default_rng(seed), 0.002
    t = np.arange(4000) * dt
    lines = zip(np.geomspace(0.4, 40.0, 14), rng.uniform(0.0, 2.0 * np.pi, 14), strict=True)
    u = 5.0 * sum((np.sin(2.0 * np.pi * f * t + phase) for f, phase in lines), np.zeros(len(t)))
    a = np.array([[0, 1, 0, 0], [-stiffness, -14, stiffness, 6], [0, 0, 0, 1], [stiffness, 6, -stiffness, -6]])
    a = a / np.array([[1.0], [0.5], [1.0], [load]])
    (ad, bd, *_) = cont2discrete((a, np.array([[0], [2.0], [0], [0]]), np.eye(4), np.zeros((4, 1))), dt)
    x = np.zeros((len(t), 4))
    for k in range(1, len(t)):
        x[k] = ad @ x[k - 1] + bd[:, 0] * u[k - 1]
    y = x[:, :1] + 1e-5 * rng.standard_normal((len(t), 1))
    assert dead_times([Trajectory(np.arange(len(t), dtype=float), u[:, None], y, SPEC)]) == (1,)


def test_only_what_inputs_before_the_record_decide_is_left_out() -> None:
    cut = with_known_starts(pair(10))
    for run in cut:
        missing = run.trajectory.missing
        assert missing is not None
        assert missing[:11].all()
        assert not missing[11:].any()
    assert "dead time of about 11 samples" in cut.warnings[-1]
    at_once = pair(0)
    assert with_known_starts(at_once) is at_once


@pytest.mark.slow
@pytest.mark.parametrize(("dead", "cut"), [(10, 300), (20, 0)])
def test_the_dead_time_alone_is_found(dead: int, cut: int, tmp_path: Path) -> None:
    report = close_loop(pair(dead, cut=cut), load_model("linear", order=1), out=tmp_path / "out")
    assert [effect["name"] for effect in report.data["effects"]] == ["input_delay"]
    tau = report.data["parameters"]["after"]["input_delay@u.tau"]
    assert tau["low"] < dead < tau["high"]
    assert report.data["stand_in"] is None or not report.data["stand_in"]["flagged"]


def test_missing_readings_end_no_linear_loop(tmp_path: Path) -> None:
    records: list[FloatArray] = []
    for role, seed in (("estimation", 1), ("validation", 2)):
        record = plant(0, seed, cut=0)
        y = record.y[:, 0].copy()
        y[[200, 700, 701]] = 50.0  # spikes: they count as missing
        records.append(y)
        rows = np.column_stack([record.t, record.u[:, 0], y])
        np.savetxt(tmp_path / f"{role}.csv", rows, delimiter=",", header="time [s],u [1],y [1]", comments="")
    report = harness.close_loop(
        tmp_path / "estimation.csv", model="linear", validation=tmp_path / "validation.csv", input="u", output="y",
        out=tmp_path / "out",
    )  # fmt: skip
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    assert report.data["verdict"] == "nothing_missing"
