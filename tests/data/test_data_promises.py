"""What is said of much: the first few are listed, and how many more there are; figures against sums done by hand."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.data.conditioning.clock import TimeRules
from harness.data.conditioning.timebase import pieces_of
from harness.data.recipe.sanity import _slope
from harness.data.tables.bags import _types
from harness.data.tables.long_form import in_long_form
from harness.data.tables.merging import merged
from harness.data.tables.text_files import TextFile
from harness.errors import InputError
from harness.signals import FloatArray


def text(folder: Path, lines: list[str]) -> TextFile:
    (folder / "a.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return TextFile(folder / "a.csv")


@pytest.mark.parametrize("again", [1, 2, 6, 7])
def test_lines_that_repeat_the_header_are_no_rows_and_the_first_six_are_named(tmp_path: Path, again: int) -> None:
    head = "time [s],u [V],y [m]"
    lines = [head]
    for k in range(3 * (again + 1)):
        lines += [head] if k and k % 3 == 0 else []
        lines.append(f"{0.1 * k:.1f},1,{k}")
    found = text(tmp_path, lines)
    places = [number for number, line in enumerate(lines, start=1) if line == head][1:]
    said = ", ".join(map(str, places[:6])) + (" ..." if again > 6 else "")
    assert f"line {said} repeats the header: it is no row" in found.notes
    assert found.values("y [m]").tolist() == list(range(3 * (again + 1)))


@pytest.mark.parametrize("comments", [1, 3, 4, 6])
def test_of_comments_among_rows_three_are_named_and_the_others_counted(tmp_path: Path, comments: int) -> None:
    lines = ["u [V],y [m]"]
    for k in range(10):
        lines += [f"{k},{2 * k}"] + (["# a remark"] if k < comments else [])
    found = text(tmp_path, lines)
    assert found.values("y [m]").tolist() == [2.0 * k for k in range(10)]
    named = [note for note in found.notes if "a comment among the rows" in note]
    assert named == [f"line {3 + 2 * k}, a comment among the rows, is left out" for k in range(min(comments, 3))]
    more = [note for note in found.notes if "more comments" in note]
    assert more == ([f"{comments - 3} more comments are left out"] if comments > 3 else [])


def split(counts: list[int], back: bool) -> list[str]:
    """Return what is said of a record that is cut into stretches of so many rows."""
    time = np.concatenate([np.arange(n) * 0.1 + (0.0 if back else 100.0 * k) for k, n in enumerate(counts)])
    rows = np.arange(len(time), dtype=float)
    notes: list[str] = []
    table = np.column_stack([rows % 7, rows])
    found, said = pieces_of(time, table, names=("u", "y"), inputs=(True, False), rules=TimeRules(gaps="split"))
    assert [len(piece.values) for piece in found] == [n for n in counts if n >= 20]
    return [*notes, *said]


@pytest.mark.parametrize("more", [8, 9])
def test_pieces_between_gaps_are_counted_with_the_rows_of_the_first_eight(more: int) -> None:
    counts = [20 + k for k in range(more)] + [5, 3]
    (note,) = [one for one in split(counts, back=False) if one.startswith("gaps: split")]
    sizes = ", ".join(str(20 + k) for k in range(8)) + (" ..." if more > 8 else "")
    assert note.startswith(f"gaps: split into {more} pieces of {sizes} samples; 8 of {sum(counts)} rows dropped")


@pytest.mark.parametrize("more", [6, 7])
def test_records_whose_clock_begins_anew_are_named_by_the_rows_of_the_first_six(more: int) -> None:
    counts = [30 + k for k in range(more)]
    (note,) = [one for one in split(counts, back=True) if "time runs back" in one]
    assert f"so {more} stretches" in note
    begins = re.search(r"begin in (.*?), are records", note)
    assert begins is not None
    rows = [int(number) for number in re.findall(r"\d+", begins[1])]
    starts = np.cumsum([0, *counts])[:6]
    assert np.ptp(np.array(rows) - starts) == 0
    assert begins[1].endswith(" ...") == (more > 6)
    assert "dropped" not in note


@pytest.mark.parametrize(("scale", "turn"), [(1.0, None), (3.0, None), (1.0, 2 * np.pi), (-2.0, 2 * np.pi)])
def test_a_position_is_held_against_the_trapezoids_of_its_rate_whole_turns_left_out(
    scale: float, turn: float | None
) -> None:
    rng = np.random.default_rng(0)
    dt = 0.05
    rate = rng.uniform(-1.0, 1.0, 400) * (0.48 * 2 * np.pi / dt / abs(scale))
    position = np.concatenate([[0.0], np.cumsum(scale * 0.5 * dt * (rate[1:] + rate[:-1]))])
    seen = position if turn is None else position % turn
    assert _slope(seen, rate, dt, turn) == pytest.approx((scale, 1.0), rel=1e-9)
    assert _slope(seen[:9], rate[:9], dt, turn) == (0.0, 0.0)  # fewer than ten rows say nothing
    assert _slope(np.full(400, 2.0), rate, dt, turn) == (0.0, 0.0)


def test_every_definition_of_a_bag_s_message_is_read() -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    rule = "=" * 80 + "\n"
    inner = "module p { module msg { struct Inner { double x; }; }; };\n"
    outer = "module p { module msg { struct Outer { p::msg::Inner a; }; }; };\n"
    data = f"{rule}IDL: p/msg/Outer\n{outer}{rule}IDL: p/msg/Inner\n{inner}"
    made = SimpleNamespace(msgdef=SimpleNamespace(format=SimpleNamespace(name="IDL"), data=data), msgtype="p/msg/Outer")
    store = _types(made, typesys, None)
    assert not isinstance(store, Exception), store
    assert {"p/msg/Inner", "p/msg/Outer"} <= set(store.fielddefs)
    alone = SimpleNamespace(
        msgdef=SimpleNamespace(format=SimpleNamespace(name="IDL"), data=inner), msgtype="p/msg/Inner"
    )
    assert "p/msg/Inner" in _types(alone, typesys, None).fielddefs
    none: Any = SimpleNamespace(msgdef=SimpleNamespace(format=SimpleNamespace(name="NONE"), data=""), msgtype="p/msg/X")
    assert _types(none, typesys, store) is store


@pytest.mark.parametrize("more", [2, 8, 9])
def test_signals_with_clocks_of_their_own_are_named_with_their_steps_and_the_slowest_is_the_remedy(more: int) -> None:
    clocks: list[FloatArray] = [np.arange(50) * 0.01 * (k + 1) for k in range(more)]
    names = [f"s{k}" for k in range(more)]
    with pytest.raises(InputError, match="clocks of their own") as caught:
        merged(clocks, clocks, names=names, inputs=[False] * more, rules=TimeRules(), notes=[])
    assert caught.value.got == ", ".join(f"s{k} every {0.01 * (k + 1):.4g} s" for k in range(min(more, 8)))
    assert f"sample_time = {0.01 * more:.4g} " in caught.value.remedy


@pytest.mark.parametrize("more", [2, 6, 7])
@pytest.mark.parametrize("apart", [False, True])
def test_of_a_table_of_names_and_readings_the_first_six_columns_are_named(
    tmp_path: Path, more: int, apart: bool
) -> None:
    names = [f"s{k}" for k in range(more)]
    rows = [(0.1 * step + (0.01 * k if apart else 0.0), name, 10.0 * k + step) for step in range(20)
            for k, name in enumerate(names)]  # fmt: skip
    lines = ["time [s],name,value", *(f"{at:.2f},{name},{reading}" for at, name, reading in rows)]
    assert in_long_form(text(tmp_path, lines[:-more])) is None  # nineteen readings make no record
    found = in_long_form(text(tmp_path, lines))
    assert found is not None
    assert found.titles == ["time [s]", *names]
    said = ", ".join(names[:6]) + (" ..." if more > 6 else "")
    assert f"'name' names the signal of each row, 'value' its reading: {said} are columns" in found.notes
    for k, name in enumerate(names):
        column = found.values(name)
        assert column[np.isfinite(column)].tolist() == [10.0 * k + step for step in range(20)]
        assert len(column) == (20 * more if apart else 20)
