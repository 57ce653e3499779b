"""Titles in many languages, tables in many dialects and stamps of many clocks: read right or refused, never wrong.

The rates and sizes are chosen so that a unit, a decimal sign or a row that is read wrongly changes the numbers without
leaving what would be refused for its size alone: steps of 0.2 are believed as seconds as well as milliseconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_data import pieces

from harness.data import load_dataset
from harness.data.sections import ResampleSection
from harness.data.tables.headers import clock_of, clock_unit
from harness.errors import InputError

N = 60
RNG = np.random.default_rng(0)
U = np.round(700.0 * RNG.normal(size=N), 3)
Y = np.round(20.0 * np.cumsum(np.cumsum(RNG.normal(size=N))), 3)
MS = np.arange(N) * 25.0

# ---- titles -------------------------------------------------------------------------------------------------------

WORDS = {
    "de": ("Zeit Messzeit Zeitpunkt Zeitstempel Laufzeit", {"ms": "ms msec Millisekunden", "s": "s Sek. Sekunden",
           "min": "min Min. Minuten", "h": "h Std. Stunden", "d": "Tage"}),
    "en": ("time timestamp t elapsed runtime", {"ms": "ms msec. milliseconds", "us": "us µs μs usec", "ns": "ns nsec",
           "min": "min minutes", "h": "h hrs hours", "d": "days"}),
    "fr": ("temps durée horodatage instant", {"ms": "ms millisecondes", "s": "sec. secondes", "h": "heures",
           "d": "jours"}),
    "es": ("tiempo instante", {"ms": "ms milisegundos", "s": "seg segundos", "min": "minutos", "h": "horas",
           "d": "días"}),
    "it": ("tempo istante durata", {"ms": "ms millisecondi", "us": "microsecondi", "min": "minuti", "h": "ore",
           "d": "giorni"}),
    "ja": ("時間 時刻 経過時間 測定時間 タイム", {"ms": "ms ミリ秒", "s": "s 秒", "us": "マイクロ秒", "min": "分"}),
    "zh": ("时间 時間 时间戳 采样时间 时刻", {"ms": "ms 毫秒", "s": "秒", "us": "us 微秒", "min": "分钟", "h": "小时",
           "d": "天"}),
    "ko": ("시간", {"ms": "ms 밀리초", "s": "초", "min": "분"}),
    "ru": ("время", {"ms": "мс", "s": "с сек", "min": "мин минуты", "h": "часы ч"}),
    "nl": ("tijd", {"s": "seconden", "h": "uren", "min": "minuten"}),
}  # fmt: skip
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
FORMS = ("{0} [{1}]", "{0}({1})", "{0} ({1})", "{0}（{1}）", "{0}【{1}】", "{0}［{1}］", "{0}_{1}", "{0}/{1}",
         "{0}, {1}", "{0} {1}", "{0} in {1}", "{0} – {1}", "{0}|{1}", "{0}={1}", "[{1}] {0}", "({1}) {0}", "{0}({1}",
         "{0}<{1}>", "{0} ({1}) raw", "{0}\u00a0{1}")  # fmt: skip
TITLES = [
    (word, spelt, unit)
    for words, units in WORDS.values()
    for word in words.split()
    for unit, spellings in units.items()
    for spelt in spellings.split()
]


def step_of(title: str, number: float = 0.2) -> float:
    """Return the sample time [s] of a table whose clock has this title and steps of 0.2."""
    table = {title: np.arange(N) * number, "u [mN m]": U, "theta [mrad]": Y}
    return load_dataset(table, model="pendulum", column={"time": title}).dataset.spec.sample_time


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(TITLES), st.sampled_from(FORMS), st.sampled_from([str, str.upper, str.capitalize]))
def test_a_unit_of_time_is_read_or_refused_in_every_language(
    case: tuple[str, str, str], form: str, style: object
) -> None:
    word, spelt, unit = case
    title = style(form.format(word, spelt))  # type: ignore[operator]
    try:
        found = step_of(title)
    except InputError:
        assert form not in FORMS[:9] or style is str.upper, f"{title} should be read"
        return
    assert found == pytest.approx(0.2 * SECONDS[unit], rel=1e-6)


@pytest.mark.parametrize(
    "title",
    ["t [10^-3 s]", "t, 10e-3 s", "time x1000", "time*1e3", "time (s/1000)", "time (0.1s)", "time(hh)", "time (mm)",
     "Time(m s)", "時間(時)", "tijd in vaker", "Zeit in Schritten", "Tid (timer)", "time_100ns", "t [Ms]",
     "time [frames]", "经过时间 周期", "tempo, battute"],
)  # fmt: skip
def test_words_where_a_unit_would_stand_are_never_seconds(title: str) -> None:
    with pytest.raises(InputError, match=r"one unit of time.*remedy"):
        step_of(title)


@pytest.mark.parametrize("title", ["time", "Zeit", "Messzeit", "time since start", "经过时间", "t_1", "log time",
                                   "rosbagTimestamp", "elapsed time", "Temps écoulé",
                                   "Tiempo transcurrido"])  # fmt: skip
def test_titles_that_state_no_unit_are_seconds_where_that_may_be(title: str) -> None:
    assert clock_unit(title) is None
    assert step_of(title) == pytest.approx(0.2)
    with pytest.raises(InputError, match="states no unit"):
        step_of(title, 25.0)


def test_a_compound_is_a_clock_only_where_there_is_no_plainer_one() -> None:
    assert clock_of(["Messzeit [ms]", "u", "theta"]) == "Messzeit [ms]"
    assert clock_of(["Zeit [ms]", "Laufzeit [h]", "u"]) == "Zeit [ms]"
    with pytest.raises(InputError, match="2 columns may be the time"):
        clock_of(["Messzeit [ms]", "Laufzeit [h]", "u"])


# ---- dialects -----------------------------------------------------------------------------------------------------


def written(value: float, style: str, decimal: str, thousands: str) -> str:
    """Return a number as a program writes it."""
    text = {"repr": repr(float(value)), "exp": f"{value:.9e}", "D": f"{value:.9E}".replace("E", "D")}.get(style)
    if text is None:
        text = f"{value:,.3f}" if thousands else f"{value:.3f}"
        text = text.replace(",", "T")
    return text.replace(".", decimal).replace("T", thousands)


def changed(kind: str, head: list[str], rows: list[list[str]], end: int) -> tuple[list[str], list[list[str]]]:
    """Return a table with something that programs and people do to it."""
    numbers = [f'"{k + 1}"' for k in range(len(rows))]
    table = {
        "R": (head, [[name, *row] for name, row in zip(numbers, rows, strict=True)]),
        "numbered": (head, [[name.strip('"'), *row] for name, row in zip(numbers, rows, strict=True)]),
        "index": (["", *head], [[name.strip('"'), *row] for name, row in zip(numbers, rows, strict=True)]),
        "doubled": (head, [*rows[:end], rows[end - 1], *rows[end:]]),
        "lost": (head, [*rows[:end], *rows[end + 2 :]]),
        "longer": (head, [row + ["7"] * (k == end) for k, row in enumerate(rows)]),
        "shorter": (head, [row[: 3 - (k == end)] for k, row in enumerate(rows)]),
        "surplus": (head, [[*row, ""] for row in rows]),
        "surplus everywhere": ([*head, ""], [[*row, ""] for row in rows]),
        "units": (["time", "u", "theta"], [["ms", "mNm", "mrad"], *rows]),
        "twice": ([*head, head[2]], [[*row, "1"] for row in rows]),
        "footer": (head, [*rows, ["mean", "0", "0"]]),
        "header again": (head, [*rows[:end], head, *rows[end:]]),
        "nothing": (head, [[row[0], "" if k == end else row[1], row[2]] for k, row in enumerate(rows)]),
        "words": (head, [[row[0], "n.a." if k == end else row[1], row[2]] for k, row in enumerate(rows)]),
    }  # fmt: skip
    return table.get(kind, (head, rows))


@settings(max_examples=80, deadline=None)
@given(
    st.sampled_from([",", ";", "\t", " ", "|", ", ", "; "]),
    st.sampled_from([".", ".", ","]),
    st.sampled_from(["", "", "", ",", ".", "'", " ", "\u202f"]),
    st.sampled_from(["repr", "exp", "D", "fix"]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["none", "titles", "all"]),
    st.sampled_from(["plain", "plain", "R", "numbered", "index", "doubled", "lost", "longer", "shorter", "surplus",
                     "cut", "surplus everywhere", "units", "twice", "footer", "header again", "nothing", "words",
                     "excel", "comments", "title in a comment"]),
    st.integers(1, N - 3),
)  # fmt: skip
def test_a_table_in_any_dialect_is_read_right_or_refused(
    tmp_path_factory: pytest.TempPathFactory, sign: str, decimal: str, thousands: str, style: str, coding: str,
    line: str, quotes: str, kind: str, at: int,
) -> None:  # fmt: skip
    thousands = "" if thousands == decimal or style != "fix" else thousands
    rows = [[written(value, style, decimal, thousands) for value in row] for row in zip(MS, U, Y, strict=True)]
    at += 8 * (36 <= at < 42)  # where the record is divided, a doubled or lost row is in no part's way
    head, rows = changed(kind, ["time [ms]", "u [mNm]", "theta [mrad]"], rows, at)
    titles = [f'"{title}"' for title in head] if quotes != "none" else head
    body = [[cell if cell[:1] == '"' else f'"{cell}"' for cell in row] for row in rows] if quotes == "all" else rows
    lines = [sign.join(titles), *(sign.join(row) for row in body)]
    if kind == "excel":
        lines = [f"sep={sign.strip()}", *lines]
    if kind == "comments":
        lines = ["# rig 3; 7,5 V", *lines]
    if kind == "title in a comment":
        lines[0] = f"# {lines[0]}"
    text = line.join(lines) + line
    if kind == "cut":
        text = text[: -2 - at % 20]
    path: Path = tmp_path_factory.mktemp("dialect") / "a.csv"
    try:
        path.write_bytes(text.encode(coding))
    except UnicodeEncodeError:
        return
    try:
        found = load_dataset(path, model="pendulum").dataset
    except InputError:
        return
    u = np.concatenate([run.trajectory.u[:, 0] for run in found.runs]) * 1e3
    y = np.concatenate([run.trajectory.y[:, 0] for run in found.runs]) * 1e3
    assert found.spec.sample_time == pytest.approx(0.025)
    assert N - 1 <= len(u) <= N
    assert u == pytest.approx(U[: len(u)], abs=1e-6)
    assert y == pytest.approx(Y[: len(y)], abs=1e-6)


ROWS = [",".join(map(repr, map(float, row))) for row in zip(MS, U, Y, strict=True)]
HEAD = "time [ms],u [mNm],theta [mrad]"
READ = {
    "a bar": [line.replace(",", "|") for line in (HEAD, *ROWS)],
    "a space behind the comma, quoted": [
        ", ".join(f'"{cell}"' for cell in line.split(",")) for line in (HEAD, *ROWS)
    ],
    "Excel's hint": ["sep=;", *(line.replace(",", ";") for line in (HEAD, *ROWS))],
    "numpy.savetxt": [f"# {HEAD}", *ROWS],
    "Fortran": [HEAD, *(",".join(written(v, "D", ".", "") for v in row) for row in zip(MS, U, Y, strict=True))],
    "wide brackets": ["时间（毫秒）,u（mNm）,theta（mrad）", *ROWS],
}  # fmt: skip


@pytest.mark.parametrize("lines", READ.values(), ids=list(READ))
def test_dialects_that_are_read(lines: list[str], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = load_dataset(tmp_path / "a.csv", model="pendulum").dataset
    assert sum(len(run.trajectory) for run in found.runs) == N
    assert found.runs[0].trajectory.y[:, 0] == pytest.approx(1e-3 * Y[: len(found.runs[0].trajectory)])


@pytest.mark.parametrize(("style", "lost"), [("exp", 3), ("exp", 1), ("exp", 7), ("fix", 1), ("D", 2)])
def test_a_number_that_was_cut_is_left_out_and_not_taken_for_another(style: str, lost: int, tmp_path: Path) -> None:
    rows = [",".join(written(v, style, ".", "") for v in row) for row in zip(MS, U, Y, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([HEAD, *rows])[:-lost])
    found = load_dataset(tmp_path / "a.csv", model="pendulum").dataset
    assert sum(len(run.trajectory) for run in found.runs) == N - 1
    assert any("cut" in note for note in found.warnings)


# ---- clocks -------------------------------------------------------------------------------------------------------


def told(time: np.ndarray, rows: np.ndarray, **rules: object) -> tuple[list, list[str]]:
    """Return the pieces of a record whose input counts the samples that its rows are, and what is said of them."""
    values = np.column_stack([rows.astype(float), np.sin(0.05 * rows)])
    return pieces(time, values, **rules)


def clocked(time: np.ndarray, rows: np.ndarray, **rules: object) -> list:
    """Return the pieces alone."""
    return told(time, rows, **rules)[0]


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([48.0, 60.0, 100.0, 120.0, 240.0, 1000 / 3, 400.0, 1000.0]),
    st.integers(60, 500),
    st.sampled_from([0.0, 1e-6, 1e-4, 1e-3, 5e-3, 0.01]),
    st.booleans(),
    st.sampled_from([0.0, 0.01, 0.1, 0.3]),
    st.sampled_from(["none", "one", "burst", "many"]),
    st.sampled_from(["none", "one", "many"]),
    st.sampled_from([None, 1.0, 2.0, 0.5, 1.05]),
    st.sampled_from(["refuse", "split"]),
    st.sampled_from(["refuse", "first", "last", "mean"]),
    st.integers(0, 10**6),
)  # fmt: skip
def test_no_row_is_bridged_doubled_or_moved_under_any_clock(
    rate: float, n: int, resolution: float, floor: bool, jitter: float, lost: str, doubled: str, declared: float | None,
    gaps: str, duplicates: str, seed: int,
) -> None:  # fmt: skip
    rng, step = np.random.default_rng(seed), 1 / rate
    time, keep = (np.arange(n) + jitter * rng.uniform(-1, 1, n)) * step + 7.3, np.ones(n, dtype=bool)
    if lost == "one":
        keep[rng.integers(5, n - 5)] = False
    elif lost == "burst":
        keep[(at := rng.integers(5, n - 30)) : at + rng.integers(2, 20)] = False
    elif lost == "many":
        keep = rng.random(n) > 0.03
    rows = np.flatnonzero(keep)
    again = {"none": 0, "one": 1, "many": n // 30}[doubled]
    rows = np.sort(np.concatenate([rows, rng.choice(rows, again, replace=False)]))
    time = time[rows]
    if resolution:
        time = (np.floor if floor else np.round)(time / resolution + 1e-9) * resolution
    sample_time = None if declared is None else declared * step
    try:
        found, notes = told(time, rows, sample_time=sample_time, gaps=gaps, duplicates=duplicates)
    except InputError:
        return
    if any("few lost ones would not show" in note or "have other readings" in note for note in notes):
        return  # said: the stamps cannot tell, or what was declared to count does
    for piece in found:
        assert piece.sample_time == pytest.approx(step, rel=3e-3)
        assert (np.diff(piece.values[:, 0]) == 1).all()


def test_stamps_coarser_than_the_steps_are_no_doubled_rows() -> None:
    time, rows = np.floor(np.arange(240) / 1.2) * 5e-3, np.arange(240)  # 240 Hz under stamps of 5 ms
    for duplicates in ("first", "last", "mean"):
        with pytest.raises(InputError, match=r"repeat the time stamp.*with other readings.*declare sample_time"):
            clocked(time, rows, duplicates=duplicates)
    assert len(clocked(time, rows, sample_time=1 / 240)[0].values) == 240  # the remedy
    twice = np.repeat(np.arange(100), 2)
    assert len(clocked(0.01 * twice, twice, duplicates="first")[0].values) == 100  # every row written twice


def test_a_clock_that_is_rounded_up_half_of_the_time_is_found_beside_a_hole() -> None:
    rows = np.delete(np.arange(185), 90)
    time = np.floor(rows * 2.5 + 1e-9) * 1e-3
    (first, second) = clocked(time, rows, gaps="split", resample=ResampleSection(), intersample="zoh")
    assert first.sample_time == pytest.approx(2.5e-3, rel=1e-3)
    assert (np.diff(first.values[:, 0]) == 1).all()
    assert (np.diff(second.values[:, 0]) == 1).all()


def test_a_declared_clock_that_sharp_stamps_contradict_is_refused() -> None:
    rows = np.delete(np.arange(100), [30, 31, 70])
    with pytest.raises(InputError, match="disagrees with sample_time"):
        clocked(rows * 2.5e-3, rows, sample_time=1.01 * 2.5e-3, gaps="split")


def test_two_rows_in_one_sample_are_refused_where_they_are_apart() -> None:
    time, rows = np.arange(100) * 0.01, np.arange(100)
    time[40:] -= 0.006
    time[45:] += 0.006
    with pytest.raises(InputError, match="two rows in one sample"):
        clocked(time, rows, sample_time=0.01, duplicates="first")
