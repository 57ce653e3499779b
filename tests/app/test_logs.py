"""A plot of few points shows what a plot of all of them would."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.app.logs import Logs, extremes
from harness.errors import InputError


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 20_000), columns=st.integers(1, 300), seed=st.integers(0, 1000), holes=st.integers(0, 3))
def test_each_column_of_pixels_keeps_its_extremes_and_its_holes(n: int, columns: int, seed: int, holes: int) -> None:
    rng = np.random.default_rng(seed)
    y = rng.standard_normal(n).cumsum()
    for place in rng.integers(0, n, holes):
        y[place : place + rng.integers(1, n + 1) // 10 + 1] = np.nan
    rows = extremes(y, columns)
    assert len(rows) <= max(5 * columns, n if n <= 4 * columns else 0)
    assert (np.diff(rows) > 0).all()
    assert rows[0] == 0
    assert rows[-1] == n - 1
    edges = np.linspace(0, n, columns + 1).astype(int)
    for low, high in pairwise(edges):
        if high > low:
            shown, all_ = y[rows[(rows >= low) & (rows < high)]], y[low:high]
            assert np.isnan(shown).any() == np.isnan(all_).any()
            if np.isfinite(all_).any():
                assert (np.nanmin(shown), np.nanmax(shown)) == (np.nanmin(all_), np.nanmax(all_))


def test_a_spike_among_a_million_rows_is_seen_at_every_width() -> None:
    y = np.sin(np.arange(1_000_000) * 1e-3)
    y[654_321] = 40.0
    for columns in (50, 333, 1400):
        rows = extremes(y, columns)
        assert 654_321 in rows
        assert len(rows) <= 4 * columns


def test_a_span_is_drawn_from_its_own_rows_in_the_unit_of_the_clock(folder: Path) -> None:
    (path := folder / "ms.csv").write_text("time [ms],y\n" + "".join(f"{10 * k},{k}\n" for k in range(100)))
    line = Logs().lines(path, ["y"], clock="time [ms]", span=(0.2, 0.3))[0]
    assert line["t"] == pytest.approx([0.01 * k for k in range(19, 32)])
    assert line["y"] == list(range(19, 32))
    between = Logs().lines(path, ["y"], clock="time [ms]", span=(0.202, 0.207))[0]
    assert between["y"] == [20, 21], "between two rows the line that joins them is drawn"


def test_without_a_clock_rows_or_the_sample_time_count(folder: Path) -> None:
    (path := folder / "plain.csv").write_text("y\n1\n2\n\n4\n")
    logs = Logs()
    assert logs.lines(path, ["y"])[0]["t"][:2] == [0.0, 1.0]
    assert logs.lines(path, ["y"], step=0.5)[0]["t"][:2] == [0.0, 0.5]


def test_a_file_that_was_written_anew_is_read_anew(folder: Path) -> None:
    logs, path = Logs(), folder / "log.csv"
    assert logs.describe(path)["rows"] == 400
    path.write_text("time [s],y [m]\n0,1\n1,2\n2,3\n")
    assert logs.describe(path)["rows"] == 3


def test_a_column_that_is_not_there_is_one_line(folder: Path) -> None:
    with pytest.raises(InputError, match="no column 'x'"):
        Logs().lines(folder / "log.csv", ["x"])
