"""Formats: what is written by others is read to the last bit, and what cannot be read is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from harness.data.tables.selectors import parse_selector, vector
from harness.data.tables.table import Table
from harness.errors import InputError

VALUES = np.array([0.1, 1 / 3, -2e-300, 7.0, 1e22])


def test_csv_in_its_dialects(tmp_path: Path) -> None:
    for number, text in enumerate(
        (
            '"a","b [N m]"\n1,0.1\n2,0.30000000000000004\n',
            "a;b [N m]\n1;0.1\n2;0.30000000000000004\n",
            "a\tb [N m]\n1\t0.1\n2\t0.30000000000000004\n",
            "# exported\n\na,b [N m],\n1,0.1,\n2,0.30000000000000004,\n",
        )
    ):
        path = tmp_path / f"{number}.csv"
        path.write_text(text)
        values, unit = Table(path).read("b")
        assert values.tolist() == [0.1, 0.30000000000000004]
        assert unit == "N m"
    path = tmp_path / "no_header.dat"
    path.write_text("  6.41e+00\t 4.7\t\n 3.41e+00\t 4.8\t\n")
    assert Table(path).read(1)[0].tolist() == [4.7, 4.8]
    assert Table(path).read(0)[0].tolist() == [6.41, 3.41]


def test_empty_cells_are_nan_and_words_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n,NaN\n3,NA\n")
    table = Table(path)
    assert np.isnan(table.read("a")[0]).tolist() == [False, True, False]
    assert np.isnan(table.read("b")[0]).tolist() == [False, True, True]
    path.write_text("a,b\n1,2\n3,oops\n")
    with pytest.raises(InputError, match=r"a.csv: line 3, column 'b'.*'oops'"):
        Table(path).read("b")
    path.write_text("a;b\n1;2,5\n")
    assert Table(path).read("b")[0].tolist() == [2.5]
    path.write_text("a;b\n1;2,5\n2;1.5\n")
    with pytest.raises(InputError, match="decimal points"):
        Table(path).read("b")


@pytest.mark.parametrize("content", [b"", b"a,b\n", b"\xff\xfe\x00bad"])
def test_a_text_file_without_data_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.csv"):
        Table(path)


def test_broken_binary_files_are_refused(tmp_path: Path) -> None:
    for suffix in (".parquet", ".mat", ".npz"):
        path = tmp_path / f"broken{suffix}"
        path.write_bytes(b"this is no such file at all, but long enough to look at")
        with pytest.raises(InputError, match=f"broken{suffix}"):
            Table(path)
    path = tmp_path / "a.ods"
    path.write_bytes(b"PK")
    with pytest.raises(InputError, match="unknown format"):
        Table(path)


def test_mat_variables_cells_rows_and_structs(tmp_path: Path) -> None:
    from scipy.io import savemat

    cells = np.empty((2, 1), dtype=object)
    cells[0, 0], cells[1, 0] = np.vstack([VALUES, 2 * VALUES]), np.vstack([3 * VALUES, 4 * VALUES])
    path = tmp_path / "a.mat"
    savemat(path, {"y": VALUES[:, None], "Y": cells, "log": {"x": VALUES, "deep": {"z": 5 * VALUES}}, "dt": 0.1})
    table = Table(path)
    for selector, factor in (("y", 1), ("Y{0}[0]", 1), ("Y{1}[1]", 4), ("log.x", 1), ("log.deep.z", 5)):
        assert np.array_equal(table.read(selector)[0], factor * VALUES), selector
    for wrong, words in (
        ("Y", r"Y\{0\}"),
        ("Y{5}[0]", "more than 5 cells"),
        ("Y{0}[7]", "more than 7 rows"),
        ("Y{0}", "not one column"),
        ("log.w", "field w"),
        ("y[", "selector"),
        ("q{0}", r"no column 'q\{0\}'"),
    ):
        with pytest.raises(InputError, match=words):
            table.read(wrong)


def test_numpy_archives(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=VALUES, X=np.column_stack([VALUES, 2 * VALUES]))
    table = Table(tmp_path / "a.npz")
    assert np.array_equal(table.read("X[:,1]")[0], 2 * VALUES)
    assert np.array_equal(table.read("t")[0], VALUES)
    np.save(tmp_path / "b.npy", np.vstack([VALUES, 2 * VALUES]))
    assert np.array_equal(Table(tmp_path / "b.npy").read("array[1]")[0], 2 * VALUES)


def test_parquet_columns_of_any_numeric_type(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(
        pa.table({"a [m]": pa.array([1.5, None]), "n": pa.array([1, 2], pa.int16()), "s": ["x", "y"]}),
        tmp_path / "a.parquet",
    )
    table = Table(tmp_path / "a.parquet")
    values, unit = table.read("a")
    assert unit == "m"
    assert values[0] == 1.5
    assert np.isnan(values[1])
    assert table.read("n")[0].tolist() == [1.0, 2.0]
    with pytest.raises(InputError, match="no numbers"):
        table.read("s")


def test_hdf5_and_mat_v73(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'sysid-harness[data]'")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log/theta"] = VALUES
        file["log/theta"].attrs["unit"] = "rad"
        file["log/X"] = np.vstack([VALUES, 2 * VALUES])
    table = Table(tmp_path / "a.h5")
    values, unit = table.read("log/theta")
    assert np.array_equal(values, VALUES)
    assert unit == "rad"
    assert np.array_equal(table.read("log/X[1]")[0], 2 * VALUES)
    path = tmp_path / "b.mat"
    with h5py.File(
        path, "w", userblock_size=512
    ) as file:  # as MATLAB -v7.3 lays it out: axes turned, cells by reference
        file["#refs#/a"] = np.vstack([VALUES, 2 * VALUES]).T
        file["#refs#/b"] = np.vstack([3 * VALUES, 4 * VALUES]).T
        file["Y"] = np.array([[file["#refs#/a"].ref, file["#refs#/b"].ref]], dtype=h5py.ref_dtype)
        file["y"] = VALUES[None, :]
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(128))
    table = Table(path)
    assert np.array_equal(table.read("Y{1}[0]")[0], 3 * VALUES)
    assert np.array_equal(table.read("y")[0], VALUES)


def test_mdf(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'sysid-harness[data]'")
    with asammdf.MDF(version="4.10") as log:
        stamps = np.arange(5) * 0.1
        log.append([asammdf.Signal(VALUES, stamps, name="speed", unit="rad/s")])
        log.save(tmp_path / "a.mf4")
    table = Table(tmp_path / "a.mf4")
    values, unit = table.read("speed")
    assert np.array_equal(values, VALUES)
    assert unit == "rad/s"
    assert table.read("time")[0] == pytest.approx(stamps)


@pytest.mark.filterwarnings("error")
def test_a_broken_mdf_is_refused_and_nothing_is_said_afterwards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import gc

    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'sysid-harness[data]'")
    with asammdf.MDF(version="4.10") as log:
        log.append([asammdf.Signal(VALUES, np.arange(5) * 0.1, name="speed")])
        log.save(tmp_path / "sound.mf4")
    sound = (tmp_path / "sound.mf4").read_bytes()
    for length in (0, 10, 64, 100, 168, 300, len(sound) // 2):
        (tmp_path / "a.mf4").write_bytes(sound[:length])
        with pytest.raises(InputError, match="MDF"):
            Table(tmp_path / "a.mf4")
    gc.collect()
    assert "Traceback" not in capsys.readouterr().err


def test_mcap(tmp_path: Path) -> None:
    writer_module = pytest.importorskip(
        "mcap.writer", reason="mcap is not installed: pip install 'sysid-harness[data]'"
    )
    import json

    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start()
        schema = writer.register_schema(name="s", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/joint", message_encoding="json", schema_id=schema)
        for k, value in enumerate(VALUES):
            data = json.dumps({"position": [value, 2 * value]}).encode()
            writer.add_message(channel, log_time=10**9 + k * 10**7, publish_time=0, data=data)
        other = writer.register_channel(topic="/imu", message_encoding="protobuf", schema_id=0)
        writer.add_message(other, log_time=10**9, publish_time=0, data=b"x")
        writer.finish()
    table = Table(path)
    assert np.array_equal(table.read("/joint.position[1]")[0], 2 * VALUES)
    assert table.read("time")[0] == pytest.approx(np.arange(5) * 0.01)
    with pytest.raises(InputError, match="topic '/imu' cannot be read: expected JSON messages, got protobuf messages"):
        table.read("/imu.x")


def test_a_missing_optional_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for suffix, package in ((".h5", "h5py"), (".mf4", "asammdf"), (".mcap", "mcap.reader")):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(b"x")
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(InputError, match=r"pip install 'sysid-harness\[data\]'"):
            Table(path)


@given(st.integers(0, 3), st.integers(0, 4), arrays(np.float64, (4, 5), elements=st.floats(-1e6, 1e6)))
def test_rows_and_columns_of_any_matrix(row: int, column: int, matrix: np.ndarray) -> None:
    assert np.array_equal(vector(matrix, parse_selector(f"X[{row}]")), matrix[row])
    assert np.array_equal(vector(matrix, parse_selector(f"X[:, {column}]")), matrix[:, column])
