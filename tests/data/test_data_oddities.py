"""What is odd about records: named, left out of the fits, and never seen in clean ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import api
from harness.data.oddities import examined
from harness.diagnosis import close_loop
from harness.diagnosis.records.inputs_check import inputs_checked
from harness.diagnosis.records.stretches import parted
from harness.physics.compiled.kalman_pass import KalmanPass, PassNoise
from harness.physics.compiled.latent import with_latent_forces
from harness.physics.fitting.likelihood_fit import fit_likelihood
from harness.physics.models import pendulum
from harness.signals import Channel, Dataset, FloatArray, Oddity, PlantSpec, Run, Trajectory

DT, N = 0.01, 1200
SPEC = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), DT)
TRUE = {"J": 0.05, "b": 0.02, "mgl": 1.0}


def multisine(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    f = np.linspace(0.1, 3.0, 15)
    return np.asarray(0.18 * np.sin(2 * np.pi * np.outer(np.arange(N) * DT, f) + rng.uniform(0, 6.3, 15)).sum(axis=1))


SIMULATOR = pendulum().system().simulator(DT)


def swing(u: FloatArray, seed: int = 0, noise: float = 1e-3) -> FloatArray:
    system = pendulum().system()
    y = SIMULATOR.rollout(system.vector(TRUE), [0.0, 0.0], u[:, None])[:, 0]
    return np.asarray(y + noise * np.random.default_rng(seed).standard_normal(N))


def found(u: FloatArray, y: FloatArray) -> tuple[Trajectory, list[Oddity]]:
    record = Trajectory(np.arange(len(y)) * DT, u[:, None], y[:, None], SPEC)
    dataset = examined(Dataset("x", (Run(record),)))
    return dataset.runs[0].trajectory, [odd for odd in dataset.oddities or () if odd.fault]


@pytest.fixture(scope="module")
def clean() -> tuple[FloatArray, FloatArray]:
    u = multisine(1)
    return u, swing(u)


@pytest.mark.parametrize(("shaking", "said"), [(0.02, False), (2.0, True)])
def test_a_speed_that_rises_moves_as_slowly_as_it_rises(shaking: float, said: bool) -> None:
    t, rng = np.arange(N) * DT, np.random.default_rng(4)
    shakes = np.sin(2 * np.pi * 46.0 * t + np.cumsum(0.3 * rng.standard_normal(N)))  # of 50 Hz at most
    record = Trajectory(t, np.ones((N, 1)), (0.1 * t + shaking * 0.1 * shakes)[:, None], SPEC)
    oddities = examined(Dataset("x", (Run(record),))).oddities or ()
    assert any(odd.kind == "slow" for odd in oddities) == said


@given(rows=st.sets(st.integers(20, N - 20), min_size=1, max_size=8), size=st.floats(0.1, 1e5), sign=st.booleans())
@settings(max_examples=15, deadline=None)
def test_spikes_of_any_size_are_marked_row_by_row(rows: set[int], size: float, sign: bool) -> None:
    u = multisine(1)
    y = swing(u)
    odd = y.copy()
    places = [row for row in sorted(rows) if all(abs(row - other) > 3 for other in rows if other != row)]
    odd[places] += size * (1 if sign else -1)
    record, oddities = found(u, odd)
    marked = [] if record.missing is None else np.flatnonzero(record.missing[:, 0]).tolist()
    assert marked == places
    assert {odd.kind for odd in oddities} <= {"spike", "word"}
    assert np.abs(record.y[:, 0] - y).max() < 0.02  # in their place stands what the neighbours foretell


@pytest.mark.parametrize("kind", ["multisine", "prbs", "clipped", "bang-bang", "steps", "pulses"])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2])
def test_nothing_is_odd_about_clean_records(kind: str, noise: float) -> None:
    rng = np.random.default_rng(3)
    u = {
        "multisine": multisine(2),
        "prbs": np.repeat(rng.choice([-0.5, 0.5], N // 8), 8),
        "clipped": np.clip(2 * multisine(2), -0.5, 0.5),
        "bang-bang": 0.5 * np.sign(np.sin(0.05 * np.arange(N))),
        "steps": np.repeat(rng.uniform(-0.5, 0.5, N // 100), 100),
        "pulses": np.where(np.isin(np.arange(N), [200, 500, 800]), 20.0, 0.0),
    }[kind]
    record, oddities = found(u, swing(u, noise=noise))
    assert oddities == []
    assert record.missing is None


def test_a_plant_that_sticks_is_no_held_sensor() -> None:
    x, v, y = 0.0, 0.0, []
    u = 1.2 * np.sin(0.02 * np.arange(N))
    for force in u:
        y.append(x)
        push = force - np.sign(v or force)
        moves = v != 0.0 or abs(force) > 1.0
        new = v + DT * push if moves else 0.0
        v = 0.0 if v * new < 0 else new
        x += DT * v
    still = np.mean(np.diff(y) == 0.0)
    assert still > 0.1
    assert found(u, np.array(y))[1] == []


@pytest.mark.parametrize("counts", [200, 1024, 8192])
def test_an_encoder_is_no_fault(counts: int, clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    step = 2 * np.pi / counts
    assert found(u, np.round(y / step) * step)[1] == []


@pytest.mark.parametrize("every", [2, 3, 5, 10])
def test_a_slow_sensor_is_named_with_its_rhythm(every: int, clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    record, oddities = found(u, np.repeat(y[::every], every)[:N])
    assert [odd.kind for odd in oddities] == ["held"]
    assert f"every {every}" in oddities[0].words
    assert record.missing is not None
    assert np.flatnonzero(~record.missing[:, 0]).tolist() == list(range(0, N, every))


def test_words_for_nothing_are_one_finding(clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    odd = y.copy()
    odd[[300, 301, 700]] = 9999.0
    record, oddities = found(u, odd)
    assert [(o.kind, o.rows) for o in oddities] == [("word", (300, 301, 700))]
    assert np.abs(record.y).max() < 10


def test_glitches_of_a_coarse_encoder_that_share_a_value_by_chance_are_no_words(
    clean: tuple[FloatArray, FloatArray],
) -> None:
    u, y = clean
    step = 2 * np.pi / 500
    read = np.round(y / step)
    rows = np.arange(60, N - 60, 45)
    read[rows] += np.where(np.arange(rows.size) % 2, 8, -8)
    values, counts = np.unique(read[rows], return_counts=True)
    assert (counts > 1).any()
    assert 0.0 not in values
    record, oddities = found(u, step * read)
    assert {odd.kind for odd in oddities} == {"spike"}
    assert len(oddities) == 1
    assert record.missing is not None
    assert set(np.flatnonzero(record.missing[:, 0])) == set(rows)


def test_a_glitch_of_the_log_is_mended_and_a_push_is_not(clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    pushed = u.copy()
    pushed[600] = 20.0
    record, oddities = found(pushed, y)
    assert [(o.kind, o.channel, o.rows) for o in oddities] == [("spike", "u", (600,))]
    assert abs(record.u[600, 0] - u[600]) < 0.05
    record, oddities = found(pushed, swing(pushed))
    assert oddities == []
    assert record.u[600, 0] == 20.0


def test_a_filter_passes_over_missing_readings(clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    missing = np.zeros((N, 1), dtype=bool)
    missing[[100, 101, 640]] = True
    record = Trajectory(np.arange(N) * DT, u[:, None], y[:, None], SPEC, missing=missing)
    other = replace(record, y=np.where(missing, 1e6, record.y))
    system = pendulum().system()
    noise = PassNoise(np.array([1e-3]), np.array([1e-3]), np.array([0.1]), np.zeros(1))
    for compiled in (True, False):
        run = KalmanPass(with_latent_forces(system), DT, compiled=compiled)
        first, second = (run(one, system.vector(TRUE), [0.0, 0.0], noise) for one in (record, other))
        assert first is not None
        assert second is not None
        assert first.nll == second.nll
        assert np.flatnonzero(np.isnan(first.e[:, 0])).tolist() == [100, 101, 640]
    assert record[90:110].missing is not None
    assert record[:50].missing is None


def test_intervals_hold_beside_spikes(clean: tuple[FloatArray, FloatArray]) -> None:
    u, y = clean
    odd = y.copy()
    odd[[150, 500, 501, 900]] += [0.3, -3.0, 5.0, 1e4]
    _, fit = fit_likelihood(pendulum().system(), [found(u, odd)[0]])
    for name, value in TRUE.items():
        low, high = fit.interval(name, 3.0)
        assert low < value < high, name


def written(path: Path, u: FloatArray, y: FloatArray) -> Path:
    rows = zip(np.arange(len(y)) * DT, u, y, strict=True)
    path.write_text("time [s],u [N m],theta [rad]\n" + "".join(f"{t:.9g},{a:.9g},{b:.9g}\n" for t, a, b in rows))
    return path


@given(seed=st.integers(0, 200), noise=st.sampled_from([1e-5, 1e-3]), lines=st.booleans())
@settings(max_examples=12, deadline=None)
def test_an_input_that_moves_between_its_readings_is_read_so_and_a_held_one_is_not(
    seed: int, noise: float, lines: bool
) -> None:
    """A servo whose controller works faster than its log: half a row of lead, which passed for mechanics."""
    system, u = pendulum().system(), multisine(seed)[:, None]
    simulator = system.simulator(DT, intersample="foh" if lines else "zoh")
    y = simulator.rollout(system.vector(TRUE), [0.0, 0.0], u) + noise * np.random.default_rng(seed).standard_normal(
        (N, 1)
    )
    dataset = Dataset("x", (Run(Trajectory(np.arange(N) * DT, u, y, SPEC)),))
    read = inputs_checked(system, dataset)
    if noise < 1e-4:  # half a row is 5 ms of a motion of 3 Hz: noise may hide it
        assert read.intersample == ("foh" if lines else "zoh")
    assert lines or read.intersample == "zoh"
    between = [odd.words for odd in read.oddities or () if odd.kind == "between"]
    assert len(between) == (read.intersample == "foh")
    assert all('declare intersample = "foh"' in words for words in between)
    assert np.array_equal(read.runs[0].trajectory.u, u)


@pytest.mark.parametrize("late", [1, 2])
def test_check_data_tells_that_the_input_is_late(
    late: int, tmp_path: Path, clean: tuple[FloatArray, FloatArray]
) -> None:
    u, y = clean
    odd = y.copy()
    odd[400] = 9999.0
    path = written(tmp_path / "log.csv", np.roll(u, late)[late:], odd[late:])
    check = api.check_data(path, model="pendulum", out=tmp_path / "page.html")
    assert sorted(odd.kind for odd in check.faults) == ["shift", "word"]
    assert ("one row late" if late == 1 else "2 rows late") in str(check)
    page = (tmp_path / "page.html").read_text()
    assert "<circle" in page
    assert "9999" in page
    assert json.loads(json.dumps(check.to_dict()))["oddities"][0]["rows"] == [400 - late]
    after = check.dataset.estimation[0]
    assert np.allclose(after.u[:200, 0], u[late : 200 + late], atol=1e-6)


def test_check_data_leaves_an_input_in_time_alone(tmp_path: Path, clean: tuple[FloatArray, FloatArray]) -> None:
    check = api.check_data(written(tmp_path / "log.csv", *clean), model="pendulum")
    assert check.faults == ()


def test_lost_rows_are_named_where_the_motion_would_have_to_meet() -> None:
    """Where the output leaps by more than six steps; of 1795 such gaps 34 passed for motion, none stood elsewhere."""
    rng, leaps, named = np.random.default_rng(0), 0, 0
    for seed in range(21):
        u = multisine(seed)
        y = swing(u, seed)
        for first, many in zip(rng.integers(60, N - 200, 3), rng.integers(8, 60, 3), strict=True):
            gone = np.arange(first, first + many)
            _, odd = found(np.delete(u, gone), np.delete(y, gone))
            rows = [one.rows[0] for one in odd if one.kind == "leap"]
            assert all(abs(row - first) <= 1 for row in rows)
            if abs(y[first + many] - y[first - 1]) > 6 * np.abs(np.diff(y)).max():
                leaps, named = leaps + 1, named + (rows == [first])
        assert not [one for one in found(u, y)[1] if one.kind == "leap"]
    assert leaps > 30
    assert named >= 0.95 * leaps


def test_leaps_of_a_channel_are_counted_in_one_line_and_each_ends_a_record() -> None:
    """A walker changes legs at each strike: a line for each of them, and of each column, hid all that was said else."""
    t, period = np.arange(1200) * DT, 75
    y = (np.arange(1200) % period) * 0.01 - 0.3 + 1e-4 * np.random.default_rng(0).standard_normal(1200)
    spec = PlantSpec((), (Channel("leg", "rad"), Channel("other", "rad")), DT)
    data = examined(Dataset("walk", (Run(Trajectory(t, np.zeros((1200, 0)), np.column_stack([y, -y]), spec)),)))
    odd = [one for one in data.oddities or () if one.kind == "leap"]
    assert [(one.channel, one.rows) for one in odd] == [(name, tuple(range(75, 1200, 75))) for name in ("leg", "other")]
    assert "leaps by up to 0.7" in odd[0].words
    assert "in 15 places, before rows 75, 150, 225, 300, ...," in odd[0].words
    assert [len(run.trajectory) for run in parted(data)] == [75] * 16


@given(seed=st.integers(0, 1000), finest=st.floats(1e-5, 1e-3))
@settings(max_examples=15, deadline=None)
def test_an_encoder_that_goes_to_and_fro_by_a_count_at_rest_does_not_leap(seed: int, finest: float) -> None:
    rng, t = np.random.default_rng(seed), np.arange(3000) * 0.001
    servo = np.where(t > 0.5, -np.expm1(-np.maximum(t - 0.5, 0.0) / 0.08), 0.0)  # a step, and then rest
    counts = np.round(servo / finest) + (rng.random(t.size) < 0.02)
    flips = np.repeat(rng.integers(0, 2, 60), 50)  # a count to and fro, for a while
    u = np.where(t > 0.5, 1.0, 0.0)
    assert not [odd for odd in found(u, finest * (counts + flips))[1] if odd.kind == "leap"]


def test_a_stop_is_no_leap(clean: tuple[FloatArray, FloatArray]) -> None:
    """A motion that is turned back in one row bends there, and meets; a relay's force leaves it whole."""
    u, y = clean
    _, odd = found(u, np.abs(y) + 1e-3 * np.random.default_rng(3).standard_normal(N))
    assert not [one for one in odd if one.kind == "leap"]


def test_the_loop_looks_at_what_follows_lost_rows_as_a_record_of_its_own() -> None:
    """It was called play: a friction or a spring has to explain how the pendulum came elsewhere in no time."""
    runs, many, row = [], 30, 0
    for seed, use in ((1, "estimation"), (2, "validation")):
        u, keep = multisine(seed), np.arange(N)
        y = swing(u, seed)
        if use == "estimation":  # where it moves most meanwhile
            row = 300 + int(np.argmax(np.abs(y[300 + many : 900 + many] - y[299:899])))
            keep = np.delete(keep, np.arange(row, row + many))
        runs.append(Run(Trajectory(np.arange(len(keep)) * DT, u[keep][:, None], y[keep][:, None], SPEC), use))
    report = close_loop(Dataset("lost", tuple(runs)), pendulum().system())
    assert report.verdict == "nothing_missing"
    assert [(odd["kind"], odd["rows"]) for odd in report.data["oddities"]] == [("leap", [row])]
    assert report.data["parameters"]["before"]["J"]["value"] == pytest.approx(TRUE["J"], rel=0.02)


@pytest.mark.parametrize("value", [1e200, -3e154, 1.7e308])
@pytest.mark.parametrize("column", ["u", "q"])
def test_a_number_that_no_sensor_reads_is_left_out(value: float, column: str) -> None:
    """A damaged row of a robot's log held -1e282: averages were infinite, and nothing was said."""
    rng = np.random.default_rng(3)
    u, q = rng.standard_normal(400), np.zeros(400)
    for k in range(399):
        q[k + 1] = 0.9 * q[k] + u[k]
    (u if column == "u" else q)[2] = value
    spec = PlantSpec((Channel("u"),), (Channel("q"),), 0.1)
    found = examined(Dataset("x", (Run(Trajectory(np.arange(400) * 0.1, u[:, None], q[:, None], spec)),)))
    (odd,) = [one for one in found.oddities or () if one.channel == column]
    assert odd.rows == (2,)
    assert "which no sensor does" in odd.words
    record = found.runs[0].trajectory
    assert np.abs(record.u).max() < 10
    assert np.nanmax(np.abs(record.readings)) < 100
    assert bool(np.isnan(record.readings[2, 0])) is (column == "q")


def test_rows_that_were_lost_are_counted_and_clean_records_have_none() -> None:
    """Without a trace in the clock; a pendulum cut in two places got two springs, a cart written twice no friction."""
    for seed in range(2):
        u = 0.2 * multisine(seed)
        y = swing(u, seed, 2e-4)
        speed = np.abs(np.gradient(y))
        row = 200 + int(np.flatnonzero(speed[200:] > 0.5 * speed.max())[0])
        assert found(u, y)[1] == []
        lost = found(np.delete(u, row), np.delete(y, row))[1]
        assert [odd.rows for odd in lost if odd.kind == "leap"] == [(row,)]
        twice = found(np.insert(u, row, u[row - 1]), np.insert(y, row, y[row - 1]))[1]
        assert [(odd.kind, odd.rows) for odd in twice] == [("leap", (row,))]


def test_a_reading_that_falls_to_zero_and_stays_there_is_none_from_its_first_row_on() -> None:
    """Its first zero was a reading: a pendulum with nothing missing got an elastic joint, with confidence."""
    u = multisine(3)
    y = swing(u, 3)
    now, then = y[300:800], y[330:830]
    row = 300 + int(np.argmax(np.min(np.abs([now, then, then - now]), axis=0)))
    held = y.copy()
    y[row : row + 30], held[row : row + 30] = 0.0, held[row]
    for read, first in ((y, row), (held, row + 1)):
        missing = found(u, read)[0].missing
        assert missing is not None
        assert np.flatnonzero(missing[:, 0]).tolist() == list(range(first, row + 30))


def test_stretches_of_ten_equal_readings_and_lines_between_others_are_no_readings(
    clean: tuple[FloatArray, FloatArray],
) -> None:
    u, y = clean
    stuck, bridged = y.copy(), y.copy()
    stuck[400:410] = stuck[400]
    bridged[700:715] = np.linspace(y[700], y[714], 15)
    knots = np.arange(0, N, 4)
    answers = {
        "stuck": (stuck, list(range(401, 410))),
        "filled": (bridged, list(range(701, 714))),
        "filled, in a rhythm": (np.interp(np.arange(N), knots, y[knots]), np.setdiff1d(np.arange(N), knots).tolist()),
    }
    assert [odd.kind for odd in found(u, np.clip(y, *np.quantile(y, [0.04, 0.96])))[1]] == ["rail", "rail"]
    for kind, (read, rows) in answers.items():
        record, oddities = found(u, read)
        assert [odd.kind for odd in oddities] == [kind.partition(",")[0]]
        assert record.missing is not None
        assert np.flatnonzero(record.missing[:, 0]).tolist() == rows
