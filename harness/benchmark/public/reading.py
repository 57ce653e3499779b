"""Public sets, read from a folder or through the official loader, and split as their rules say."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.benchmark.public.rules import Rule
from harness.errors import InputError
from harness.extras import optional
from harness.signals import FloatArray, Trajectory

DATA_FOLDER = "SYSID_HARNESS_DATA"
ORIGIN = "origin.txt"
Pair = tuple[FloatArray, FloatArray]
Pairs = tuple[list[Pair], list[list[Pair]]]  # Records (u, y) to learn from; and those of each figure.


@dataclass(frozen=True, eq=False)
class PublicSplit:
    """A public set as its rule divides it."""

    train: tuple[Trajectory, ...]  # What may be learned from, the choice of a model included
    tests: tuple[tuple[Trajectory, ...], ...]  # For each of the rule's figures its test records
    origin: str  # Where the data came from

    @property
    def fingerprint(self) -> str:
        """Hash of all samples."""
        from harness.fingerprint import fingerprint

        return fingerprint(*(array for one in self._records() for array in (one.u, one.y)))

    def _records(self) -> Iterable[Trajectory]:
        """Yield every record."""
        yield from self.train
        for group in self.tests:
            yield from group


def _mat(path: Path) -> dict[str, Any]:
    """Return the variables of a MAT file of version 5."""
    from scipy.io import loadmat

    content: dict[str, Any] = loadmat(path)
    return content


def _silverbox(folder: Path) -> Pairs:
    """Read SNLS80mV.mat."""
    content = _mat(folder / "SNLS80mV.mat")
    u, y = content["V1"][0], content["V2"][0]
    arrow, multisine = slice(100, 40575), (40650, 127400)
    cut = multisine[0] + int(0.75 * (multisine[1] - multisine[0]))
    tests = (slice(cut, multisine[1]), arrow, slice(100, 100 + 32000))
    return [(u[multisine[0] : cut], y[multisine[0] : cut])], [[(u[at], y[at])] for at in tests]


def _wiener_hammerstein(folder: Path) -> Pairs:
    """Read WienerHammerBenchMark.mat."""
    content = _mat(folder / "WienerHammerBenchMark.mat")
    u, y = (content[name][5200:184000, 0] for name in ("uBenchMark", "yBenchMark"))
    return [(u[:100000], y[:100000])], [[(u[100000:], y[100000:])]]


def _columns(path: Path, names: Sequence[str]) -> list[FloatArray]:
    """Return columns of a CSV file with a header, by name."""
    with path.open(encoding="utf-8-sig") as stream:
        titles = [title.strip().strip('"') for title in stream.readline().split(",")]
    missing = [name for name in names if name not in titles]
    if missing:
        raise InputError(
            "columns", expected=", ".join(names), got=", ".join(titles)[:80], remedy="take the published file",
            file=path,
        )  # fmt: skip
    table = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=[titles.index(name) for name in names], ndmin=2)
    return list(table.T)


def _either(folder: Path, mat: str, text: str, names: Sequence[str]) -> list[FloatArray]:
    """Return variables of the MAT file, or of its CSV twin where that is what is there."""
    if (folder / mat).is_file():
        content = _mat(folder / mat)
        return [content[name][:, 0] for name in names]
    return _columns(folder / text, names)


def _cascaded_tanks(folder: Path) -> Pairs:
    """Read dataBenchmark.mat or .csv."""
    u, v, y, z = _either(folder, "dataBenchmark.mat", "dataBenchmark.csv", ("uEst", "uVal", "yEst", "yVal"))
    return [(u, y)], [[(v, z)]]


def _coupled_drives(folder: Path) -> Pairs:
    """Read DATAUNIF.MAT or .csv."""
    u, v, y, z = _either(folder, "DATAUNIF.MAT", "DATAUNIF.csv", ("u11", "u12", "z11", "z12"))
    both = ((u, y), (v, z))
    return [(a[:400], b[:400]) for a, b in both], [[(a[400:], b[400:])] for a, b in both]


def _emps(folder: Path) -> Pairs:
    """Read DATA_EMPS.mat and DATA_EMPS_PULSES.mat."""
    first, second = (_mat(folder / name) for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"))
    learn, test = ((content["vir"][:, 0], content["qm"][:, 0]) for content in (first, second))
    return [learn], [[test]]


def _parallel(folder: Path) -> Pairs:
    """Read ParWHData.mat: arrays (16384, 2 periods, realisations, 5 amplitudes), the periods one after the other."""
    content = _mat(folder / "ParWHData.mat")

    def record(kind: str, realisation: int, level: int) -> Pair:
        u, y = (content[name + kind][:, :, realisation, level].T.reshape(-1) for name in ("u", "y"))
        return u, y

    realisations = content["uEst"].shape[2]
    learn = [record("Est", r, level) for r in range(realisations) for level in range(5)]
    return learn, [[record("Val", 0, level)] for level in range(5)]


def _f16(folder: Path) -> Pairs:
    """Read the MAT files of BenchmarkData."""
    learn: list[Pair] = []
    tests: list[list[Pair]] = []
    for path in sorted((folder / "BenchmarkData").glob("*.mat")):
        if "SpecialOddMSine" in path.name:
            continue
        content = _mat(path)
        pair = content["Force"][0], np.asarray(content["Acceleration"][0], dtype=np.float64).ravel()
        if "Validation" in path.name:
            tests.append([pair])
        else:
            learn.append(pair)
    return learn, tests


def _mirror(folder: Path) -> Pairs:
    """Read combined_data.npz, or the twelve .npy files: arrays (8192, 3, realisations, periods)."""
    packed = folder / "combined_data.npz"
    content = np.load(packed) if packed.is_file() else None

    def records(level: str, use: str) -> list[list[Pair]]:
        """Return the periods of each realisation."""
        names = [f"{channel}_{level}mV_{use}" for channel in "uy"]
        u, y = (np.load(folder / f"{name}.npy") if content is None else content[name] for name in names)
        return [[(u[:, :, r, p], y[:, :, r, p]) for p in range(u.shape[3])] for r in range(u.shape[2])]

    levels = ("100", "200", "300")
    by_level = [records(level, "train") for level in levels]
    learn = [pair for realisation in zip(*by_level, strict=True) for periods in realisation for pair in periods]
    return learn, [[pair for periods in records(level, "test") for pair in periods] for level in levels]


def _noisy(folder: Path) -> Pairs:
    """Read the files WH_*, .mat or .csv: a record of each realisation, those of WH_Combined... last."""
    files = {path.stem: path for kind in ("mat", "csv") for path in folder.glob(f"WH_*.{kind}")}
    learn: list[Pair] = []
    test: list[Pair] = []
    for name in sorted(files, key=lambda name: ("Combined" in name, name)):
        (test if "Test" in name else learn).extend(_realisations(files[name]))
    return learn, [test]


def _realisations(path: Path) -> list[Pair]:
    """Return u and y of each realisation: of ``dataMeas`` (r, u, y, fs), or the columns behind a CSV's titles u, y."""
    if path.suffix == ".mat":
        _, u, y, _ = _mat(path)["dataMeas"][0, 0]
        return list(zip(u.T, y.T, strict=True))
    with path.open(encoding="utf-8-sig") as lines:
        titles = [title.strip().strip('"') for title in lines.readline().split(",")]
    first, second = titles.index("u"), titles.index("y")
    count = second - first
    table = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=range(first, second + count), ndmin=2).T
    return list(zip(table[:count], table[count:], strict=True))


def _nano_drone(folder: Path) -> Pairs:
    """Read the CSV files of train/ and test/."""
    inputs = [f"m{k}_rads" for k in (1, 2, 3, 4)]
    outputs = ["x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw", "wx", "wy", "wz"]

    def flights(use: str, motions: Sequence[str], runs: int) -> list[Pair]:
        found = []
        for motion in motions:
            for run in range(1, runs + 1):
                table = _columns(folder / use / f"{motion}_20251017_run{run}.csv", [*inputs, *outputs])
                found.append((np.column_stack(table[:4]), np.column_stack(table[4:])))
        return found

    return flights("train", ("square", "random", "chirp"), 4), [flights("test", ("melon",), 3)] * 4


READERS: dict[str, tuple[str, Callable[[Path], Pairs]]] = {
    "silverbox": ("SNLS80mV.mat", _silverbox),
    "wiener-hammerstein": ("WienerHammerBenchMark.mat", _wiener_hammerstein),
    "cascaded-tanks": ("dataBenchmark.*", _cascaded_tanks),
    "coupled-drives": ("DATAUNIF.*", _coupled_drives),
    "emps": ("DATA_EMPS_PULSES.mat", _emps),
    "parallel-wiener-hammerstein": ("ParWHData.mat", _parallel),
    "f16": ("BenchmarkData/*.mat", _f16),
    "fine-steering-mirror": ("[cu]*_*.np[yz]", _mirror),
    "nano-drone": ("test/melon_*.csv", _nano_drone),
    "noisy-wiener-hammerstein": ("WH_TestDataset.*", _noisy),
}
"""By id: what shows that a folder holds the set, and its reader."""


def found_in(rule: Rule, folder: Path | None = None) -> Path | None:
    """Return the folder that holds a set, or None: below the given one, by default ``$SYSID_HARNESS_DATA``."""
    root = folder if folder is not None else Path(os.environ.get(DATA_FOLDER, "") or "/nowhere")
    place = root / rule.folder
    sign = READERS.get(rule.id)
    return place if sign is not None and next(place.glob(sign[0]), None) is not None else None


def read(rule: Rule, folder: Path) -> PublicSplit:
    """Return a set from its folder; what a file ``origin.txt`` there says of its data stands beside the figures.

    Raises InputError if a file of it is missing or is not what the rule speaks of.
    """
    try:
        stated = folder / ORIGIN
        origin = stated.read_text(encoding="utf-8").strip() if stated.is_file() else f"files in {rule.folder}"
        return _split(rule, READERS[rule.id][1](folder), " ".join(origin.split()))
    except (KeyError, OSError, ValueError, IndexError) as error:
        raise InputError(
            f"files of {rule.title}",
            expected=rule.files,
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:120]}",
            remedy=f"get them from {rule.download}",
            file=folder,
        ) from error


def downloaded(rule: Rule) -> PublicSplit:
    """Return a set through the official loader, which downloads it once and keeps it below the home folder.

    Raises InputError if the package (extra ``download``) is missing or too old for the set, its window is not the
    rule's, or the download fails.
    """
    package = optional("nonlinear_benchmarks", "the download of a public set", "'sysid-harness[download]'")
    load = None if rule.loader is None else getattr(package, rule.loader, None)
    if load is None:
        raise InputError(
            f"download of {rule.title}", expected="a set that the official loader has", got="none of that name",
            remedy=rule.where,
        )  # fmt: skip
    try:
        train, tests = load(always_return_tuples_of_datasets=True)
    except Exception as error:  # whatever the network or the loader raises
        raise InputError(
            f"download of {rule.title}",
            expected="an answer of its server",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:120]}",
            remedy=rule.where,
        ) from error
    windows = {one.state_initialization_window_length for one in tests}
    if rule.metric == "window" and windows != {rule.window}:
        raise InputError(
            f"window of {rule.title}", expected=f"{rule.window}, as of 2026-06", got=str(windows),
            remedy="install the newest nonlinear_benchmarks",
        )  # fmt: skip
    return _split(rule, _of_loader(rule, train, tests), f"nonlinear_benchmarks.{rule.loader}")


def _of_loader(rule: Rule, train: Any, tests: Sequence[Any]) -> Pairs:
    """Return what the loader gave as pairs: realisations apart, interleaved periods one after the other."""

    def pairs(one: Any) -> list[Pair]:
        u, y = np.asarray(one.u, dtype=np.float64), np.asarray(one.y, dtype=np.float64)
        if u.ndim == 4:
            return [(u[:, :, r, p], y[:, :, r, p]) for r in range(u.shape[2]) for p in range(u.shape[3])]
        if rule.loader == "ParWH":
            return [(u.reshape(-1, 2).T.reshape(-1), y.reshape(-1, 2).T.reshape(-1))]
        return [(u, y)]

    groups = [pairs(one) for one in ([train] if hasattr(train, "u") else train)]
    learn = [pair for same in zip(*groups, strict=True) for pair in same]
    found = [pairs(one) for one in tests]
    return learn, found if rule.metric == "window" else [[flight for one in found for flight in one]] * len(rule.tests)


def _split(rule: Rule, pairs: Pairs, origin: str) -> PublicSplit:
    """Return pairs as records of the rule's channels."""

    def record(pair: Pair) -> Trajectory:
        u, y = (np.asarray(one, dtype=np.float64).reshape(len(one), -1) for one in pair)
        return Trajectory(rule.spec.sample_time * np.arange(len(u), dtype=np.float64), u, y, rule.spec)

    learn, tests = pairs
    if len(tests) != len(rule.tests) or not learn:
        raise InputError(
            f"records of {rule.title}",
            expected=f"some to learn from, and tests {', '.join(rule.tests)}",
            got=f"{len(learn)} and {len(tests)}",
            remedy=rule.where,
        )
    return PublicSplit(tuple(map(record, learn)), tuple(tuple(map(record, group)) for group in tests), origin)
