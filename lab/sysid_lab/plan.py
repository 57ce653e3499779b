"""What the studies run: one task is one pair of records, and the order is such that any first part is balanced."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import chain, zip_longest
from typing import Any

from harness.errors import InputError
from harness.rng import stream
from sysid_lab.catalogue import OUTSIDE, PAIRS, places, sources
from sysid_lab.truths.disturbances import KINDS, STRUCTURES, TRUTH_ONLY, named

STUDIES = ("confusion", "false-alarms", "coverage", "cost")
PLANTS = ("pendulum", "cart-pole")
BASES = {"tuning": 0, "judged": 650_000}
"""Records from 10 000, 20 000, ..., 640 000, 645 000 and 646 000 on judged earlier versions or were seen: they judge no
more."""
SHARES = {"confusion": 12, "none": 10, "two": 5, "outside": 3, "cost": 1}
"""Of the strata in any first part of a plan, while they last."""
NOISE = {"low": 1e-4, "high": 1e-3}  # Standard deviation of the sensors [rad, m].

_ODD = tuple(kind for kind in KINDS if kind != "gauss-markov")
_STILL = {
    "pendulum": ("bullet", "laws", "bullet", "fmu"),
    "cart-pole": ("pymunk", "laws", "balanced", "pymunk", "fmu"),
}
"""Who simulates the records with nothing missing, in turn."""
_DISTURBED = 0.02  # Unknown force over the rms torque.
_INPUT_NOISE = 0.01  # Noise of a recorded input over its rms.


@dataclass(frozen=True)
class Task:
    """One pair of records (estimation and validation) and what is hidden in it.

    Attributes
    ----------
    study : str
        ``confusion``, ``two``, ``outside``, ``none`` or ``cost``.
    plant : str
    engine : str
        Who simulates the truth: ``laws`` (the dictionary's formulas in C), ``hardware`` (other formulations, see
        :mod:`sysid_lab.truths.hardware`), ``bullet``, ``pymunk``, ``fmu``, ``balanced`` (pymunk, upright under LQR).
    effects : tuple of str
        ``effect@place``; empty for nothing missing.
    level : str
        ``nominal`` or ``quarter``; empty for nothing missing.
    noise : str
        ``low``, ``high`` or ``drawn`` (between the two).
    disturbance : float
        Unknown torque over the rms torque.
    index : int
        Repetition.
    base : int
        0 for tuning, that of :data:`BASES` for judging: no record is drawn from both.
    model : str
        The nominal model: ``equations``, or ``fmu`` (the same as a black box).
    shape : str
        Kind of the unknown torque, of :data:`sysid_lab.truths.disturbances.KINDS`.
    structure : str
        How the nominal structure is a little wrong, of :data:`sysid_lab.truths.disturbances.STRUCTURES`; empty where it
        is right.
    input_noise : float
        Noise of the recorded input over its rms.
    """

    study: str
    plant: str
    engine: str
    effects: tuple[str, ...]
    level: str
    noise: str
    disturbance: float
    index: int
    base: int
    model: str = "equations"
    shape: str = "gauss-markov"
    structure: str = ""
    input_noise: float = 0.0

    @property
    def key(self) -> str:
        """What names the row, and keys its random numbers."""
        hidden = " + ".join(self.effects) or "none"
        parts = (self.study, self.plant, self.engine, hidden, self.level, self.noise, f"{self.disturbance:g}")
        last = [] if self.model == "equations" else [self.model]
        last += [self.shape] if self.disturbance and self.shape != "gauss-markov" else []
        last += [self.structure] if self.structure else []
        last += [f"input {self.input_noise:g}"] if self.input_noise else []
        return "|".join((*parts, str(self.index), str(self.base), *last))

    @property
    def seed(self) -> int:
        """Return the seed of the row: its base, and what its key says."""
        return self.base + zlib.crc32(self.key.encode()) % 1000

    def columns(self) -> dict[str, Any]:
        """Return what the row of this task begins with."""
        values = {name: value for name, value in asdict(self).items() if name != "effects"}
        return {"key": self.key, **values, "seed": self.seed, "truth": " + ".join(self.effects)}


def plan(
    study: str = "all",
    *,
    base: int = 0,
    plants: Sequence[str] = PLANTS,
    records: int | None = None,
    cells: int = 4,
    alarms: int = 400,
) -> list[Task]:
    """Return the tasks of a study in the order in which they run.

    Any first part holds the strata in the shares :data:`SHARES`, and each stratum its plants, engines, sizes, noises,
    disturbances and structures in turn.

    Parameters
    ----------
    study : str
        One of :data:`STUDIES`, or ``all``.
    base : int
        0 (tuning) or that of :data:`BASES` (judged).
    plants : sequence of str
    records : int, optional
        Only the first so many tasks.
    cells : int
        Records of each effect, out of the eight cells noise x size x disturbance: 2 have both sizes, 4 are a half
        fraction, 8 are all.
    alarms : int
        Records with nothing missing and a right nominal structure of each class (white, disturbed); half as many more
        have a structure that is a little wrong.

    Raises
    ------
    InputError
        If a word is unknown.

    Examples
    --------
    >>> tasks = plan("false-alarms", alarms=2)
    >>> [(task.plant, task.disturbance) for task in tasks][:4]
    [('pendulum', 0.0), ('pendulum', 0.02), ('cart-pole', 0.0), ('cart-pole', 0.02)]
    """
    if study not in (*STUDIES, "all"):
        raise InputError("study", expected=f"one of {', '.join(STUDIES)} or all", got=repr(study), remedy="correct it")
    wrong = sorted(set(plants) - set(PLANTS))
    if wrong or not plants:
        raise InputError("plants", expected=", ".join(PLANTS), got=", ".join(wrong) or "none", remedy="choose of these")
    if records is not None and records < 1:
        raise InputError("records", expected="at least 1", got=str(records), remedy="raise the number")
    strata: dict[str, list[Task]] = {}
    if study in ("confusion", "all"):
        strata |= {
            "confusion": _cells(plants, base, cells),
            "two": _pairs(plants, base, cells),
            "outside": _outside(plants, base, cells),
        }
    if study in ("false-alarms", "coverage", "all"):
        strata["none"] = _nothing(plants, base, alarms)
    if study in ("cost", "all"):
        strata["cost"] = _cost(plants, base)
    return _in_shares(strata)[:records]


def _cells(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return the first cells of noise x size x disturbance for every effect."""
    found = []
    for index in range(cells):
        rows: list[list[Task]] = []
        for plant in plants:
            here = []
            for number, name in enumerate(places(plant)):
                # Four make a half fraction: two levels choose the third, the other way round for every other four
                # effects. Neighbours in this order differ in size; effects start at different cells.
                noise, size = ((0, 0), (1, 1), (1, 0), (0, 1))[(index + number) % 4]
                shaken = (noise + size + number // 4 + index // 4) % 2
                if name.startswith("sensor_rectification"):
                    size = 0
                engine = _turn(sources(plant, [name]), number + index)
                level, words = ("nominal", "quarter")[size], ("low", "high")[noise]
                more = _surroundings(plant, engine, (name,), index, shaken)
                here.append(
                    Task("confusion", plant, engine, (name,), level, words, _DISTURBED * shaken, index, base, **more)
                )
            order = stream("study-order", plant, index).permutation(len(here))
            rows.append([here[k] for k in order])
        found += _spread(*rows)
    return found


def _turn(engines: Sequence[str], number: int) -> str:
    """Return who has the turn, our own laws every sixth where there is somebody else.

    The FMUs integrate the same formulas in C as our laws do (they agree to rounding), so others go before them.
    """
    others = [engine for engine in engines if engine not in ("laws", "fmu")]
    order = [*others, *others, *(engine for engine in engines if engine == "fmu")] or ["laws"]
    if number % 6 == 5:
        return "laws"
    return order[(number - number // 6) % len(order)]


def _surroundings(plant: str, engine: str, what: Sequence[str], index: int, shaken: int) -> dict[str, Any]:
    """Return the kind of disturbance, and for a third of the records how the nominal structure is a little wrong."""
    draw = stream("study-surroundings", f"{plant} {' '.join(what)}", index)
    start = int(draw.integers(0, 12))
    shape = "gauss-markov"
    if shaken and engine != "balanced" and (start + index) % 3 == 0:
        shape = _ODD[int(draw.integers(0, len(_ODD)))]
    structure = ""
    if engine != "balanced" and (start // 3 + index) % 3 == 0:
        able = [name for name in STRUCTURES if _may(name, plant, engine) and named(name, plant) not in what]
        structure = able[int(draw.integers(0, len(able)))]
    return {"shape": shape, "structure": structure}


def _may(structure: str, plant: str, engine: str) -> bool:
    """Return whether a truth can have a structure."""
    return structure not in TRUTH_ONLY or (plant == "cart-pole" and engine in ("laws", "hardware"))


def _pairs(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return two effects at once, the pairs in turn at low and high noise, without and with a disturbance."""
    found = []
    for index in range(cells):
        rows = []
        for plant in plants:
            here = []
            for number, pair in enumerate(PAIRS[plant]):
                noise = ("low", "high")[(number + index) % 2]
                shaken = (number + index // 2) % 2
                engine = _turn(sources(plant, pair), number + index)
                more = _surroundings(plant, engine, pair, index, shaken)
                here.append(
                    Task("two", plant, engine, pair, "nominal", noise, _DISTURBED * shaken, index, base, **more)
                )
            order = stream("study-pairs", plant, index).permutation(len(here))
            rows.append([here[k] for k in order])
        found += _spread(*rows)
    return found


def _outside(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return laws that the dictionary does not have, in turn at low and high noise."""
    found = []
    for index in range(cells):
        rows = []
        for plant in plants:
            here = []
            for number, name in enumerate(OUTSIDE[plant]):
                engine = _turn(sources(plant, [name]), number + index)
                noise = ("low", "high")[(number + index) % 2]
                here.append(Task("outside", plant, engine, (name,), "nominal", noise, 0.0, index, base))
            rows.append(here)
        found += _spread(*rows)
    return found


def _nothing(plants: Sequence[str], base: int, count: int) -> list[Task]:
    """Return records with nothing missing, the classes, plants, engines and kinds of disturbance in turn.

    Every third has a nominal structure that is a little wrong; of the others every fifth has a noisy input.
    """
    found = []
    for number in range(count + count // 2):
        plant, index = plants[number % len(plants)], number // len(plants)
        structure, turn = "", index // 3
        engine = _STILL[plant][turn % len(_STILL[plant])]
        if index % 3 == 2:
            engine = "laws" if engine == "balanced" else engine
            able = [name for name in STRUCTURES if _may(name, plant, engine)]
            structure = able[turn % len(able)]
        for shaken in (0, 1):
            shape = "gauss-markov"
            if shaken and engine != "balanced":
                shape = tuple(KINDS)[index % len(KINDS)]
            noisy = _INPUT_NOISE if not structure and (index + shaken) % 5 == 1 else 0.0
            found.append(
                Task("none", plant, engine, (), "", "drawn", _DISTURBED * shaken, index, base, shape=shape,
                     structure=structure, input_noise=noisy)
            )  # fmt: skip
    return found


def _cost(plants: Sequence[str], base: int) -> list[Task]:
    """Return the records that are timed as a user meets them: the command in a process of its own, twice."""
    found = []
    for index in range(2):
        for shaken in (0.0, _DISTURBED):
            for plant in plants:
                for name in ("", "coulomb_friction", "dead_zone", "backlash"):
                    at = "u" if name == "dead_zone" else "x" if plant == "cart-pole" else "theta"
                    effects, level = ((f"{name}@{at}",), "nominal") if name else ((), "")
                    found.append(Task("cost", plant, "laws", effects, level, "high", shaken, index, base))
    fmu = [
        Task("cost", plant, "laws", effects, "nominal" if effects else "", "high", 0.0, 0, base, "fmu")
        for plant in plants
        for effects in ((), ("coulomb_friction@x" if plant == "cart-pole" else "coulomb_friction@theta",))
    ]
    return _spread(found, fmu)


def _in_shares(strata: dict[str, list[Task]]) -> list[Task]:
    """Merge strata so that any first part has them in their shares, as far as they last."""
    left = {name: list(reversed(tasks)) for name, tasks in strata.items() if tasks}
    owed = dict.fromkeys(left, 0.0)
    found = []
    while left:
        whole = sum(SHARES[name] for name in left)
        for name in left:
            owed[name] += SHARES[name] / whole
        chosen = max(left, key=lambda name: owed[name])
        owed[chosen] -= 1.0
        found.append(left[chosen].pop())
        if not left[chosen]:
            del left[chosen]
    return found


def _spread(*rows: Sequence[Task]) -> list[Task]:
    """Merge lists so that each is spread evenly over the whole, in its own order."""
    rows = tuple(row for row in rows if row)
    if len({len(row) for row in rows}) == 1:
        return [task for task in chain.from_iterable(zip_longest(*rows)) if task is not None]
    marked = [((k + 0.5) / len(row), n, task) for n, row in enumerate(rows) for k, task in enumerate(row)]
    return [task for _, _, task in sorted(marked, key=lambda item: item[:2])]
