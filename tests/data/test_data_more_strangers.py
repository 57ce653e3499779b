"""More logs of strangers: each is read right, or refused with a remedy that works; none is read wrong."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.data import load_dataset
from harness.data.conditioning.unstated import refuse_unlikely_seconds
from harness.data.tables.cells import numbers_of
from harness.data.tables.headers import split_header
from harness.data.tables.stacked import stacked_titles
from harness.data.tables.table import Table
from harness.data.tables.text_files import TextFile
from harness.data.times.stamps import clock, with_dates
from harness.errors import InputError
from harness.units import convert

N, DT = 60, 0.01
RNG = np.random.default_rng(5)
TIME = np.round(np.arange(N) * DT, 6)
U = np.round(np.repeat(RNG.normal(size=N // 3), 3), 4)
Y = np.round(np.cumsum(U) * 0.01 + 1e-3 * RNG.normal(size=N), 6)


def rows(*columns: Any, sign: str = ",") -> str:
    return "".join(sign.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


def written(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(path: Path, **options: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[str]]:
    """Return time from 0, u and y of a file in SI units, and what was said of it."""
    options = {"input": "u", "output": "y", **options}
    data = load_dataset(path, **options).dataset
    records = [run.trajectory for run in data.runs]
    t, u, y = (np.concatenate(parts) for parts in zip(*((r.t, r.u[:, 0], r.y[:, 0]) for r in records), strict=True))
    return t - t[0], u, y, data.warnings


def same(path: Path, scale: float = 1.0, **options: Any) -> Sequence[str]:
    t, u, y, notes = read(path, **options)
    assert t == pytest.approx(TIME, abs=1e-6)
    assert u == pytest.approx(U, abs=1e-9)
    assert y == pytest.approx(Y * scale, abs=1e-9)
    return notes


# ---- dates and times ----------------------------------------------------------------------------------------------

FORMS: dict[str, Callable[[datetime.datetime], str]] = {
    "MATLAB": lambda at: at.strftime("%d-%b-%Y %H:%M:%S.%f"),
    "month first": lambda at: at.strftime("%b %d, %Y %H:%M:%S.%f"),
    "month in full": lambda at: at.strftime("%d %B %Y %H:%M:%S.%f"),
    "of mails": lambda at: at.strftime("%a, %d %b %Y %H:%M:%S.%f"),
    "of C": lambda at: at.strftime("%a %b %d %H:%M:%S.%f %Y"),
    "of C, day not padded": lambda at: at.strftime(f"%a %b {at.day:2d} %H:%M:%S.%f %Y"),
    "German month": lambda at: at.strftime(
        f"{at.day}. {'Jan Feb Mär Apr Mai Jun Jul Aug Sep Okt Nov Dez'.split()[at.month - 1]} %Y %H:%M:%S,%f"
    ),
    "not padded": lambda at: f"{at.year}/{at.month}/{at.day} {at.hour}:{at.strftime('%M:%S.%f')}",
    "Chinese": lambda at: f"{at.year}年{at.month}月{at.day}日 {at.strftime('%H:%M:%S.%f')}",
    "Chinese half days": lambda at: at.strftime(f"%Y-%m-%d {'上午' if at.hour < 12 else '下午'} %I:%M:%S.%f"),
    "Korean half days": lambda at: at.strftime(f"%Y-%m-%d {'오전' if at.hour < 12 else '오후'} %I:%M:%S.%f"),
    "UTC": lambda at: at.strftime("%Y-%m-%d %H:%M:%S.%f UTC"),
    "an offset of GMT": lambda at: at.strftime("%Y-%m-%d %H:%M:%S.%f GMT+02:00"),
    "a place": lambda at: at.isoformat(timespec="microseconds") + "+01:00[Europe/Berlin]",
    "a colon before ms": lambda at: at.strftime("%H:%M:%S:") + f"{at.microsecond // 1000:03d}",
    "a semicolon before ms": lambda at: at.strftime("%H:%M:%S;") + f"{at.microsecond // 1000:03d}",
    "Uhr": lambda at: at.strftime("%d.%m.%Y %H:%M:%S.%f Uhr"),
    "minutes and seconds": lambda at: at.strftime("%M:%S.%f"),
}


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(list(FORMS)),
    st.datetimes(datetime.datetime(1990, 1, 1), datetime.datetime(2060, 1, 1)),
    st.sampled_from([0.001, 0.01, 0.5, 1.0, 59.0]),
)
def test_more_forms_of_dates_are_read_right(form: str, begin: datetime.datetime, step: float) -> None:
    begin = begin.replace(microsecond=begin.microsecond // 1000 * 1000)
    cells = [FORMS[form](begin + datetime.timedelta(seconds=step * k)) for k in range(70)]
    found = clock(cells)
    assert found is not None, cells[0]
    assert found == pytest.approx(step * np.arange(70), abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(["%d.%m.%y", "%d/%m/%y", "%m/%d/%y", "%y-%m-%d", "%y/%m/%d"]),
    st.datetimes(datetime.datetime(2001, 1, 1), datetime.datetime(2060, 1, 1)),
    st.sampled_from([1.0, 3600.0, 40_000.0]),
)
def test_years_of_two_digits_are_read_right_or_refused(form: str, begin: datetime.datetime, step: float) -> None:
    at = [begin.replace(microsecond=0) + datetime.timedelta(seconds=step * k) for k in range(30)]
    try:
        found = clock([one.strftime(f"{form} %H:%M:%S") for one in at])
    except InputError:  # two orders may be possible
        return
    assert found is not None
    assert found == pytest.approx(step * np.arange(30))


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M", "%d.%m.%Y %H:%M", "%Y/%m/%d %H:%M", "%Y-%m-%d %I:%M %p"])
def test_minutes_behind_a_date_need_no_seconds(form: str) -> None:
    at = [datetime.datetime(2024, 12, 31, 23, 0) + datetime.timedelta(minutes=15 * k) for k in range(20)]
    assert np.asarray(clock([one.strftime(form) for one in at])).tolist() == (900.0 * np.arange(20)).tolist()


def test_times_with_two_readings_are_refused_and_a_date_beside_decides(tmp_path: Path) -> None:
    cells = [f"{k // 60:02d}:{k % 60:02d}" for k in range(N)]
    with pytest.raises(InputError, match="hours and minutes, or minutes and seconds"):
        clock(cells)
    assert np.asarray(with_dates(cells, ["2024-03-31"] * N)).tolist() == (60.0 * np.arange(N)).tolist()
    path = written(tmp_path / "a.csv", "Date,Time,u,y\n" + rows(["31.03.2024"] * N, cells, U, Y))
    assert read(path)[0] == pytest.approx(60.0 * np.arange(N))


def test_dates_alone_are_days_and_spans_of_pandas_are_seconds() -> None:
    assert np.asarray(clock(["2024-02-28", "2024-02-29", "2024-03-01"])).tolist() == [0.0, 86400.0, 172800.0]
    assert np.asarray(clock(["0 days 00:00:01.5", "1 days 00:00:00", "-1 days +23:59:59.5"])).tolist() == [
        1.5,
        86400.0,
        -0.5,
    ]
    with pytest.raises(InputError, match="one reading"):
        clock(["01/02/24", "02/02/24", "03/02/24"])
    notes: list[str] = []
    assert np.asarray(clock(["59:59.5", "00:00.5"], notes)).tolist() == [0.0, 1.0]
    assert notes == ["a full hour is passed (1x): minutes that fall by half an hour are those of the next one"]


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([(36600.0, 69000.0), (730500.0, 748700.0), (2451545.0, 2469800.0)]),
    st.floats(0.0, 1.0),
    st.sampled_from([0.001, 0.01, 0.02, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0, 300.0, 600.0, 900.0, 1800.0, 3600.0]),
)
def test_days_are_never_taken_for_seconds(years: tuple[float, float], part: float, step: float) -> None:
    begin = years[0] + part * (years[1] - years[0])
    stamps = begin + np.arange(2000) * step / 86400
    with pytest.raises(InputError, match="may count days"):
        refuse_unlikely_seconds(stamps, "time")


@given(st.floats(0.0, 86000.0), st.sampled_from([10, 20, 25, 30, 50, 60, 100, 120, 125, 200, 240, 250, 400, 500, 1000]))
def test_seconds_of_the_day_at_usual_rates_are_seconds(begin: float, rate: float) -> None:
    refuse_unlikely_seconds(begin + np.arange(500) / rate, "time")


def test_the_remedy_for_days_works(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", "time,u,y\n" + rows([f"{45382.5 + t / 86400:.12f}" for t in TIME], U, Y))
    with pytest.raises(InputError, match="--unit time=d"):
        read(path)
    assert read(path, unit={"time": "d"})[0] == pytest.approx(TIME, abs=1e-5)


# ---- numbers ------------------------------------------------------------------------------------------------------


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.integers(0, 30_000), min_size=30, max_size=60),
    st.sampled_from([".", ",", "'", "’", " ", "\u202f", "\u00a0"]),
    st.sampled_from([";", "\t"]),
    st.booleans(),
)
def test_thousands_in_a_file_are_read_right_or_refused(
    tmp_path_factory: pytest.TempPathFactory, values: list[int], sign: str, delimiter: str, commas: bool
) -> None:
    cells = [f"{value:,}".replace(",", sign) for value in values]
    other = [f"{0.25 * k:.2f}".replace(".", "," if commas else ".") for k in range(len(values))]
    path = written(tmp_path_factory.mktemp("t") / "a.csv", f"x{delimiter}n\n" + rows(other, cells, sign=delimiter))
    try:
        found = TextFile(path).values("n")
    except InputError:
        return
    if sign == "," and commas:  # the table says what its commas are
        return
    if sign == "." and sum("." in cell for cell in cells) < 3:  # two numbers say nothing of a column
        return
    assert found.tolist() == values


@given(
    st.lists(st.floats(-1e7, 1e7).map(lambda x: round(x, 2)), min_size=5, max_size=30),
    st.sampled_from([(".", ","), (",", "."), ("'", "."), (" ", ","), ("\u202f", ","), ("\u00a0", ".")]),
)
def test_signs_between_thousands_are_left_out_where_decimals_show_them(
    values: list[float], signs: tuple[str, str]
) -> None:
    values = [*values, 12345.25]
    cells = [f"{value:,.2f}".replace(",", "_").replace(".", signs[1]).replace("_", signs[0]) for value in values]
    notes: list[str] = []
    assert numbers_of(cells, str, notes).tolist() == values
    assert len(notes) == 1
    assert "between thousands are left out" in notes[0]


def test_a_point_beside_decimal_commas_is_refused(tmp_path: Path) -> None:
    text = "x;n\n" + rows(["0,25"] * 30, [f"{1000 + k:,}".replace(",", ".") for k in range(30)], sign=";")
    with pytest.raises(InputError, match=r"line 2, column 'n': a number with two readings"):
        TextFile(written(tmp_path / "a.csv", text)).values("n")
    plain = text.replace("0,25", "0.25")
    assert TextFile(written(tmp_path / "b.csv", plain)).values("n")[0] == 1.0


def test_two_numbers_in_every_cell_are_no_thousands() -> None:
    with pytest.raises(InputError, match="no number"):
        numbers_of(["10 100", "12 101", "13 102"], str)


@pytest.mark.parametrize("cell", ["1.#QNAN", "-1.#IND", "#DIV/0!", "-nan(ind)", "#NUM!"])
def test_what_programs_write_for_nothing_is_missing(cell: str) -> None:
    found = numbers_of(["1.5", cell, "2.5"], str)
    assert np.isnan(found).tolist() == [False, True, False]


def test_a_dash_for_a_minus() -> None:
    assert numbers_of(["–0.5", "－2"], str).tolist() == [-0.5, -2.0]
    with pytest.raises(InputError, match="no number"):
        numbers_of(["1–5"], str)


# ---- titles and units ---------------------------------------------------------------------------------------------


def test_an_index_in_brackets_is_no_unit(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", "time,q[0],q[1],q[2]\n" + rows(TIME, U, Y, Y))
    _t, u, y, _ = read(path, input="q[0]", output="q[1]", unit={"q[1]": "deg"})
    assert u == pytest.approx(U)
    assert y == pytest.approx(np.radians(Y))
    assert split_header("q[12]") == ("q[12]", None)
    assert split_header("x [1]") == ("x", "1")
    assert Table(path).split("q[1]") == ("q[1]", None)
    assert Table(written(tmp_path / "b.csv", "time,share[1]\n0,1\n1,2\n")).split("share[1]") == ("share", "1")


@pytest.mark.parametrize("unit", ["NM", "g", "G", "MM", "grados", "градусы", "度"])
def test_a_unit_with_two_readings_is_refused_where_nothing_decides(unit: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", f"time [s],u [V],y [{unit}]\n" + rows(TIME, U, Y))
    with pytest.raises(InputError, match="two readings"):
        read(path)
    assert read(path, unit={"y": "V"})[2] == pytest.approx(Y)


@pytest.mark.parametrize(
    ("unit", "like", "factor"),
    [
        ("об/мин", "rad/s", 2 * np.pi / 60),
        ("Н·м", "N m", 1.0),
        ("мВ", "V", 1e-3),
        ("м/с²", "m/s^2", 1.0),
        ("рад/с", "rad/s", 1.0),
        ("牛·米", "N m", 1.0),
        ("度/秒", "rad/s", np.pi / 180),
        ("tr/min", "rad/s", 2 * np.pi / 60),
        ("Umdrehungen/min", "rpm", 1.0),
        ("grados", "rad", np.pi / 180),
    ],
)
def test_units_in_other_languages(unit: str, like: str, factor: float) -> None:
    assert convert(np.array([2.0]), unit, like) == pytest.approx(2.0 * factor)


@pytest.mark.parametrize(
    ("coding", "head", "name"),
    [
        ("cp1251", "Время [с],u [В],y [В]", "Cyrillic"),
        ("koi8-r", "Время [с],u [В],y [В]", "Russian"),
        ("gb18030", "时间 [秒],u [伏],y [伏]", "Chinese"),
        ("cp932", "時間 [秒],u [V],y [V]", "Japanese"),
        ("cp949", "시간 [초],u [V],y [V]", "Korean"),
        ("cp1250", "čas [s],u [V],y [V]", "Central Europe"),
        ("cp1250", "# położenie kąta\nt [s],u [V],y [V]", "Windows, Central Europe"),
        ("iso8859-2", "# ciśnienie\nt [s],u [V],y [V]", "iso8859-2"),
        ("cp1252", "durée [s],u [V],y [V]", "Western Europe"),
    ],
)
def test_codings_are_told_by_their_words(coding: str, head: str, name: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", (head + "\n" + rows(TIME, U, Y)).encode(coding))
    assert any(name in note for note in same(path))


# ---- headers ------------------------------------------------------------------------------------------------------

LVM = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\t\n"
    "Channels\t2\t\nSamples\t60\t60\nY_Unit_Label\tVolts\tVolts\nX0\t0.0\t0.0\nDelta_X\t0.01\t0.01\n"
    "***End_of_Header***\t\t\nX_Value\tu\ty\tComment\n"
)


def test_headers_of_labview(tmp_path: Path) -> None:
    table = [f"{t:.6f}\t{u}\t{y}\t\n" for t, u, y in zip(TIME, U, Y, strict=True)]
    same(written(tmp_path / "a.lvm", LVM + "".join(table)), column={"time": "X_Value"})
    commas = [line.replace(".", ",") for line in table]
    same(written(tmp_path / "b.lvm", LVM + "".join(commas)), column={"time": "X_Value"})


@pytest.mark.parametrize("mark", [";", "//", "!", "*"])
def test_comments_above_a_table(mark: str, tmp_path: Path) -> None:
    text = f"{mark} made by a robot, {mark} of 4\n{mark} second\nt u y\n" + rows(TIME, U, Y, sign=" ")
    notes = same(written(tmp_path / "a.txt", text))
    assert any("lines 1 to 2 stand above the table" in note for note in notes)


def test_lines_above_columns_that_stand_apart_by_blanks(tmp_path: Path) -> None:
    text = "Robot log version 4 of the cell\nstarted by hand\n t u y\n" + rows(TIME, U, Y, sign="  ")
    same(written(tmp_path / "a.txt", text))
    two = "t u\n" + rows(TIME[:30], U[:30], sign=" ") + "t u y\n" + rows(TIME, U, Y, sign=" ")
    with pytest.raises(InputError):
        read(written(tmp_path / "b.txt", two))


def test_a_rule_below_the_titles_is_no_row(tmp_path: Path) -> None:
    text = " t | u | y \n---+---+---\n" + rows(TIME, U, Y, sign=" | ")
    same(written(tmp_path / "a.txt", text))


def test_decimal_commas_without_titles(tmp_path: Path) -> None:
    text = rows(*([f"{x:.6f}".replace(".", ",") for x in column] for column in (TIME, U, Y)), sign=";")
    path = written(tmp_path / "a.csv", text)
    assert read(path, input="1", output="2", column={"time": "0"})[1] == pytest.approx(U)


MOTION = "Rate,100\n\n,,left,,right\nFrame,Time,X,Y,X\n,s,mm,mm,mm\n"


def test_headers_of_motion_capture_and_merged_cells(tmp_path: Path) -> None:
    table = "".join(f"{k},{TIME[k]},{U[k]},{0},{Y[k]}\n" for k in range(N))
    path = written(tmp_path / "a.csv", MOTION + table)
    t, u, y, notes = read(path, input="left.X", output="right.X")
    assert t == pytest.approx(TIME)
    assert u == pytest.approx(1e-3 * U)
    assert y == pytest.approx(1e-3 * Y)
    assert any("lines 3 to 5 are read as one header" in note for note in notes)


def test_a_workbook_with_merged_headers(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Zeit", "Motor", None], [None, "u", "y"], ["s", "V", "deg"]):
        book.active.append(row)
    for row in zip(TIME.tolist(), U.tolist(), Y.tolist(), strict=True):
        book.active.append(row)
    book.active.merge_cells("B1:C1")
    book.save(tmp_path / "a.xlsx")
    assert any("rows 1 to 3 are read as one header" in note for note in same(tmp_path / "a.xlsx", np.pi / 180))


@pytest.mark.parametrize(
    "head",
    [
        [["t", "u", "y"], ["0", "1", "2"]],
        [["t", "u", "y"], ["s", "V", "rad"], ["0", "1", "2"]],  # a row of units is the other reader's
        [["t", "u", "y"], ["start", "go", "stop"], ["0", "1", "2"]],  # two rows that may be the names
        [["t", "u", "y"], ["double", "double", "double"], ["a", "b", "2"]],  # no row of numbers
    ],
)
def test_one_header_or_none(head: list[list[str]]) -> None:
    assert stacked_titles(head) is None


def test_types_below_the_titles_are_no_names() -> None:
    assert stacked_titles([["t", "u", "y"], ["double", "double", "double"], ["0", "1", "2"]]) == (["t", "u", "y"], 2)


# ---- binary files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["Unit", "UNITS", "units", "unit"])
@pytest.mark.parametrize(
    "form", [str, np.bytes_, lambda text: np.array([text.encode()])], ids=["text", "bytes", "array"]
)
def test_units_of_hdf5_in_any_form(key: str, form: Callable[[str], Any], tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values, unit in (("time", 1e3 * TIME, "ms"), ("u", U, "V"), ("y", Y, "deg")):
            file.create_dataset(name, data=values).attrs[key] = form(unit)
        file.create_dataset("notes", data=["by hand", "of Monday"])  # texts beside the numbers
    same(tmp_path / "a.h5", np.pi / 180)


def test_netcdf_of_the_classic_format_names_its_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nccopy -k nc4"):
        read(written(tmp_path / "a.nc", b"CDF\x01" + bytes(60)))


def test_arrays_of_simulink_and_sparse_matrices(tmp_path: Path) -> None:
    from scipy.io import savemat
    from scipy.sparse import csc_matrix

    both = np.stack([U, Y]).reshape(2, 1, -1)
    savemat(tmp_path / "a.mat", {"t": TIME, "u": csc_matrix(U[:, None]), "y": Y.reshape(1, 1, -1), "both": both})
    same(tmp_path / "a.mat")
    same(tmp_path / "a.mat", input="both[0]", output="both[1]")
    assert Table(tmp_path / "a.mat").inside("both") == ["both[0]", "both[1]"]
    savemat(tmp_path / "b.mat", {"t": TIME, "u": U, "y": Y + 1j, "data": np.c_[TIME, U, Y]})
    with pytest.raises(InputError, match="real and imaginary part"):
        read(tmp_path / "b.mat")
    same(tmp_path / "b.mat", input="data[:,1]", output="data[:,2]", column={"time": "data[:,0]"})


def test_parquet_of_pandas_with_an_index_of_times_texts_and_structs(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    stamps = pa.array((TIME * 1e6).round().astype(np.int64), pa.timestamp("us"))
    inside = pa.array([{"u": float(u)} for u in U])
    texts = pa.array([str(y).replace(".", ",") for y in Y])
    parquet.write_table(pa.table({"m": inside, "y": texts, "__index_level_0__": stamps}), tmp_path / "a.parquet")
    same(tmp_path / "a.parquet", input="m.u")
    days = pa.array(np.arange(N, dtype=np.int32), pa.date32())
    parquet.write_table(pa.table({"time": days, "u": U, "y": Y}), tmp_path / "b.parquet")
    assert read(tmp_path / "b.parquet")[0] == pytest.approx(86400.0 * np.arange(N))
    cells = pa.array([f"2024-03-31 00:00:{t:09.6f}" for t in TIME])
    parquet.write_table(pa.table({"time": cells, "u": U, "y": Y}), tmp_path / "c.parquet")
    same(tmp_path / "c.parquet")


def test_what_mdf_says_of_its_channels_counts(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    bits = np.arange(N) % 20 == 3
    pair = np.rec.fromarrays([np.c_[Y, Y]], dtype=[("pair", "<f8", (2,))])
    log = asammdf.MDF(version="4.10")
    log.append(
        [
            asammdf.Signal(U, TIME, name="u", unit="V"),
            asammdf.Signal(Y, TIME, name="y", unit="V", invalidation_bits=bits),
            asammdf.Signal(Y, TIME, name="z", unit="V"),
            asammdf.Signal(np.array([b"on"] * N), TIME, name="state", encoding="utf-8"),
            asammdf.Signal(pair, TIME, name="pair"),
        ]
    )
    log.save(tmp_path / "a.mf4", overwrite=True)
    log.close()
    table = Table(tmp_path / "a.mf4")
    assert np.isnan(table.read("y")[0]).tolist() == bits.tolist()
    same(tmp_path / "a.mf4", output="z")
    with pytest.raises(InputError, match="a column of numbers, got texts"):
        read(tmp_path / "a.mf4", output="state")
    with pytest.raises(InputError, match="a column of numbers, got an array"):
        read(tmp_path / "a.mf4", output="pair")
    (tmp_path / "b.dat").write_bytes((tmp_path / "a.mf4").read_bytes())  # as INCA calls it
    same(tmp_path / "b.dat", output="z")


# ---- formats ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".rar", ".ulg", ".blf", ".xls", ".weird", ""])
def test_a_format_that_is_not_read_is_called_so(suffix: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"a{suffix}", "t,u,y\n" + rows(TIME, U, Y))
    for options in ({"input": "u", "output": "y"}, {"model": "pendulum"}, {}):
        with pytest.raises(InputError, match="unknown format"):
            load_dataset(path, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("above", "sign"), [
    ("name: rig\ntime u y\n---- - -\n", " "),
    (" time | u | y \n------+---+---\n", " | "),
    ("Rig 4\n=====\n\ntime;u;y\n-----;---;---\n", ";"),
])  # fmt: skip
def test_rules_above_the_rows_are_no_rows(tmp_path: Path, above: str, sign: str) -> None:
    same(written(tmp_path / "log.txt", above + rows(TIME, U, Y, sign=sign)))


def test_a_decimal_comma_in_one_column_tells_what_it_is_in_others(tmp_path: Path) -> None:
    comma = [[f"{value:.3f}".replace(".", ",") for value in column] for column in (100 + np.arange(N), Y)]
    path = written(tmp_path / "log.csv", "t [ms];u;y\n" + rows((1e3 * TIME).round().astype(int), *comma, sign=";"))
    assert read(path)[1] == pytest.approx(100.0 + np.arange(N))
    text = path.read_text().replace("t [ms];u;y", "t [ms];u")
    with pytest.raises(InputError, match="none for thousands"):
        read(
            written(
                path, "\n".join(line.rpartition(";")[0] if k else line for k, line in enumerate(text.splitlines()))
            ),
            output="u",
            input="none",
        )


@pytest.mark.parametrize("title", ["y[1][mm]", "y(1) [mm]", "y[1] (mm)"])
def test_an_index_before_a_unit_is_a_part_of_the_name(tmp_path: Path, title: str) -> None:
    path = written(tmp_path / "log.csv", f"time [s],u [V],{title}\n" + rows(TIME, U, Y))
    name = title.removesuffix("[mm]").removesuffix("(mm)").strip()
    same(path, 1e-3, output=name)
    assert load_dataset(path, input="u", output=name).dataset.spec.outputs[0].name == name


@pytest.mark.parametrize("steps", [(1, 2, 1, 3), (0.4, 1.7, 0.8, 1.1)])
def test_where_a_split_would_leave_nothing_a_grid_is_the_remedy(tmp_path: Path, steps: tuple[float, ...]) -> None:
    time = DT * np.cumsum(np.tile(steps, N // len(steps)))
    path = written(tmp_path / "log.csv", "time [s],u [V],y [m]\n" + rows(time.round(6), U, Y))
    with pytest.raises(InputError, match=r"declare \[resample\], and intersample"):
        load_dataset(path, input="u", output="y")
    (tmp_path / "dataset.toml").write_text(
        'name = "x"\nintersample = "zoh"\n[resample]\nsample_time = 0.02\n[signals.u]\nrole = "input"\n'
        '[signals.y]\nrole = "output"\n[[runs]]\nfile = "log.csv"\n'
    )
    (run,) = load_dataset(tmp_path / "dataset.toml").dataset
    assert run.trajectory.t[-1] - run.trajectory.t[0] == pytest.approx(time[-1] - time[0], abs=0.02)


def test_a_unit_that_a_title_seems_to_say_is_not_called_declared(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", "time [s],u,y_deg\n" + rows(TIME, U, Y))
    (said,) = [note for note in same(path, output="y_deg") if "seems to say" in note]
    assert "--unit y_deg=deg" in said
    same(path, np.pi / 180, output="y_deg", unit={"y_deg": "deg"})
    with pytest.raises(InputError, match="did you mean 'y_deg'"):
        load_dataset(path, input="u", output="y")


@pytest.mark.parametrize("suffix", [".log", ".asc", ".prn", ".tab", ".lvm", ".dat"])
def test_tables_in_text_by_other_names(suffix: str, tmp_path: Path) -> None:
    same(written(tmp_path / f"a{suffix}", "t,u,y\n" + rows(TIME, U, Y)))


@pytest.mark.parametrize("begin", [b"PAR1\x15\x04", b"\x89HDF\r\n\x1a\n", b"PK\x03\x04", b"MATLAB 5.0 MAT"])
def test_a_binary_file_that_is_called_csv_is_told_by_its_beginning(begin: bytes, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another format") as caught:
        Table(written(tmp_path / "a.csv", begin + bytes(200)))
    assert re.search(r"rename it to end in \.\w+", str(caught.value))


def test_an_input_that_alternates_from_row_to_row_is_constant_in_every_second_one() -> None:
    from harness.data.conditioning.suspicion import swapped_in_and_out
    from harness.signals import Channel, PlantSpec, Trajectory

    u = np.tile([1.0, -1.0], 200)[:, None]
    y = np.cumsum(u, axis=0) + 0.1 * RNG.normal(size=(400, 1))
    spec = PlantSpec((Channel("u"),), (Channel("y"),), 0.1)
    assert swapped_in_and_out(Trajectory(np.arange(400) * 0.1, u, y, spec)) == []


@pytest.mark.parametrize(
    ("title", "scale"),
    [("y [mV/V]", 1e-3), ("y [um/m]", 1e-6), ("y [g/kg]", 1e-3), ("y (V·V⁻¹)", 1.0), ("y (m·s⁻¹)", 1.0)],
)
def test_a_share_of_like_units_and_raised_signs_are_read(tmp_path: Path, title: str, scale: float) -> None:
    path = written(tmp_path / "log.csv", f"time [s],u [V],{title}\n" + rows(TIME, U, Y))
    same(path, scale)
