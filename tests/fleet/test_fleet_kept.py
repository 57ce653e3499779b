"""What a fleet keeps and tells, figure by figure: rows, tables, its summary, how likely a change is."""

from __future__ import annotations

import time
from contextlib import contextmanager
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.errors import InputError, PlantError
from harness.fleet import find_records, is_fleet
from harness.fleet.changes import Change, _likeliest, changes, odd_machines
from harness.fleet.records import FleetRecord
from harness.fleet.row import FleetRow, FoundEffect, blank, encoded, fill, read
from harness.fleet.running import FleetResult, _logged, _shown, fleet_table
from harness.fleet.store import FleetStore, is_fleet_folder, query, tables
from harness.fleet.trends import Series, Trend, new_effects, series_of, trends
from harness.fleet.work import RecordJob

NORMAL = 1.959963984540054


def effect(
    name: str = "coulomb", at: str = "q", size: float = 0.1, *, ties: tuple[str, ...] = (), **more: Any
) -> FoundEffect:
    own: dict[str, Any] = {"parameter": "Fc", "low": size - 0.02, "high": size + 0.02, "unit": "N m"} | more
    return FoundEffect(
        name, at, own["parameter"], size, own["low"], own["high"], own["unit"], ties, (own["parameter"], "w"),
        (size, 7.0), (own["low"], None), (own["high"], None), (own["unit"], "rad/s"),
    )  # fmt: skip


def row(day: int | None, *effects: FoundEffect, machine: str = "A", **more: Any) -> FleetRow:
    when = None if day is None else (date(2026, 1, 1) + timedelta(days=day)).isoformat()
    own: dict[str, Any] = {"job": f"{machine}{day}", "record": f"{machine}-{day}", "file": "f.csv", "date": when} | more
    return FleetRow(machine=machine, effects=effects, **own)


class Kept:
    """A desk that keeps what is put on it."""

    def __init__(self) -> None:
        self.rows: list[FleetRow] = []
        self.job_of: list[str] = []

    @contextmanager
    def job(self, name: str) -> Any:
        self.job_of.append(name)
        yield

    def put(self, name: str, content: bytes) -> None:
        self.rows.append(read(content))


REPORT: dict[str, Any] = {
    "verdict": "effects_found", "adequacy": "good", "explained_share": 0.875, "stand_in": {"flagged": True},
    "warnings": ["one", "two"],
    "errors": {
        "before": {
            "simulation_error": {"validation": {"q": {"nrmse": 0.5}, "x": {"nrmse": 0.25}, "c": {"nrmse": None}}}
        },
        "after": {"simulation_error": {"validation": {"q": {"nrmse": 0.125}, "x": {"nrmse": 0.0625}}}},
    },
    "effects": [
        {"name": "dahl", "at": "q", "parameters": {
            "Fc": {"value": 0.5, "low": None, "high": 0.75, "unit": "N m"},
            "k": {"value": 9.0, "low": 8.0, "high": 10.0, "unit": "N m/rad"},
        }}
    ],
    "tie_sets": [[{"name": "dahl", "at": "q"}, {"name": "coulomb", "at": "q"}, {"name": "play", "at": "u"}]],
}  # fmt: skip


@pytest.mark.parametrize(
    ("raised", "status", "reason"),
    [
        (None, "ok", ""),
        (InputError("data", expected="more", got="x" * 600, remedy="none"), "refused", None),
        (PlantError("gone\n  away", status="diverged"), "diverged", "gone away"),
        (ZeroDivisionError("by " + "intent " * 200), "crashed", None),
    ],
)
def test_a_record_is_a_row_whatever_becomes_of_it(
    raised: Exception | None, status: str, reason: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "r.csv"
    file.write_text("time [s],u,y\n")
    asked: dict[str, Any] = {}

    def loop(loaded: Any, *, out: Path, resume: bool) -> Any:
        asked.update(loaded, out=out)
        time.sleep(0.02)
        if raised is not None:
            raise raised
        return SimpleNamespace(data=REPORT)

    monkeypatch.setattr("harness.data.load_dataset", lambda path, **options: {"path": Path(path), **options})
    monkeypatch.setattr("harness.diagnosis.close_loop_file", loop)
    job = RecordJob(FleetRecord("r", file, "m", datetime(2026, 3, 1)), tmp_path / "reports", "pendulum", ("u2",), 5.0)
    desk: Any = Kept()
    before = time.perf_counter()
    job.work(desk)
    (found,) = desk.rows
    assert desk.job_of == [job.job]
    assert 0.02 <= found.seconds <= time.perf_counter() - before
    assert (found.record, found.machine, found.date, found.file) == ("r", "m", "2026-03-01T00:00:00", str(file))
    assert (found.status, found.day) == (status, "2026-03-01")
    assert found.reason == reason or (reason is None and len(found.reason) == 400)
    assert asked == {"path": file, "model": "pendulum", "validation": None, "undriven": ("u2",),
                     "out": tmp_path / "reports" / "r"}  # fmt: skip
    assert found.verdict == ("effects_found" if raised is None else "")
    assert (job.title, job.jobs, job.only([])) == ("r", (job.job,), job)
    late, lost = (read(job.lost("j", status, "took too long", shared=False)) for status in ("timeout", "crashed"))
    assert (late.status, late.reason) == ("timeout", "the diagnosis took too long")
    assert (lost.status, lost.reason, lost.seconds, lost.job) == ("crashed", "took too long", 0.0, "j")


def test_a_row_holds_what_the_report_says() -> None:
    found = blank(FleetRecord("r", Path("r.csv")), "j", reason="a  b\n" + "c" * 500)
    assert (found.reason, found.date, found.day) == ("a b " + "c" * 396, None, "")
    fill(found, REPORT)
    assert (found.verdict, found.adequacy, found.explained_share, found.stand_in) == (
        "effects_found",
        "good",
        0.875,
        True,
    )
    assert (found.error_before, found.error_after, found.warnings) == (0.5, 0.125, ("one", "two"))
    assert found.effects == (
        FoundEffect("dahl", "q", "k", 9.0, 8.0, 10.0, "N m/rad", ("coulomb@q", "play@u"), ("Fc", "k"), (0.5, 9.0),
              (None, 8.0), (0.75, 10.0), ("N m", "N m/rad")),
    )  # fmt: skip
    assert found.effects[0].name == "dahl@q"
    for wrong in ({"values": (1.0,)}, {"lows": ()}, {"highs": (1.0,) * 3}, {"units": ("m",)}):
        bad = msgspec.structs.replace(found, effects=(msgspec.structs.replace(found.effects[0], **wrong),))
        with pytest.raises(ValueError, match="too few"):
            read(encoded(bad))


def test_the_files_that_decide_an_answer_are_those_that_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("r.csv", "v.csv", "law.py", "x.fmu", "deep/run.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    text = ('name = "d"\n[signals.u]\nrole = "input"\nunit = "V"\n[signals.y]\nrole = "output"\nunit = "V"\n'
            '[[runs]]\nfile = "run.csv"\nuse = "estimation"\n[nominal]\nmodel = "x.fmu"\n')  # fmt: skip
    (tmp_path / "deep" / "dataset.toml").write_text(text)
    (tmp_path / "deep" / "x.fmu").write_text("own")
    monkeypatch.chdir(tmp_path)

    def files(record: FleetRecord, model: str | None) -> list[str]:
        found = RecordJob(record, tmp_path, model, (), 1.0)._files()
        return [str(path.absolute().relative_to(tmp_path)) for path in found]

    bare = FleetRecord("r", tmp_path / "r.csv", validation=tmp_path / "v.csv")
    assert files(bare, None) == ["r.csv", "v.csv"]
    assert files(bare, f"{tmp_path / 'law.py'}:arm") == ["r.csv", "v.csv", "law.py"]
    told = FleetRecord("d", tmp_path / "deep" / "dataset.toml")
    assert files(told, None) == ["deep/dataset.toml", "deep/run.csv", "deep/x.fmu"]
    assert files(told, str(tmp_path / "x.fmu")) == ["deep/dataset.toml", "deep/run.csv", "x.fmu"]


def test_tables_hold_every_row_and_every_effect_with_its_own_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [
        row(2, effect(size=0.5), effect("play", "u", 0.25, ties=("coulomb@q",)), verdict="effects_found",
            adequacy="good", explained_share=0.9, error_before=0.7, error_after=0.1, stand_in=False, warnings=("w",),
            seconds=12.5),
        row(None, machine="B", status="crashed", reason="signal 11"),
    ]  # fmt: skip
    made = tables(rows)
    told = made["records"].to_pylist()
    for one, own in zip(told, rows, strict=True):
        for name in set(one) - {"date"}:
            value = getattr(own, name)
            assert one[name] == (list(value) if isinstance(value, tuple) else value), name
    assert [one["date"] for one in told] == [datetime(2026, 1, 3), None]
    sizes = made["effects"].to_pylist()
    assert [one["record"] for one in sizes] == ["A-2", "A-2"]
    for one, own in zip(sizes, rows[0].effects, strict=True):
        assert (one["effect"], one["place"], one["verdict"]) == (own.effect, own.at, "effects_found")
        for name in (
            "parameter",
            "size",
            "low",
            "high",
            "unit",
            "ties",
            "parameters",
            "values",
            "lows",
            "highs",
            "units",
        ):
            value = getattr(own, name)
            assert one[name] == (list(value) if isinstance(value, tuple) else value), name
    assert made["effects"].schema.metadata == {b"format": b"sysid-harness/fleet/1"}

    assert not is_fleet_folder(tmp_path)
    store = FleetStore(tmp_path)
    store.open([one.job for one in reversed(rows)] + ["missing"], {"model": None, "undriven": ["u"]}, resume=False)
    assert is_fleet_folder(str(tmp_path))
    for one in rows:
        (store.shards / f"{one.job}.json").write_bytes(encoded(one))
    assert [one.job for one in store.consolidate(finished=False)] == ["BNone", "A2"]
    assert store.shards.is_dir()
    store.consolidate(finished=True)
    assert not store.shards.exists()
    assert list(store.rows()) == ["BNone", "A2"]
    assert [one["record"] for one in query(tmp_path).records()] == ["B-None", "A-2"]
    assert [one["record"] for one in query(tmp_path, filters={"machine": "A"}).records()] == ["A-2"]
    monkeypatch.setattr("harness.fleet.running.fleet_page", lambda rows, **more: f"{len(rows)} {sorted(more.items())}")
    found = fleet_table(tmp_path)
    assert (len(found.rows), found.planned, found.page) == (2, 3, tmp_path / "fleet.html")
    text = found.page.read_text(encoding="utf-8")
    assert text == "2 [('model', 'models of the records'), ('planned', 3), ('reports', 'reports')]"
    (tmp_path / "fleet.json").write_text((tmp_path / "fleet.json").read_text().replace("null", '"theirs"'))
    text = _shown(store, []).page.read_text(encoding="utf-8")
    assert text == "0 [('model', 'theirs'), ('planned', 3), ('reports', 'reports')]"


def test_a_fleet_reads_as_lines() -> None:
    grown = [row(k, effect(size=0.1 + 0.05 * k)) for k in range(5)]
    rows = (*grown, row(5, effect("dahl", size=0.4)), row(6, status="timeout"), row(7, verdict="nothing_missing"))
    for one in (*grown, rows[5]):
        one.verdict = "effects_found"
    lines = str(FleetResult(Path("x"), rows, 9)).splitlines()
    assert lines[0] == "8 of 9 records: 6 effects found, 1 timeout, 1 nothing missing"
    assert lines[1:3] == ["coulomb@q: in 5 records", "dahl@q: in 1 records"]
    assert lines[3].startswith("another law, after coulomb@q: dahl@q in A-5 (A, 2026-01-06), Fc")
    slope = 0.02 / NORMAL * stats.t.ppf(0.975, 3) / np.sqrt(10.0)
    assert lines[4].startswith("new: coulomb@q Fc on A drifts from 0.1 to 0.3 N m up to A-4 (2026-01-05), p ")
    assert lines[5] == f"grows: coulomb@q Fc on A by 0.05 [{0.05 - slope:.3g}, {0.05 + slope:.3g}] N m a day"
    assert len(lines) == 6
    assert _logged(row(1, effect(), effect("play", "u"), seconds=2.25)) == "A-1 2.2 s: coulomb@q + play@u"
    assert _logged(row(1, verdict="unexplained")) == "A-1 0.0 s: unexplained"
    assert _logged(row(1, reason="late")) == "A-1 0.0 s: late"


@pytest.mark.parametrize(("ends", "word"), [((0.1, 0.3), "grows"), ((-0.3, -0.1), "shrinks"), ((-0.1, 0.1), "no trend"),
                                            ((0.0, 0.2), "no trend"), ((-0.2, 0.0), "no trend")])  # fmt: skip
def test_a_trend_is_one_where_its_interval_leaves_out_zero(ends: tuple[float, float], word: str) -> None:
    assert Trend("A", Series("e", "p", "1", ()), 0.0, *ends, 3).word == word


def test_an_effect_is_new_where_no_earlier_record_of_the_machine_was_tied_with_it() -> None:
    rows = [
        row(3, effect("dahl"), effect("play", "u")),
        row(1, effect("coulomb", ties=("stribeck@q",))),
        row(2, effect("stribeck"), status="crashed"),
        row(4, effect("stribeck"), effect("karnopp", ties=("dahl@q",)), effect("delay", "u")),
        row(1, effect("coulomb"), machine="B"),
        row(2, machine="B"),
        row(None, effect("lag", "y"), machine="B"),
        row(5, effect("lag", "y"), machine="B"),
    ]
    found = [(one.machine, one.row.record, one.effect.name, one.before) for one in new_effects(rows)]
    assert found == [
        ("A", "A-3", "dahl@q", ("coulomb@q",)),
        ("A", "A-3", "play@u", ()),
        ("A", "A-4", "delay@u", ("play@u",)),
        ("B", "B-5", "lag@y", ()),
    ]
    made = series_of([*rows, row(0, effect("coulomb", unit="N")), row(6, effect("coulomb"))])
    assert (made[0].effect, made[0].parameter, made[0].unit) == ("coulomb@q", "Fc", "N m")
    assert [len(one.rows) for one in made] == [3, 2, 2, 1, 1, 1, 1, 1]
    lag = next(one for one in made if one.effect == "lag@y")
    assert [own.record for own, _ in lag.rows] == ["B-5", "B-None"]  # by date, those without one last


def chances(day: Any, size: Any, sigma: Any) -> dict[tuple[str, int], tuple[float, float, float, float]]:
    """Return levels, chance and rest of every shape: fits of two numbers by least squares, and a moderated t."""
    n, at = len(size), np.arange(len(size))
    columns = {("step", cut): ((at >= cut) * 1.0, n - 1) for cut in range(1, n)}
    if n > 2 and np.ptp(day) > 0:
        columns["drift", n - 1] = ((day - day[0]) / (day[-1] - day[0]), 1)
    if n >= 4:
        columns |= {("outlier", k): ((at == k) * 1.0, n) for k in range(n)}
    found = {}
    for key, (column, places) in columns.items():
        design = np.column_stack([np.ones(n), column]) / np.array(sigma)[:, None]
        theta = np.linalg.lstsq(design, size / sigma)[0]
        rest = float(np.sum((size / sigma - design @ theta) ** 2))
        z = abs(theta[1]) / np.sqrt(np.linalg.inv(design.T @ design)[1, 1])
        tail = stats.norm.sf(z)
        if n >= 4:
            tail = stats.t.sf(z / np.sqrt(max(1.0, rest / (n - 2), (rest + 2) / n)), n)
        found[key] = (theta[0], theta.sum(), min(1.0, 6.0 * places * float(tail)), rest)
    return found


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 8), st.integers(0, 10**6), st.booleans())
def test_the_likeliest_shape_is_the_one_that_leaves_least(n: int, seed: int, one_day: bool) -> None:
    rng = np.random.default_rng(seed)
    day = np.full(n, 3.0) if one_day else np.sort(rng.uniform(0, 30, n))
    size, sigma = rng.normal(1.0, rng.choice([0.01, 0.1]), n), rng.uniform(0.01, 0.05, n)
    size += rng.choice([0.0, 0.3]) * (np.arange(n) >= rng.integers(n)) + rng.choice([0.0, 0.02]) * day
    every = chances(day, size, sigma)
    shape, place, before, after, chance = _likeliest(day, size, sigma)
    *figures, rest = every[shape, place]  # a step after the first and an outlier there leave the same
    assert rest == pytest.approx(min(own[3] for own in every.values()), rel=1e-9, abs=1e-9) or n == 2
    assert (before, after) == pytest.approx(figures[:2], abs=1e-9)
    assert chance == pytest.approx(figures[2], rel=2e-3, abs=1e-12)


def test_a_machine_that_alone_has_an_effect_is_odd_by_the_hypergeometric_distribution() -> None:
    rows = [row(k, *([effect()] if (machine == "E" and k < 7) or (machine == "A" and k == 0) else []), machine=machine)
            for machine in "ABCDE" for k in range(8)]  # fmt: skip
    rows.append(row(9, effect(), machine="A", status="crashed"))
    (found,) = odd_machines(rows)
    table = stats.hypergeom(40, 8, 8)
    chance = sum(table.pmf(k) for k in range(9) if table.pmf(k) <= table.pmf(7) * (1 + 1e-7))
    assert (found.machine, found.what) == ("E", "in 7 of 8 records, of the others in 1 of 32")
    assert found.p == pytest.approx(chance * 5 * 2)
    assert str(found) == f"E is not as the others: coulomb@q {found.what}, p {found.p:.2g}"
    assert odd_machines(rows[:24]) == []  # three machines


@pytest.mark.parametrize(
    ("shape", "words"), [("step", "steps from 0.1 to 0.25 N m at"), ("drift", "drifts from 0.1 to 0.25 N m up to"),
                         ("outlier", "is elsewhere 0.1 to 0.25 N m only in")]
)  # fmt: skip
def test_a_change_reads_as_a_sentence(shape: str, words: str) -> None:
    one = Change(
        "", Series("coulomb@q", "Fc", "N m", ()), shape, row(3, date="2026-01-04T08:00:00"), 0.1, 0.25, 1.234e-5
    )
    assert str(one) == f"coulomb@q Fc {words} A-3 (2026-01-04T08:00:00), p 1.2e-05"


def test_changes_are_told_the_surest_first_and_paid_for_by_the_number_of_machines() -> None:
    def line(machine: str, jump: float) -> list[FleetRow]:
        return [row(k, effect(size=size, low=size - 0.01 * NORMAL, high=size + 0.01 * NORMAL), machine=machine)
                for k, size in enumerate((0.1, 0.1 + jump))]  # fmt: skip

    rows = [*line("A", 0.1), *line("B", 0.2), row(0, effect(), machine="alone")]
    found = changes(rows)
    assert [one.machine for one in found] == ["B", "A"]
    for one, jump in zip(found, (0.2, 0.1), strict=True):
        assert one.p == pytest.approx(2 * 6 * stats.norm.sf(jump / 0.01 / np.sqrt(2)), rel=1e-3)
    assert len(changes(line("A", 0.06))) == 1  # 6 P(z > 4.2)
    assert changes(line("A", 0.04)) == []  # 6 P(z > 2.8)


def test_a_table_of_records_says_what_is_wrong_with_it_and_where(tmp_path: Path) -> None:
    for name in ("a.csv", "deep/b.csv", "deep/dataset.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("time [s],u,y\n")
    table = tmp_path / "t.csv"

    def found(*lines: str) -> tuple[FleetRecord, ...]:
        table.write_text("\n".join(["file,machine,date,validation", *lines]) + "\n")
        return find_records(table)

    one, two = found("a.csv, m,2026-03-01T10:00:00+02:00,deep/b.csv", "deep/dataset.toml,,,")
    assert (one.name, one.machine, one.validation) == ("a", "m", tmp_path / "deep/b.csv")
    assert one.date == datetime(2026, 3, 1, 8, tzinfo=UTC)
    assert (two.name, two.machine, two.date, two.validation) == ("deep", "", None, None)
    for lines, says in (
        (["a.csv,,,", "c.csv,,,"], r"row 3: .*c\.csv"),
        (["a.csv,,,c.csv"], r"row 2: .*c\.csv"),
        (["a.csv,,,", "deep/b.csv,,yesterday,"], "row 3"),
        (["a.csv,,2026-03-01,", "deep/b.csv,,2026-03-01T10:00:00+02:00,"], "both"),
        (["a.csv,,,", "a.csv,,,"], "two records with one name"),
        ([], "expected rows"),
    ):
        with pytest.raises(InputError, match=says):
            found(*lines)
    table.write_text("file,colour\na.csv,red\n")
    with pytest.raises(InputError, match="'colour'"):
        find_records(table)
    with pytest.raises(InputError, match=r"a table of records \(t\.csv\) among them"):
        find_records(tmp_path)
    with pytest.raises(InputError, match="one data set"):
        find_records(tmp_path / "deep")
    table.unlink()
    assert [record.name for record in find_records(tmp_path)] == ["a", "deep"]
    assert is_fleet(tmp_path)
    assert not is_fleet(tmp_path / "a.csv")
    assert not is_fleet("emps")
    with pytest.raises(InputError, match="files that end in"):
        find_records(str(tmp_path / "*.xlsx"))


def test_a_slope_of_three_records_rests_on_one_degree_of_freedom() -> None:
    days, sizes = np.array([0.0, 1.0, 4.0]), np.array([0.1, 0.16, 0.2])
    rows = [row(int(k), effect(size=float(size), low=float(size) - 0.01, high=float(size) + 0.03)) for k, size in
            zip(days, sizes, strict=True)]  # fmt: skip
    (found,) = trends(series_of(rows))
    sigma = 0.04 / 2 / NORMAL
    slope, level = np.polyfit(days, sizes, 1)
    birge = max(1.0, np.sqrt(np.sum((sizes - level - slope * days) ** 2)) / sigma)
    half = stats.t.ppf(0.975, 1) * birge * sigma / np.sqrt(np.sum((days - days.mean()) ** 2))
    assert (found.machine, found.records) == ("A", 3)
    assert (found.slope, found.low, found.high) == pytest.approx((slope, slope - half, slope + half), rel=1e-5)
