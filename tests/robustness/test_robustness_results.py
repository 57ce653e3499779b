"""Files of results that were cut, changed, retyped or written by something else: one line, and never a fault."""

from __future__ import annotations

import io
import json
import random
import shutil
from pathlib import Path
from typing import Any

import mutations
import pyarrow as pa
import pytest
from pyarrow import parquet

from harness.benchmark.row import Row
from harness.benchmark.row import encoded as encoded_cell
from harness.benchmark.store import Store
from harness.command import main
from harness.diagnosis.store import CandidateStore as Refits
from harness.errors import InputError
from harness.fleet.records import find_records
from harness.fleet.row import FleetRow as Record
from harness.fleet.row import FoundEffect, encoded
from harness.fleet.store import FleetStore

SEED, COUNT = 3, 50
OTHER: list[Any] = [None, True, -1, 10**400, "x", [], {}, [None], "\x1b[2J", [[1]], {"a": {}}, 2**63]


def cells() -> list[Row]:
    """Return rows of a benchmark with lists of every kind."""
    return [
        Row(
            job=f"job{k}", plant="lag", scenario="prbs", identifier=name, seed=0, outputs=("y",), units=("m",),
            equation_error=0.1, simulation_error=0.2, equation_rms=(0.1,), simulation_rms=(None,), samples=60,
            regret=1.0, average_regret=0.1, curve_steps=(1, 2), curve_regret=(0.1, 0.2), trace_t=(0.0, 0.1),
            trace_measured=((0.0, 1.0),), trace_residual=((0.0, None),),
        )
        for k, name in enumerate(("hold", "arx"))
    ]  # fmt: skip


def write_results(folder: Path) -> dict[str, list[list[str]]]:
    """Write folders of a benchmark and of a fleet, done and begun; return by file what reads it."""
    content = {
        "format": "sysid-harness/bench/1", "suite": "s", "description": "", "versions": {"python": "3"},
        "cells": [[row.job, row.plant, row.scenario, row.identifier, row.seed] for row in cells()],
    }  # fmt: skip
    files: dict[str, list[list[str]]] = {}
    for name in ("bench-done", "bench-begun"):
        store = Store(folder / name)
        store.shards.mkdir(parents=True)
        store.manifest.write_text(json.dumps(content))
        # asked by SQL, and as a table: the folder's files are read in two ways
        commands = [["query", str(store.folder), "select * from results"], ["table", str(store.folder)]]
        if name == "bench-done":
            store.write(cells())
            shutil.rmtree(store.shards)
            for path in (store.results, store.timings, store.curves, store.traces, store.manifest):
                files[str(path)] = commands
        else:
            for row in cells():
                (store.shards / f"{row.job}.json").write_bytes(encoded_cell(row))
            files[str(store.shards / "job0.json")] = commands
    effect = FoundEffect(
        "coulomb_friction", "theta", "Fc", 0.1, 0.09, 0.2, "N m", (), ("Fc",), (0.1,), (0.09,), (0.2,), ("N m",)
    )
    rows = [
        Record(job=f"r{k}", record=f"r{k}", file=f"r{k}.csv", machine="m", date=f"2026-03-0{k}T00:00:00",
               verdict="explained", error_before=0.5, error_after=0.1, effects=(effect,))
        for k in (1, 2, 3)
    ]  # fmt: skip
    for name in ("fleet-done", "fleet-begun"):
        fleet = FleetStore(folder / name)
        fleet.open([row.job for row in rows], {"model": "pendulum", "undriven": []}, resume=False)
        for row in rows:
            (fleet.shards / f"{row.job}.json").write_bytes(encoded(row))
        commands = [["query", str(fleet.folder), "select * from effects"], ["table", str(fleet.folder)]]
        if name == "fleet-done":
            fleet.consolidate(finished=True)
            files |= {str(fleet.folder / one): commands for one in ("fleet.json", "rows.jsonl")}
        else:
            files[str(fleet.shards / "r1.json")] = commands
    return files


def retyped(value: Any, chance: random.Random) -> Any:
    """Return JSON in which one value is of another kind, or missing."""
    if isinstance(value, dict | list) and value and chance.random() < 0.8:
        key = chance.choice(list(value)) if isinstance(value, dict) else chance.randrange(len(value))
        changed = value.copy()
        if chance.random() < 0.25:
            del changed[key]
        else:
            changed[key] = retyped(value[key], chance)
        return changed
    return chance.choice(OTHER)


def other_columns(path: Path, chance: random.Random) -> bytes:
    """Return a Parquet file with one column missing, empty, renamed or of another type."""
    table = parquet.read_table(path)
    place = chance.randrange(table.num_columns)
    name = table.column_names[place]
    n = len(table)
    way = chance.choice(["drop", "rename", "null", "text", "number", "list"])
    if way == "drop":
        table = table.drop_columns([name])
    elif way == "rename":
        table = table.rename_columns([f"{one}?" if one == name else one for one in table.column_names])
    else:
        values = {"null": [None] * n, "text": ["x"] * n, "number": list(range(n)), "list": [[["a"]]] * n}[way]
        table = table.set_column(place, name, pa.array(values))
    stream = io.BytesIO()
    parquet.write_table(table, stream)
    return stream.getvalue()


@pytest.mark.filterwarnings("ignore")
def test_damaged_results_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write_results(tmp_path / "sound")
    chance, broken = random.Random(SEED), mutations.mutated
    refused = 0
    for number in range(COUNT):
        path = Path(list(files)[number % len(files)])
        sound = path.read_bytes()
        if chance.random() < 0.4:
            way, content = broken(sound, chance)
        elif path.suffix == ".parquet":
            way, content = "columns", other_columns(path, chance)
        else:
            lines = sound.splitlines() if path.suffix == ".jsonl" else [sound]
            place = chance.randrange(len(lines))
            lines[place] = json.dumps(retyped(json.loads(lines[place]), chance)).encode()
            way, content = "retyped", b"\n".join(lines)
        before = {one: one.read_bytes() for one in path.parents[len(path.parents) - 1 - len(tmp_path.parts)].rglob("*")
                  if one.is_file()}  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(SystemExit) as ended:
            main(files[str(path)][chance.random() < 0.15])
        said = capsys.readouterr()
        assert ended.value.code in (0, 2), (number, path.name, way, said.err)
        if ended.value.code == 2:
            refused += 1
            assert len(said.err.strip().splitlines()) == 1, (number, path.name, way, said.err)
            assert "remedy" in said.err
        for one, kept in before.items():
            one.write_bytes(kept)
        path.write_bytes(sound)
    assert refused > 0.4 * COUNT


def test_a_changed_byte_of_a_value_is_noticed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.write(cells())
    sound, rows = store.results.read_bytes(), store.rows()
    column = parquet.read_metadata(store.results).row_group(0).column(Row.__struct_fields__.index("seed"))
    noticed = 0
    for place in range(4, column.data_page_offset, 7):  # in the columns before it
        content = bytearray(sound)
        content[place] ^= 1
        store.results.write_bytes(bytes(content))
        try:
            assert store.rows() == rows, place
        except InputError:
            noticed += 1
    assert noticed > 20


def test_a_changed_refit_counts_as_absent(tmp_path: Path) -> None:
    refits = Refits(tmp_path, "data")
    refits.put("a", {"loss": 1.5, "values": [0.1, None]})
    assert refits.get("a") == {"loss": 1.5, "values": [0.1, None]}
    (path,) = (tmp_path / "candidates").iterdir()
    for old, new in (("1.5", "2.5"), ("null", "0"), ('"loss"', '"lost"'), ("{", "[")):
        sound = path.read_text()
        path.write_text(sound.replace(old, new))
        assert refits.get("a") is None, (old, new)
        path.write_text(sound)
    assert refits.get("a") is not None


def test_a_table_of_records_in_another_encoding(tmp_path: Path) -> None:
    path = tmp_path / "fleet.csv"
    path.write_bytes("file,machine\na.csv,Prüfstand\n".encode("latin-1"))
    with pytest.raises(InputError, match="expected text in UTF-8, got the byte 0xfc"):
        find_records(path)
    path.write_bytes(b"file,machine\na.csv,\x00\n" + b"x" * 200_000 + b"\n")
    with pytest.raises(InputError):
        find_records(path)
