"""Sound inputs of every format, and ways to break them; ``python tests/robustness/mutations.py N`` tries N.

What a broken input may do: be refused in one line, or still be read as finite numbers. What it may not: end in an
exception of another kind, or be read as something that is no record.
"""

from __future__ import annotations

import gzip
import importlib.util
import json
import random
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from harness import api
from harness.cosim import couple, couple_ssp
from harness.data import load_dataset
from harness.errors import HarnessError
from harness.parts.files import describe_fmu, make_part
from harness.physics import load_model
from plants.fmu.archive import read_fmu
from plants.mockups import mockup

N = 60
TOML = """
name = "broken"
signals.u = { role = "input", unit = "N m" }
signals.theta = { role = "output", unit = "rad" }
[time]
column = "time"
[nominal]
model = "pendulum"
[nominal.parameters]
J = 0.05
[[runs]]
file = "FILE"
rows = [0, 40]
[[runs]]
file = "FILE"
use = "validation"
rows = [40, 60]
"""
URDF = """<?xml version="1.0"?>
<robot name="two">
 <link name="base"/>
 <link name="upper"><inertial><origin xyz="0 0 -0.5"/><mass value="1.5"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial></link>
 <link name="lower"><inertial><origin xyz="0 0 -0.3"/><mass value="0.8"/>
  <inertia ixx="0.05" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.01"/></inertial></link>
 <joint name="q1" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="10" velocity="5"/><dynamics damping="0.1"/></joint>
 <joint name="q2" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -1"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="10" velocity="5"/></joint>
</robot>
"""
SUITE = """
name = "small"
seeds = [0]
[[groups]]
plants = [{ id = "linear-ode" }]
scenarios = [{ id = "prbs", options = { samples = 50 } }]
identifiers = [{ id = "hold" }, { id = "arx", options = { order = 1 } }]
axes = { "scenarios.noise" = [0.0, 0.1] }
"""
COUPLING = """
sample_time = 0.01
connections = [
  { from = "wish", to = "law.r" },
  { from = "arm.theta", to = "law.y" },
  { from = "law.u", to = "arm.u", gain_unit = "N m" },
]
inputs = { wish = "law.r" }
outputs = ["arm.theta", "law.u"]
initial = { "arm.theta" = 0.3 }
[parts.arm]
plant = "pendulum-fmu"
[parts.law]
mockup = "pi_controller"
options = { sample_time = 0.01, parameters = { Kp = 0.5, Ki = 0.2 } }
"""


def table() -> dict[str, np.ndarray]:
    """Return the columns of a sound record."""
    t = 0.02 * np.arange(N)
    return {"time [s]": t, "u [N m]": np.sin(3.0 * t), "theta [rad]": 0.3 * np.cos(2.0 * t)}


def write_mcap(path: Path) -> None:
    """Write a log of a robot, one message a sample."""
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("arm", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/arm", "json", schema)
        for t, u, theta in zip(*table().values(), strict=True):
            stamp = round(1e9 * float(t))
            text = json.dumps({"u": float(u), "theta": float(theta)})
            writer.add_message(channel, stamp, text.encode(), stamp)
        writer.finish()


def write_mdf(path: Path) -> None:
    """Write a log of a car."""
    import asammdf

    t, u, theta = table().values()
    with asammdf.MDF(version="4.10") as log:
        log.append([asammdf.Signal(u, t, name="u", unit="N m"), asammdf.Signal(theta, t, name="theta", unit="rad")])
        log.save(path)


def write_inputs(folder: Path) -> dict[str, Callable[[Path], object]]:
    """Write one sound input of every format; return by file name what reads it."""
    import h5py
    import pandas
    import pyarrow
    import pyarrow.feather
    import pyarrow.parquet
    import scipy.io

    columns = table()
    frame = pandas.DataFrame(columns)
    frame.to_csv(folder / "a.csv", index=False)
    frame.to_csv(folder / "a.tsv", index=False, sep="\t")
    (folder / "a.csv.gz").write_bytes(gzip.compress((folder / "a.csv").read_bytes()))
    frame.to_excel(folder / "a.xlsx", index=False)
    pyarrow.parquet.write_table(pyarrow.table(columns), folder / "a.parquet")
    pyarrow.feather.write_feather(frame, folder / "a.feather")
    plain = {name.partition(" ")[0]: values for name, values in columns.items()}
    np.savez(folder / "a.npz", **plain)
    scipy.io.savemat(folder / "a.mat", plain)
    with h5py.File(folder / "a.h5", "w") as file:
        for name, values in plain.items():
            file[name] = values
    readers: dict[str, Callable[[Path], object]] = {}
    for name in ("a.csv", "a.tsv", "a.csv.gz", "a.xlsx", "a.parquet", "a.feather"):
        readers[name] = lambda path: load_dataset(path, model="pendulum")
    write_mcap(folder / "a.mcap")
    logs = ["a.mcap"]
    if importlib.util.find_spec("asammdf") is not None:
        write_mdf(folder / "a.mf4")
        logs.append("a.mf4")
    for name in ("a.npz", "a.mat", "a.h5", *logs):

        def described(path: Path) -> object:
            toml = path.with_name(f"of-{path.name}.toml")
            text = TOML.replace("FILE", path.name)
            if path.suffix == ".mcap":
                text = text.replace("signals.u = { ", 'signals.u = { column = "/arm.u", ')
                text = text.replace("signals.theta = { ", 'signals.theta = { column = "/arm.theta", ')
            toml.write_text(text, encoding="utf-8")
            return load_dataset(toml)

        readers[name] = described
    (folder / "dataset.toml").write_text(TOML.replace("FILE", "a.csv"), encoding="utf-8")
    readers["dataset.toml"] = load_dataset
    (folder / "suite.toml").write_text(SUITE, encoding="utf-8")
    readers["suite.toml"] = lambda path: api.plan_bench(path, out=path.parent / "results")
    (folder / "coupling.toml").write_text(COUPLING, encoding="utf-8")
    readers["coupling.toml"] = lambda path: couple(path, make_part).close()
    with zipfile.ZipFile(mockup("pendulum")) as archive, zipfile.ZipFile(folder / "a.fmu", "w") as plain_zip:
        for entry in archive.namelist():  # not packed, so that a changed byte is a changed text
            plain_zip.writestr(entry, archive.read(entry))
    readers["a.fmu"] = lambda path: read_fmu(path).platforms
    with zipfile.ZipFile(folder / "a.ssp", "w") as archive:
        archive.writestr("SystemStructure.ssd", SSD)
        archive.write(mockup("pendulum"), "resources/arm.fmu")
    readers["a.ssp"] = lambda path: couple_ssp(path, make_part, describe_fmu).close()
    api.identify(folder / "a.csv", identifier="arx", options={"order": 1}, model="pendulum", out=folder / "model.json")
    (folder / "a.urdf").write_text(URDF, encoding="utf-8")
    readers["a.urdf"] = lambda path: load_model(str(path))
    readers["model.json"] = lambda path: api.compare([path], folder / "dataset.toml").rows()
    return readers


SSD = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
 xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription" version="1.0" name="one">
 <ssd:System name="one"><ssd:Connectors><ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>
 <ssd:Connector name="theta" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors>
 <ssd:Elements><ssd:Component name="arm" type="application/x-fmu-sharedlibrary" source="resources/arm.fmu">
 <ssd:Connectors><ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>
 <ssd:Connector name="theta" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors></ssd:Component></ssd:Elements>
 <ssd:Connections>
 <ssd:Connection startConnector="u" endElement="arm" endConnector="u"/>
 <ssd:Connection startElement="arm" startConnector="theta" endConnector="theta"/></ssd:Connections></ssd:System>
</ssd:SystemStructureDescription>
"""
TOKENS = [b"", b"nan", b"inf", b"-", b"1e999", b'"', b"\x00", b"\xff\xfe", b"[", b"]", b"=", b",", b"\n", b"true"]
TOKENS += [b"0", b"-1", b"{}", b"null", b"1" * 400, "é°²".encode(), b"../..", b"\r", b"9" * 20, b"u [", b"time"]


def mutated(content: bytes, chance: random.Random) -> tuple[str, bytes]:
    """Return a broken copy and what was done to it."""
    way = chance.choice(["cut", "flip", "token", "drop", "double", "swap", "garbage", "empty", "replace"])
    n = max(1, len(content))
    a = chance.randrange(n)
    b = min(n, a + chance.choice([1, 2, 8, 64, 512]))
    if way == "cut":
        return way, content[:a]
    if way == "flip":
        broken = bytearray(content)
        for _ in range(chance.choice([1, 1, 3, 20])):
            broken[chance.randrange(len(broken))] ^= 1 << chance.randrange(8)
        return way, bytes(broken)
    if way == "token":
        return way, content[:a] + chance.choice(TOKENS) + content[b:]
    if way == "drop":
        return way, content[:a] + content[b:]
    if way == "double":
        return way, content[:b] + content[a:b] + content[b:]
    if way == "swap":
        lines = content.split(b"\n")
        i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
        lines[i], lines[j] = lines[j], lines[i]
        return way, b"\n".join(lines)
    if way == "garbage":
        return way, content[:a] + chance.randbytes(b - a) + content[b:]
    if way == "empty":
        return way, b""
    words = content.split(b" ")
    words[chance.randrange(len(words))] = chance.choice(TOKENS)
    return way, b" ".join(words)


def wrong(result: object) -> str | None:
    """Return what is wrong with a result that passes for sound."""
    dataset = getattr(result, "dataset", None)
    for run in getattr(dataset, "runs", ()):
        record = run.trajectory
        if not (np.isfinite(record.u).all() and np.isfinite(record.y).all() and np.isfinite(record.t).all()):
            return "numbers that are not finite"
        if len(record) > N or record.spec.nu != 1 or record.spec.ny != 1:
            return f"another shape: {record}"
    return None


def tried(reader: Callable[[Path], object], path: Path) -> tuple[str, str]:
    """Return what became of an input: refused, read, or a fault with its words."""
    try:
        result = reader(path)
    except HarnessError as error:
        text = str(error)
        return ("fault", f"more than a line: {text!r}") if "\n" in text.strip() else ("refused", text)
    except Exception as error:
        return "fault", f"{type(error).__name__}: {error}"
    complaint = wrong(result)
    return ("read", "") if complaint is None else ("fault", complaint)


def run(count: int, seed: int, folder: Path, show: bool = False) -> tuple[Counter[str], list[str]]:
    """Try ``count`` broken inputs; return how often each outcome came, and the faults."""
    readers = write_inputs(folder)
    sound = {name: (folder / name).read_bytes() for name in readers}
    for name, reader in readers.items():
        word, text = tried(reader, folder / name)
        assert word == "read", f"{name} is to be sound: {text}"
    counts: Counter[str] = Counter()
    faults = []
    chance = random.Random(seed)
    for number in range(count):
        name = list(readers)[number % len(readers)]
        way, content = mutated(sound[name], chance)
        (folder / name).write_bytes(content)
        word, text = tried(readers[name], folder / name)
        (folder / name).write_bytes(sound[name])
        counts[f"{name}: {word}"] += 1
        if word == "fault":
            faults.append(f"{number} {name} {way}: {text[:300]}")
            if show:
                print(faults[-1], flush=True)
    return counts, faults


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        found, broken = run(int(sys.argv[1]), int((sys.argv[2:] or ["0"])[0]), Path(place), show=True)
    print(json.dumps(dict(sorted(found.items())), indent=1))
    print(f"{sum(found.values())} broken inputs, {len(broken)} faults")
    sys.exit(bool(broken))
