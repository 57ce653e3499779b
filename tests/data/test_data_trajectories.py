"""Records written to files come back bit for bit; the truth in them is never taken for a measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from harness.data import load_dataset, read_trajectory, write_trajectory
from harness.data.recipe.draft import draft_dataset
from harness.errors import InputError
from harness.fleet.records import find_records
from harness.signals import Channel, PlantSpec, Trajectory
from harness.testing import trajectories


@given(trajectory=trajectories(with_truth=True))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_to_the_last_bit(tmp_path: Path, trajectory: Trajectory) -> None:
    for path in (tmp_path / "run.csv", tmp_path / "run.parquet"):
        back = read_trajectory(write_trajectory(trajectory, path), spec=trajectory.spec)
        for name in ("t", "u", "y", "x"):
            mine, read = getattr(trajectory, name), getattr(back, name)
            assert (mine is None) == (read is None)
            if mine is not None:
                assert mine.tobytes() == read.tobytes(), name
    assert read_trajectory(tmp_path / "run.parquet").spec == trajectory.spec
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.csv", "run.csv-metadata.json", "run.parquet"]


def small(x: np.ndarray | None = None) -> Trajectory:
    n = 60
    u = np.sin(np.arange(n) ** 1.3)[:, None]
    spec = PlantSpec(
        (Channel("u", "N m"),), (Channel("theta", "rad", period=2 * np.pi),), 0.01, (Channel("theta", "rad"),)
    )
    return Trajectory(np.arange(n) * 0.01, u, np.cumsum(u, axis=0) * 0.01, spec, x)


def test_a_csv_is_a_plain_table(tmp_path: Path) -> None:
    path = write_trajectory(small(np.ones((60, 1))), tmp_path / "run.csv")
    lines = path.read_text().splitlines()
    assert lines[0] == "time [s],u [N m],theta [rad],truth:theta [rad]"
    assert len(lines) == 61
    read = read_trajectory(path, inputs=["u"])
    assert [str(c) for c in read.spec.inputs + read.spec.outputs + read.spec.states] == [
        "u [N m]",
        "theta [rad]",
        "theta [rad]",
    ]
    assert read_trajectory(path).spec == small().spec  # it stands beside it, periods and ranges too
    assert [c.name for c in read_trajectory(path, inputs=["theta"]).spec.inputs] == ["theta"]  # played otherwise
    with pytest.raises(InputError, match="no column 'force'"):
        read_trajectory(path, inputs=["force"])


def test_a_csv_states_its_roles_beside_it(tmp_path: Path) -> None:
    path = write_trajectory(small(), tmp_path / "run.csv")
    assert [str(c) for c in load_dataset(path).dataset.spec.inputs] == ["u [N m]"]
    assert [str(c) for c in load_dataset(path).dataset.spec.outputs] == ["theta [rad]"]
    assert draft_dataset([path]).count('role = "input"') == draft_dataset([path]).count('role = "output"') == 1
    assert [c.name for c in load_dataset(path, input="theta", output="u").dataset.spec.inputs] == ["theta"]
    assert [one.file for one in find_records(str(tmp_path / "*"))] == [path]
    beside = tmp_path / "run.csv-metadata.json"
    whole = beside.read_text()
    for other in ("{", '{"notes": [{"sysid-harness/trajectory/1": {}}]}'):
        beside.write_text(other)
        with pytest.raises(InputError, match=r"run\.csv-metadata\.json: what the record says of its channels"):
            load_dataset(path)
    for other in ('{"url": "run.csv"}', whole.replace('"theta"', '"phi"')):  # another tool's, and of another table
        beside.write_text(other)
        with pytest.raises(InputError, match="which columns are inputs"):
            load_dataset(path)
    beside.unlink()
    with pytest.raises(InputError, match="which columns are inputs"):
        read_trajectory(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_truth_is_no_measurement(tmp_path: Path, suffix: str) -> None:
    path = write_trajectory(small(np.full((60, 1), 77.0)), tmp_path / f"run{suffix}")
    data = load_dataset(path, model="pendulum").dataset
    assert [c.name for c in data.spec.outputs] == ["theta"]
    assert all(run.trajectory.x is None for run in data.runs)
    assert not any((run.trajectory.y == 77.0).any() for run in data.runs)
    (tmp_path / "d.toml").write_text(
        f'name = "d"\n[signals.theta]\nrole = "output"\ncolumn = "truth:theta"\n[[runs]]\nfile = "run{suffix}"\n'
    )
    with pytest.raises(InputError, match="no column 'truth:theta'"):
        load_dataset(tmp_path / "d.toml")


def test_a_parquet_file_knows_its_roles(tmp_path: Path) -> None:
    path = write_trajectory(small(), tmp_path / "run.parquet")
    data = load_dataset(path).dataset
    assert data.spec.nu == 1
    assert data.spec.outputs[0].period == pytest.approx(2 * np.pi)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.csv or \.parquet"):
        write_trajectory(small(), tmp_path / "run.xlsx")
    with pytest.raises(InputError, match="folder is missing"):
        write_trajectory(small(), tmp_path / "no" / "run.csv")
