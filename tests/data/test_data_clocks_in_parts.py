"""A date beside milliseconds, a scope's header, a logger's row of units: read as whoever wrote them meant."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest

from harness import api
from harness.errors import InputError

ROWS = 90
U = np.tile([1.0, 1.0, -1.0, 0.0, 2.0], ROWS // 5)
Y = np.round(np.sin(0.2 * np.arange(ROWS)), 4)


def stamp(k: int, form: str, step: float = 0.25) -> str:
    return (datetime.datetime(2024, 3, 5, 23, 59, 50) + datetime.timedelta(seconds=k * step)).strftime(form)


def written(path: Path, head: str, clocks: list[str], sign: str = ",") -> Path:
    rows = [sign.join((clock, f"{u:g}", f"{y:g}")) for clock, u, y in zip(clocks, U, Y, strict=True)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@pytest.mark.parametrize(("head", "clock"), [
    ("DateTime,ms,u,y", lambda k: f"{stamp(k, '%Y-%m-%d %H:%M:%S')},{250 * k % 1000}"),
    ("Date,Time,ms,u,y", lambda k: f"{stamp(k, '%d.%m.%Y')},{stamp(k, '%H:%M:%S')},{250 * k % 1000}"),
    ("Date,ms,u,y", lambda k: f"{stamp(k, '%Y/%m/%d %H:%M:%S')},{250 * k % 1000}"),
    ("Time,msec,u,y", lambda k: f"{stamp(k, '%H:%M:%S')},{250 * k % 1000}"),
    ("Timestamp,Microseconds,u,y", lambda k: f"{stamp(k, '%Y-%m-%dT%H:%M:%S')},{250_000 * k % 1_000_000}"),
    ("Date,millis(),u,y", lambda k: f"{stamp(k, '%Y-%m-%d %H:%M:%S')},{81_234 + 250 * k}"),
    ("secs,msecs,u,y", lambda k: f"{1_709_640_000 + k // 4},{250 * k % 1000}"),
    ("%time,u,y", lambda k: f"{1_709_640_000_000_000_000 + 250_000_000 * k}"),
])  # fmt: skip
def test_parts_of_a_second_beside_a_clock_belong_to_it(tmp_path: Path, head: str, clock) -> None:
    path = written(tmp_path / "log.csv", head, [clock(k) for k in range(ROWS)])
    data = api.load_dataset(path, input="u", output="y").dataset
    assert data.spec.sample_time == 0.25
    assert sum(len(run.trajectory) for run in data) == ROWS
    assert np.concatenate([run.trajectory.y[:, 0] for run in data]).tolist() == Y.tolist()


@pytest.mark.parametrize("clock", [
    lambda k: f"{stamp(k, '%Y-%m-%d %H:%M:%S')},0",  # nothing between the stamps
    lambda k: f"{stamp(k, '%Y-%m-%d %H:%M:%S')},{(7 * k) % 13}",  # a latency, say
    lambda k: f"{stamp(k, '%Y-%m-%d %H:%M:%S')},{500 * k}",  # at another pace
])  # fmt: skip
def test_what_is_no_part_of_the_stamps_is_not_added_to_them(tmp_path: Path, clock) -> None:
    path = written(tmp_path / "log.csv", "DateTime,ms,u,y", [clock(k) for k in range(ROWS)])
    with pytest.raises(InputError, match="time stands still"):
        api.load_dataset(path, input="u", output="y")


def test_a_lost_row_shows_in_the_parts(tmp_path: Path) -> None:
    clocks = [f"{stamp(k + (k > 40), '%Y-%m-%d %H:%M:%S')},{250 * (k + (k > 40)) % 1000}" for k in range(ROWS)]
    with pytest.raises(InputError, match=r"not uniform \(1 gap\)"):
        api.load_dataset(written(tmp_path / "log.csv", "DateTime,ms,u,y", clocks), input="u", output="y")


@pytest.mark.parametrize("channels", [("CH1", "CH2"), ("CH3",)])
def test_a_siglent_scope_names_its_channels_and_their_units(tmp_path: Path, channels: tuple[str, ...]) -> None:
    units = ",".join(f"{name}:{unit}" for name, unit in zip(channels, ("V", "A"), strict=False))
    head = (
        f"Record Length,Analog:{ROWS}\nSample Interval,Analog:2.500000E-01\nVertical Units,{units}\n"
        f"Vertical Scale,{','.join(f'{name}:1.00' for name in channels)}\nHorizontal Units,s\nModel Number,SDS1104X-E\n"
        f"Source,{','.join(channels)}\nSecond,{','.join('Value' for _ in channels)}\n"
    )
    values = [U, Y][-len(channels) :]
    rows = [",".join(f"{v:.5f}" for v in (0.25 * k - 5.0, *(one[k] for one in values))) for k in range(ROWS)]
    (tmp_path / "scope.csv").write_text(head + "\n".join(rows) + "\n")
    data = api.load_dataset(tmp_path / "scope.csv", input=channels[:-1] or "none", output=channels[-1]).dataset
    assert (data.spec.sample_time, str(data.spec.outputs[0])) == (
        0.25,
        f"{channels[-1]} [{'A' if channels[1:] else 'V'}]",
    )
    assert data.estimation[0].y[:, 0].tolist() == Y[: len(data.estimation[0])].tolist()


def test_a_graphtec_logger_repeats_words_among_its_units(tmp_path: Path) -> None:
    head = "Number,Date&Time,ms,CH1,CH2\nNO.,time,ms,V,degC"
    clocks = [f"{k + 1},{stamp(k, '%Y/%m/%d %H:%M:%S')},{250 * k % 1000}" for k in range(ROWS)]
    data = api.load_dataset(written(tmp_path / "gl.csv", head, clocks), input="CH1", output="CH2").dataset
    assert (data.spec.sample_time, data.recorded["CH2"]) == (0.25, "degC")
    np.testing.assert_allclose(data.estimation[0].y[:, 0], 273.15 + Y[: len(data.estimation[0])])


def test_records_of_one_clock_with_rounded_stamps_have_one_sample_time(tmp_path: Path) -> None:
    steps = set()
    for rows in (62, 75, 90):
        clocks = [f"{k * 5 / 60:.6f}" for k in range(ROWS)]
        path = written(tmp_path / f"{rows}.csv", "time [min],u,y", clocks)
        path.write_text("\n".join(path.read_text().splitlines()[: rows + 1]) + "\n")
        steps.add(api.load_dataset(path, input="u", output="y").dataset.spec.sample_time)
    assert steps == {5.0}
