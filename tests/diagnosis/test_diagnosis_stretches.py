"""Long records: what the search sees of them; and windows."""

from __future__ import annotations

import numpy as np

from harness.diagnosis.records.stretches import cut_alike, stretched, windowed
from harness.physics.models import pendulum
from harness.rng import stream
from harness.signals import Dataset, Run, Trajectory


def _record(samples: int, seed: int) -> Trajectory:
    system = pendulum().system()
    simulator = system.simulator(0.02)
    rng = stream("test-stretches", seed)
    u = np.repeat(rng.standard_normal((samples // 10 + 1, 1)), 10, axis=0)[:samples]
    y = simulator.rollout([0.1, 0.05, 1.0], [0.3, 0.0], u) + 1e-3 * rng.standard_normal((samples, 1))
    return Trajectory(np.arange(samples) * 0.02, u, y, simulator.spec)


def test_short_records_stay_as_they_are() -> None:
    data = Dataset("x", (Run(_record(200, 0)), Run(_record(100, 1), "validation")))
    assert stretched(data, long=200, length=20) is data


def test_stretches_are_consecutive_rows_of_every_record_and_the_cut_is_said() -> None:
    records = [_record(300, 0), _record(100, 1)]
    data = Dataset("x", (Run(records[0]), Run(_record(120, 2), "validation"), Run(records[1]), Run(records[1], "test")))
    short = stretched(data, long=350, length=30, count=4)
    assert [len(one) for one in short.estimation] == [30, 30, 30, 30]
    assert len(short.validation[0]) == 120
    assert len(short.test[0]) == 100
    for one in short.estimation[:3]:
        first = round(float(one.t[0]) / 0.02)
        assert np.array_equal(one.y, records[0].y[first : first + 30])
    assert short.estimation[0].t[0] < 1.5 < short.estimation[2].t[0]
    assert "400 estimation samples" in short.warnings[-1]
    assert "120 samples" in short.warnings[-1]


def test_signals_from_outside_a_loop_are_cut_as_their_runs_are() -> None:
    records = [_record(300, 0), _record(100, 1)]
    data = Dataset("x", (Run(records[0]), Run(_record(120, 2), "validation"), Run(records[1]), Run(records[1], "test")))
    short = stretched(data, long=350, length=30, count=4)
    clock = [{"r [N m]": np.array(run.trajectory.t)} for run in data]  # a signal that says where it comes from
    cut = cut_alike(clock, data, short)
    assert len(cut) == len(short.runs) == 6
    for one, run in zip(cut, short, strict=True):
        assert np.array_equal(one["r [N m]"], run.trajectory.t)
    assert cut_alike([], data, short) == []
    other = Dataset("x", tuple(Run(_record(len(run.trajectory), 9), run.use) for run in data))
    assert cut_alike(clock, other, short) is clock  # stretches of something else


def test_windows_are_records_of_their_own_and_lose_no_row() -> None:
    whole = Dataset("x", (Run(_record(1050, 0)), Run(_record(100, 1), "validation")))
    cut = windowed(whole, 100 * whole.spec.sample_time)
    assert [len(one) for one in cut.estimation] == [100] * 9 + [150]
    np.testing.assert_array_equal(np.concatenate([one.y for one in cut.estimation]), whole.estimation[0].y)
    assert [one.t[0] for one in cut.estimation][1] == whole.estimation[0].t[100]
    assert windowed(whole, None) is whole
