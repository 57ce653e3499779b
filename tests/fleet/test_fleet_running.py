"""The loop over a few records of other engines: rows, tables, page, resume; a record that breaks is a row."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness import api
from harness.errors import InputError
from harness.fleet import close_fleet, fleet_table, query


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate one machine before and after its joint has friction (Bullet's), and a log that cannot be read."""
    folder = tmp_path_factory.mktemp("fleet")
    for name, friction in (("before", 0.0), ("after", 0.1)):
        api.simulate(
            "arm-bullet",
            scenario="multisine",
            seed=3,
            out=folder / f"{name}.csv",
            options={"joint_friction": friction, "sample_time": 0.02, "substeps": 160},
            scenario_options={"noise": 0.001},
        )
    (folder / "broken.csv").write_text("time [s],u [N m]\n0,0\n0.02,1\n")
    path = folder / "fleet.csv"
    path.write_text(
        "file,machine,date\nbefore.csv,one,2026-01-01\nbroken.csv,one,2026-01-15\nafter.csv,one,2026-02-01\n"
    )
    return path


@pytest.mark.slow
def test_rows_tables_page_and_resume(table: Path, tmp_path: Path, sysid: Callable[..., Any]) -> None:
    out = tmp_path / "out"
    result = close_fleet(table, out=out, model="pendulum", workers=2)
    before, broken, after = result.rows
    assert (before.status, before.verdict, before.effects) == ("ok", "nothing_missing", ())
    assert broken.status == "refused"
    assert "theta" in broken.reason
    assert after.verdict == "effects_found"
    names = {name for effect in after.effects for name in (effect.name, *effect.ties)}
    assert "coulomb_friction@theta" in names
    assert [(new.row.record, new.effect.name) for new in result.new] == [("after", after.effects[0].name)]

    asked = "select record, effect, size, low, high, unit, verdict from effects"
    (answer,) = query(out, asked).records()
    assert (answer["record"], answer["unit"]) == ("after", "N m")
    assert answer["low"] <= answer["size"] <= answer["high"]
    assert query(out, "select count(*) as n from records where date < '2026-01-20'").records() == [{"n": 2}]
    page = (out / "fleet.html").read_text(encoding="utf-8")
    assert "after" in page
    assert "<svg" in page
    assert 'href="reports/after/report.html"' in page
    assert (out / "reports" / "after" / "report.html").is_file()

    with pytest.raises(InputError, match="--resume"):
        close_fleet(table, out=out, model="pendulum")
    written = (out / "effects.parquet").read_bytes()
    rows = close_fleet(table, out=out, model="pendulum", resume=True).rows  # nothing is left to do
    assert rows == result.rows == fleet_table(out).rows
    assert (out / "effects.parquet").read_bytes() == written
    with pytest.raises(InputError, match="another fleet"):
        close_fleet(table, out=out, model="cart-pole", resume=True)
    assert "one" in sysid("query", out, "select machine, count(*) as n from records group by machine").out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_gives_the_same_rows(table: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="the optional package distributed is not installed")
    near = close_fleet(table, out=tmp_path / "near", model="pendulum", workers=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whatever dask deprecates is not ours
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, worker_dashboard_address=None
        ) as made:
            engine = f"dask://{made.scheduler_address.removeprefix('tcp://')}"
            far = close_fleet(table, out=tmp_path / "far", model="pendulum", engine=engine)
    for one, other in zip(near.rows, far.rows, strict=True):
        assert (one.record, one.status, one.verdict, one.effects) == (
            other.record,
            other.status,
            other.verdict,
            other.effects,
        )


def test_options_of_the_other_kind_are_refused(table: Path, tmp_path: Path, sysid: Callable[..., Any]) -> None:
    cases = [
        ([str(table), "--force"], "option of one record"),
        ([str(table.parent / "before.csv"), "--time-limit", "5"], "option of a fleet"),
    ]
    for arguments, says in cases:
        assert says in sysid("close-loop", *arguments, "--model", "pendulum", "--out", tmp_path / "no", status=2).err
