"""Further small faults of data that no other test would notice; `lab/mutations.py` finds them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness.data import load_dataset
from harness.data.conditioning.unstated import DAY, USUAL, refuse_unlikely_seconds
from harness.data.recipe.contents import contents_of
from harness.data.recipe.sanity import check_run
from harness.data.tables.bags import is_bag_folder
from harness.data.tables.memory import input_and_output
from harness.data.times.stamps import clock
from harness.errors import InputError
from harness.signals import Channel, PlantSpec, Trajectory

N, DT = 90, 0.01
TIME = np.round(np.arange(N) * DT, 6)
TORQUE = np.round(np.random.default_rng(50).normal(size=N), 5)
ANGLE = np.round(np.cumsum(np.cumsum(TORQUE)) * 1e-3, 6)


def test_zones_count_where_they_change() -> None:
    """The end of summer time, and two ways to write Greenwich."""
    assert clock(["2024-10-27T02:59:59.9+02:00", "2024-10-27T02:00:00.0+01:00"]) == pytest.approx([0.0, 0.1])
    assert clock(["2024-05-01T08:00:00-04:00", "2024-05-01T12:00:01Z"]) == pytest.approx([0.0, 1.0])
    assert clock(["2024-05-01T12:00:00Z", "2024-05-01T12:00:01+00:00", "2024-05-01T17:30:02+0530"]) == pytest.approx(
        [0.0, 1.0, 2.0]
    )


@pytest.mark.parametrize("leading", USUAL)
@pytest.mark.parametrize("epoch", [45356.4, 739316.4, 2460380.9])
def test_days_at_every_usual_step_are_asked_for(leading: float, epoch: float) -> None:
    for power in (0, 1, 2):
        days = epoch + np.arange(200) * leading * 10.0**power / DAY
        with pytest.raises(InputError, match="may count days"):
            refuse_unlikely_seconds(days, "time")


def test_stamps_that_stand_still_are_no_days() -> None:
    refuse_unlikely_seconds(np.full(30, 45356.4), "time")


def test_a_folder_is_a_bag_by_its_metadata_alone(tmp_path: Path) -> None:
    assert not is_bag_folder(tmp_path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    assert is_bag_folder(tmp_path)
    assert not is_bag_folder(tmp_path / "metadata.yaml")


def test_columns_of_arrays_are_named_and_kept_apart() -> None:
    table, inputs, outputs = input_and_output(np.arange(12.0).reshape(6, 2), np.arange(6.0)[:, None])
    assert (inputs, outputs) == (["u1", "u2"], ["y"])
    assert [table[name].tolist() for name in ("u1", "u2", "y")] == [
        [0.0, 2.0, 4.0, 6.0, 8.0, 10.0],
        [1.0, 3.0, 5.0, 7.0, 9.0, 11.0],
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
    ]


def test_an_index_that_both_series_share_is_the_clock() -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    index = pandas.Index(1e3 * TIME, name="time_ms")
    u, y = pandas.Series(TORQUE, index=index), pandas.Series(ANGLE, index=index)
    table, inputs, outputs = input_and_output(u, y)
    assert (list(table), inputs, outputs) == (["time_ms", "u", "y"], ["u"], ["y"])
    assert "time_ms" not in input_and_output(u, pandas.Series(ANGLE, index=index + 1))[0]
    polars = pytest.importorskip("polars", reason="polars is not installed")
    assert list(input_and_output(polars.Series(TORQUE.tolist()), ANGLE)[0]) == ["u", "y"]  # without an index


def test_titles_in_quotes_hold_blanks_where_columns_stand_apart_by_blanks(tmp_path: Path) -> None:
    rows = [f"{t} {u} {y}" for t, u, y in zip(TIME, TORQUE, ANGLE, strict=True)]
    (tmp_path / "a.txt").write_text("\n".join(['"time [s]" "u [N m]" "theta [rad]"', *rows]) + "\n")
    found = contents_of(tmp_path / "a.txt")
    assert [(channel.name, channel.unit) for channel in found.channels] == [("u", "N m"), ("theta", "rad")]
    assert found.sample_time == pytest.approx(DT)


def test_messages_have_their_times_in_seconds(tmp_path: Path) -> None:
    writer_module = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    with (tmp_path / "slow.mcap").open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start()
        channel = writer.register_channel("/rig", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for k in range(N):  # two seconds apart: without a unit they would be asked for one
            data = json.dumps({"u": float(TORQUE[k]), "theta": float(ANGLE[k])}).encode()
            writer.add_message(channel, 10**18 + 2 * 10**9 * k, data, 0)
        writer.finish()
    column = {"u": "/rig.u", "theta": "/rig.theta"}
    data = load_dataset(tmp_path / "slow.mcap", input="u", output="theta", column=column).dataset
    assert data.spec.sample_time == pytest.approx(2.0)
    assert [channel.unit for channel in data.spec.outputs] == ["1"]  # nothing is stated for the fields


@pytest.mark.parametrize(
    ("factor", "words"),
    [(180 / np.pi, "degrees"), (1e3, "by 1000"), (1e-3, "by 1000"), (60 / (2 * np.pi), "rpm"),
     (0.5 / np.pi, "turns per second"), (60.0, "per minute"), (-1.0, "wrong sign")],
)  # fmt: skip
def test_what_may_be_wrong_with_a_rate_is_named(factor: float, words: str) -> None:
    t = np.arange(400) * DT
    angle = 0.2 * np.sin(2 * t) + 0.1 * np.sin(5.1 * t)
    rate = 0.4 * np.cos(2 * t) + 0.51 * np.cos(5.1 * t)
    spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("theta_rate", "rad/s")), DT)
    torque = np.random.default_rng(0).normal(size=(400, 1))
    measured = (("theta", 0), ("theta", 1))
    assert check_run(Trajectory(t, torque, np.column_stack([angle, rate]), spec), measured) == []
    with pytest.raises(InputError, match=words):
        check_run(Trajectory(t, torque, np.column_stack([angle, rate * factor]), spec), measured)
