"""What a refusal names as its remedy is tried: with it the record is read as it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.cli.app import app
from harness.data import load_dataset
from harness.data.conditioning.clock import sample_time_of
from harness.data.recipe.contents import contents_of
from harness.data.recipe.draft import draft_dataset
from harness.errors import InputError
from harness.signals import Dataset, Trajectory

N, DT = 120, 0.01
TIME = np.round(np.arange(N) * DT, 6)
RNG = np.random.default_rng(49)
TORQUE = np.round(RNG.normal(size=N), 5)
ANGLE = np.round(np.cumsum(np.cumsum(TORQUE)) * 1e-3, 6)
HEAD = "time [s],u [N m],theta [rad]"
ROWS = [f"{t:g},{u},{y}" for t, u, y in zip(TIME, TORQUE, ANGLE, strict=True)]
Change = Callable[[list[str]], list[str]]


def csv(folder: Path, lines: Sequence[str], name: str = "log.csv") -> Path:
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def recipe(folder: Path, top: str = "", below: str = "", unit: str = "") -> Path:
    text = f'name = "x"\n{top}\n[nominal]\nmodel = "pendulum"\n{below}\n[signals.u]\nrole = "input"\n'
    text += f'[signals.theta]\nrole = "output"\n{unit}\n[[runs]]\nfile = "log.csv"\n'
    (folder / "dataset.toml").write_text(text)
    return folder / "dataset.toml"


def rows_of(record: Trajectory) -> int:
    """Return the row of the truth with which a record begins; all its rows are those behind it."""
    begin = int(np.argmin(np.abs(ANGLE - record.y[0, 0])))
    assert record.u[:, 0] == pytest.approx(TORQUE[begin : begin + len(record)])
    assert record.y[:, 0] == pytest.approx(ANGLE[begin : begin + len(record)])
    return begin


def lengths(data: Dataset) -> list[tuple[int, int]]:
    assert data.spec.sample_time == pytest.approx(DT, rel=1e-3)
    return [(rows_of(run.trajectory), len(run.trajectory)) for run in data]


# ---- clocks that begin anew -----------------------------------------------------------------------------------------


def stamped(stamps: np.ndarray) -> list[str]:
    return [f"{t:.6g},{u},{y}" for t, u, y in zip(stamps, TORQUE, ANGLE, strict=True)]


@pytest.mark.parametrize("again", [[], [HEAD]], ids=["rows", "header and rows"])
@pytest.mark.parametrize("set_back", [TIME[50] + DT, 0.35, 3600.0], ids=["anew", "set back", "an hour"])
def test_a_clock_that_begins_anew_is_refused_and_split(again: list[str], set_back: float, tmp_path: Path) -> None:
    lines = stamped(np.where(np.arange(N) < 51, TIME, TIME - set_back) + 5000)
    path = csv(tmp_path, [HEAD, *lines[:51], *again, *lines[51:]])
    with pytest.raises(InputError, match=rf'line {53 + len(again)}: time runs back.*gaps = "split".*--gaps split'):
        load_dataset(path, model="pendulum")
    data = load_dataset(path, model="pendulum", gaps="split").dataset  # rows 0 to 80 learn, the others validate
    assert lengths(data) == [(0, 51), (51, 29), (80, 40)]
    assert any(f"line 2, line {53 + len(again)}, are records of their own" in note for note in data.warnings)
    assert contents_of(path).back == 1
    assert '# gaps = "split"  # 1 rows where time runs back' in draft_dataset([path], model="pendulum")


def test_rows_that_are_shuffled_are_to_be_sorted(tmp_path: Path) -> None:
    path = csv(tmp_path, [HEAD, *ROWS[::-1]])
    with pytest.raises(InputError, match=r"time runs back.*remedy: sort the rows"):
        load_dataset(path, model="pendulum")
    with pytest.raises(InputError, match="time runs back"):  # nothing is left between the cuts
        load_dataset(path, model="pendulum", gaps="split")


def test_short_stretches_between_restarts_are_dropped_and_counted(tmp_path: Path) -> None:
    lines = [*ROWS[:30], *ROWS[10:15], *ROWS[5:12], *ROWS[30:]]  # what was there is written once more
    data = load_dataset(csv(tmp_path, [HEAD, *lines]), model="pendulum", gaps="split").dataset
    assert lengths(data) == [(0, 30), (30, 46), (76, 44)]
    assert any("5 of 88 rows dropped (in stretches" in note for note in data.warnings)
    assert any("7 of 53 rows dropped (empty, or in pieces" in note for note in data.warnings)


# ---- headers among the rows -----------------------------------------------------------------------------------------


def test_nothing_parts_the_rows_of_a_table_without_a_clock(tmp_path: Path) -> None:
    bare = ["u [N m],theta [rad]", *(row.split(",", 1)[1] for row in ROWS)]
    for between in ([""], ["", ""], ["", "# second run", ""]):
        with pytest.raises(InputError, match=r"an empty line among the rows.*file of its own"):
            load_dataset(csv(tmp_path, [*bare[:60], *between, *bare[60:]]), model="pendulum", sample_time=DT)
    data = load_dataset(csv(tmp_path, [*bare[:60], "# bump", *bare[60:]]), model="pendulum", sample_time=DT).dataset
    assert any("line 61, a comment among the rows" in note for note in data.warnings)
    doubled = [line for row in bare for line in (row, "")]  # what \r\r\n makes of every line
    remarks = [f"{bare[0]},remark", *(row + (',"a\n\nb"' if k == 7 else ",") for k, row in enumerate(bare[1:]))]
    for lines in (doubled, [*bare, "", ""], ["", *bare], remarks):
        data = load_dataset(csv(tmp_path, lines), model="pendulum", sample_time=DT).dataset
        assert lengths(data) == [(0, 80), (80, 40)]
    timed = load_dataset(csv(tmp_path, [HEAD, *ROWS[:60], "", *ROWS[60:]]), model="pendulum").dataset
    assert lengths(timed) == [(0, 80), (80, 40)]


@pytest.mark.parametrize("head", [[HEAD], ["time,u,theta", "s,N m,rad"]], ids=["titles", "titles and units"])
def test_a_header_that_stands_again_is_no_row(head: list[str], tmp_path: Path) -> None:
    data = load_dataset(csv(tmp_path, [*head, *ROWS[:30], *head, *ROWS[30:70], *head, *ROWS[70:]]), model="pendulum")
    assert lengths(data.dataset) == [(0, 80), (80, 40)]
    assert any(f"line {len(head) + 31}" in note and "repeats the header" in note for note in data.dataset.warnings)


def test_another_header_is_never_skipped(tmp_path: Path) -> None:
    turned = [",".join(np.array(row.split(","))[[0, 2, 1]]) for row in ROWS]
    for head, rows in (("time [s],theta [rad],u [N m]", turned), ("time [s],u [N m],theta [deg]", ROWS)):
        with pytest.raises(InputError, match=r"line 42: another header among the rows.*file of its own"):
            load_dataset(csv(tmp_path, [HEAD, *ROWS[:40], head, *rows[40:]]), model="pendulum")
    bare = [row.split(",", 1)[1] for row in ROWS]  # no clock would show what is lost between two records
    with pytest.raises(InputError, match="line 42: another header"):
        load_dataset(csv(tmp_path, ["u [N m],theta [rad]", *bare[:40], "u [N m],theta [rad]", *bare[40:]]),
                     model="pendulum", sample_time=DT)  # fmt: skip
    with pytest.raises(InputError, match=r"line 2: two rows of titles.*remove one"):
        load_dataset(csv(tmp_path, ["Zeit,Moment,Winkel", HEAD, *ROWS]), model="pendulum",
                     column={"theta": "Winkel", "u": "Moment"}, unit={"theta": "rad", "u": "N m"})  # fmt: skip


# ---- signals that are filled in turn --------------------------------------------------------------------------------


def blanks(kind: str) -> list[str]:
    cells = [row.split(",") for row in ROWS]
    if kind == "slow output":
        return [",".join((t, u, y if k % 2 == 0 else "")) for k, (t, u, y) in enumerate(cells)]
    if kind == "own rows":
        return [line for t, u, y in cells for line in (f"{t},{u},", f"{float(t) + 0.001:.6g},,{y}")]
    return [line for t, u, y in cells for line in (f"{t},{u},", f"{t},,{y}")]


def test_rows_of_one_stamp_that_complement_each_other_are_one(tmp_path: Path) -> None:
    data = load_dataset(csv(tmp_path, [HEAD, *blanks("one stamp")]), model="pendulum").dataset
    assert lengths(data) == [(0, 80), (80, 40)]
    assert any("put together by their stamps" in note for note in data.warnings)
    twice = [*blanks("one stamp")[:40], ROWS[20], *blanks("one stamp")[40:]]  # once more: which of two counts?
    with pytest.raises(InputError, match="stands still"):
        load_dataset(csv(tmp_path, [HEAD, *twice]), model="pendulum")


def test_a_slow_output_is_resampled(tmp_path: Path) -> None:
    path = csv(tmp_path, [HEAD, *blanks("slow output")])
    for said in ({}, {"gaps": "split"}):  # no piece is left between the gaps
        with pytest.raises(InputError, match=r"filled in turn") as refused:
            load_dataset(path, model="pendulum", **said)  # type: ignore[arg-type]
        assert "[resample] sample_time = 0.02" in str(refused.value)
    record = load_dataset(recipe(tmp_path, below="[resample]\nsample_time = 0.02")).dataset.estimation[0]
    assert record.y[:, 0] == pytest.approx(ANGLE[::2])
    assert record.u[:-1, 0] == pytest.approx(TORQUE.reshape(-1, 2).mean(axis=1)[: len(record) - 1])
    text = draft_dataset([path], model="pendulum")
    assert "# sample_time = 0.02" in text
    assert "60 rows empty" in text


def test_signals_in_rows_of_their_own_are_put_on_one_grid(tmp_path: Path) -> None:
    path = csv(tmp_path, [HEAD, *blanks("own rows")])
    with pytest.raises(
        InputError, match=r"sample_time = 0\.01, or another: signals are filled in turn, and intersample"
    ):
        load_dataset(path, model="pendulum")
    data = load_dataset(recipe(tmp_path, top='intersample = "zoh"', below="[resample]\nsample_time = 0.01")).dataset
    record = data.estimation[0]
    assert len(record) == N
    assert record.y[:, 0] == pytest.approx(ANGLE)
    assert record.u[:, 0] == pytest.approx(0.9 * TORQUE + 0.1 * np.append(TORQUE[1:], TORQUE[-1]))
    assert any("put on one grid of 0.01 s" in note for note in data.warnings)


def test_a_column_without_any_number_is_named(tmp_path: Path) -> None:
    path = csv(tmp_path, [HEAD, *(row.rsplit(",", 1)[0] + "," for row in ROWS)])
    for said in ({}, {"gaps": "split"}):
        with pytest.raises(InputError, match=r"no number in any of 80 rows of theta.*choose another column"):
            load_dataset(path, model="pendulum", **said)  # type: ignore[arg-type]
    assert 'role = "output"  # 120 rows empty' in draft_dataset([path], model="pendulum")  # still TOML


def test_rows_without_anything_are_no_rows(tmp_path: Path) -> None:
    data = load_dataset(csv(tmp_path, [HEAD, *ROWS[:40], ",,", ",,", *ROWS[40:]]), model="pendulum").dataset
    assert sum(count for _, count in lengths(data)) == N
    assert any("hold nothing" in note for note in data.warnings)
    with pytest.raises(InputError, match="line 42: no time stamp"):
        load_dataset(csv(tmp_path, [HEAD, *ROWS[:40], ",,0.5", *ROWS[40:]]), model="pendulum")


# ---- rough clocks ---------------------------------------------------------------------------------------------------


@given(st.floats(0.05, 0.3), st.integers(60, 400), st.integers(0, 2**31))
def test_the_rate_of_a_rough_clock_is_found(size: float, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = 3.0 + (np.arange(n) + rng.uniform(-size, size, n)) * DT
    assert abs(sample_time_of(np.sort(stamps)) / DT - 1) * n < 1.0  # less than a sample over the record


@pytest.mark.parametrize("seed", range(5))
def test_the_sample_time_that_a_rough_clock_is_answered_with_is_accepted(seed: int, tmp_path: Path) -> None:
    stamps = TIME + np.random.default_rng(seed).uniform(-0.3, 0.3, N) * DT
    path = csv(tmp_path, [HEAD, *stamped(stamps + 1)])
    with pytest.raises(InputError, match="not uniform") as refused:
        load_dataset(path, model="pendulum")
    named = float(str(refused.value).partition("declare sample_time = ")[2].split()[0])
    for said in (named, DT):
        data = load_dataset(path, model="pendulum", sample_time=said).dataset
        assert sum(count for _, count in lengths(data)) == N
    assert "# sample_time = " in draft_dataset([path], model="pendulum")


@pytest.mark.parametrize("seed", range(12))
def test_no_sample_time_is_named_that_would_be_refused(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    steps = [rng.uniform(0.5, 1.5, N), 1 + 0.4 * np.arange(N) / N, np.where(np.arange(N) < 60, 1.0, 1.4)][seed % 3]
    stamps = np.cumsum(steps + rng.normal(0, 0.02 * (seed // 3), N) + (rng.random(N) < 0.03)) * DT
    csv(tmp_path, [HEAD, *stamped(stamps)])
    with pytest.raises(InputError, match="not uniform") as refused:
        load_dataset(recipe(tmp_path))
    said = str(refused.value).partition("remedy: ")[2]
    if "sample_time = " in said:
        named = f"sample_time = {said.partition('sample_time = ')[2].split()[0]}"
        assert load_dataset(recipe(tmp_path, top=named + '\ngaps = "split"')).dataset.runs
    else:
        assert 'gaps = "split"' in said or "[resample]" in said


def test_stamps_of_whole_seconds_count_rows(tmp_path: Path) -> None:
    """All of a run may lie within one second."""
    for stamps in (np.floor(TIME), np.zeros(N)):
        path = csv(tmp_path, [HEAD, *stamped(stamps[:90] if len(stamps) == 90 else stamps)])
        if not stamps.any():
            path = csv(tmp_path, [HEAD, *stamped(stamps)[:90]])
        data = load_dataset(path, model="pendulum", sample_time=DT).dataset
        assert sum(count for _, count in lengths(data)) == (N if stamps.any() else 90)


# ---- forms of files -------------------------------------------------------------------------------------------------


def test_titles_that_go_on_over_lines_and_frames_around_tables(tmp_path: Path) -> None:
    frame = "+-----+-----+-----+"
    bars = ["| " + " | ".join(row.split(",")) + " |" for row in ROWS]
    for lines in (
        ['"time\n[s]","u\n[N m]","theta\n[rad]"', *ROWS],
        [HEAD + ",remark", *(row + (',"a bump,\nand another"' if k == 7 else ",") for k, row in enumerate(ROWS))],
        [HEAD + ',rod 3"', *(row + ",1" for row in ROWS)],  # an inch opens no quotation
        [HEAD + ",mark", *(row + (f',"m{k}' if k in (20, 24) else ",") for k, row in enumerate(ROWS))],  # never closed
        [frame, "| time [s] | u [N m] | theta [rad] |", frame, *bars, frame],
    ):
        assert lengths(load_dataset(csv(tmp_path, lines), model="pendulum").dataset) == [(0, 80), (80, 40)]
    bare = [row.split(",", 1)[1] + (f',"m{k}' if k in (20, 24) else ",") for k, row in enumerate(ROWS)]
    data = load_dataset(csv(tmp_path, ["u [N m],theta [rad],mark", *bare]), model="pendulum", sample_time=DT).dataset
    assert lengths(data) == [(0, 80), (80, 40)]  # where no clock shows what a quotation swallows
    with pytest.raises(InputError, match="line 12, column 'u"):  # lines are counted as an editor counts them
        load_dataset(csv(tmp_path, ['"time\n[s]","u\n[N m]","theta\n[rad]"', *ROWS[:7], "0.07,x1,0", *ROWS[8:]]),
                     model="pendulum")  # fmt: skip


@pytest.mark.parametrize("begin", ['{"time": 0, "u": 1}', '[{"time": 0}]', "<html><table>", "<?xml version='1.0'?>"])
def test_texts_of_another_format_are_called_so(begin: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a file of another format.*(JSON|XML)"):
        load_dataset(csv(tmp_path, [begin, *ROWS]), model="pendulum")


def test_what_is_refused_is_shown_in_plain_signs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 42: a row of 1 cells") as refused:
        load_dataset(csv(tmp_path, [HEAD, *ROWS[:40], "\0" * 40, *ROWS[40:]]), model="pendulum")
    assert str(refused.value).isprintable()


def test_a_column_by_its_number_where_two_have_one_title(tmp_path: Path) -> None:
    path = csv(tmp_path, [HEAD + ",theta [rad]", *(f"{row},7" for row in ROWS)])
    with pytest.raises(InputError, match=r"there 2 times.*column = 3 in a dataset.toml"):
        load_dataset(path, model="pendulum")
    assert lengths(load_dataset(recipe(tmp_path, unit="column = 2")).dataset) == [(0, N)]


def test_a_unit_that_no_model_has_is_declared_with_its_scale(tmp_path: Path) -> None:
    counts = [",".join((*row.split(",")[:2], f"{1000 * float(row.split(',')[2]):.9g}")) for row in ROWS]
    path = csv(tmp_path, [HEAD.replace("[rad]", "[counts]"), *counts])
    with pytest.raises(InputError, match="declare unit = 'rad' and a scale"):
        load_dataset(path, model="pendulum")
    assert lengths(load_dataset(recipe(tmp_path, unit='unit = "rad"\nscale = 0.001')).dataset) == [(0, N)]


def test_streams_of_arrow_and_objects_of_numpy(tmp_path: Path) -> None:
    import pyarrow as pa

    table = pa.table({"time [ms]": 1e3 * TIME, "u [N m]": TORQUE, "theta [rad]": ANGLE})
    with pa.OSFile(str(tmp_path / "a.arrow"), "wb") as sink, pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    assert lengths(load_dataset(tmp_path / "a.arrow", model="pendulum").dataset) == [(0, 80), (80, 40)]
    np.savez(tmp_path / "a.npz", time=TIME, u=TORQUE.astype(object), theta=ANGLE)
    with pytest.raises(InputError, match=r"Python objects.*array\.astype\(float\)"):
        contents_of(tmp_path / "a.npz")


# ---- from a file to a data set --------------------------------------------------------------------------------------


def drafted(folder: Path, file: str, replaced: dict[str, str]) -> Dataset:
    from typer.testing import CliRunner

    ran = CliRunner().invoke(
        app, ["new", "dataset", str(folder / file), "--model", "pendulum", "--folder", str(folder), "--force"]
    )
    assert ran.exit_code == 0, ran.output
    text = (folder / "dataset.toml").read_text()
    for old, new in replaced.items():
        assert old in text, text
        text = text.replace(old, new)
    (folder / "dataset.toml").write_text(text)
    return load_dataset(folder / "dataset.toml").dataset


def test_a_draft_of_one_record_is_whole(tmp_path: Path) -> None:
    csv(tmp_path, [HEAD, *ROWS])
    data = drafted(tmp_path, "log.csv", {})
    assert [(run.use, len(run.trajectory)) for run in data] == [("estimation", 80), ("validation", 40)]
    csv(tmp_path, [HEAD, *ROWS[:50]])  # too short for two
    assert [run.use for run in drafted(tmp_path, "log.csv", {})] == ["estimation"]


def test_a_draft_never_takes_unlikely_seconds(tmp_path: Path) -> None:
    csv(tmp_path, ["time,u [N m],theta [rad]", *stamped(1e3 * TIME)])
    with pytest.raises(InputError, match=r"time\.unit: an open question"):
        drafted(tmp_path, "log.csv", {})
    assert lengths(drafted(tmp_path, "log.csv", {'unit = "?"': 'unit = "ms"'})) == [(0, 80), (80, 40)]
    csv(tmp_path, ["u [N m],theta [rad]", *(row.split(",", 1)[1] for row in ROWS)])
    with pytest.raises(InputError, match="sample_time: an open question"):
        drafted(tmp_path, "log.csv", {})
    assert lengths(drafted(tmp_path, "log.csv", {'sample_time = "?"': "sample_time = 0.01"})) == [(0, 80), (80, 40)]


def test_a_draft_of_a_workbook_names_its_sheet(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed: pip install 'sysid-harness[data]'")
    book = openpyxl.Workbook()
    book.active.append(["rig", "three"])
    for name, sign in (("run 1", 1.0), ("run 2", -1.0)):
        sheet = book.create_sheet(name)
        sheet.append(["time\n[s]", "u\n[N m]", "theta\n[rad]"])
        for t, u, y in zip(TIME, TORQUE, ANGLE, strict=True):
            sheet.append([float(t), sign * float(u), sign * float(y)])
    book.save(tmp_path / "a.xlsx")
    with pytest.raises(InputError, match=r"2 others do.*'run 1', 'run 2'.*--sheet .run 1."):
        load_dataset(tmp_path / "a.xlsx", model="pendulum")
    assert lengths(drafted(tmp_path, "a.xlsx", {})) == [(0, 80), (80, 40)]
    other = drafted(tmp_path, "a.xlsx", {'sheet = "run 1"': 'sheet = "run 2"'})
    assert other.estimation[0].y[:, 0] == pytest.approx(-ANGLE[:80])
