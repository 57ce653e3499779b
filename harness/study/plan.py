"""What the studies run: one task is one pair of records, and the order is such that any first part is balanced."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import chain, zip_longest
from typing import Any

from harness.errors import InputError
from harness.rng import stream

__all__ = ["BASES", "NOISE", "PLANTS", "STUDIES", "Task", "plan"]

STUDIES = ("confusion", "false-alarms", "coverage", "cost")
PLANTS = ("pendulum", "cart-pole")
BASES = {"tuning": 0, "judged": 100_000}
"""Records from 10 000, 20 000, ..., 70 000 on judged earlier versions: they judge no more."""
NOISE = {"low": 1e-4, "high": 1e-3}
"""Standard deviation of the sensors [rad, m]."""

_COORDINATE = (
    "coulomb_friction",
    "stribeck_friction",
    "asymmetric_friction",
    "hysteresis",
    "sublinear_friction",
    "load_dependent_friction",
    "quadratic_drag",
    "linear_spring",
    "cubic_spring",
    "force_bias",
    "payload_step",
    "end_stop",
    "cogging",
    "periodic_disturbance",
)
_ANGLE = ("position_dependent_friction", "eccentric_load", "quadratic_spring")
_INPUT = ("input_delay", "actuator_lag", "dead_zone", "saturation", "rate_limit", "input_gain")
_DRIVEN = ("elasticity", "backlash")
_OUTPUT = (
    "sensor_delay",
    "sensor_gain",
    "sensor_offset",
    "sensor_quantisation",
    "sensor_rectification",
    "sensor_saturation",
)
# Not hidden: viscous_friction, which both models have on every coordinate; leak, overflow, level_saturation, which
# belong to tanks; quadratic_spring on the cart, which would run away to infinity.
PAIRS = {
    "pendulum": (
        ("coulomb_friction@theta", "force_bias@theta"),
        ("coulomb_friction@theta", "quadratic_drag@theta"),
        ("coulomb_friction@theta", "input_delay@u"),
        ("stribeck_friction@theta", "gravity_tilt@base"),
        ("quadratic_drag@theta", "cogging@theta"),
        ("cubic_spring@theta", "coulomb_friction@theta"),
        ("linear_spring@theta", "dead_zone@u"),
        ("saturation@u", "coulomb_friction@theta"),
        ("end_stop@theta", "quadratic_drag@theta"),
        ("actuator_lag@u", "periodic_disturbance@theta"),
    ),
    "cart-pole": (
        ("coulomb_friction@x", "coulomb_friction@theta"),
        ("coulomb_friction@x", "input_delay@u"),
        ("quadratic_drag@x", "coulomb_friction@theta"),
        ("linear_spring@x", "coulomb_friction@x"),
        ("dead_zone@u", "quadratic_drag@theta"),
        ("coulomb_friction@x", "sensor_offset@theta"),
        ("saturation@u", "linear_spring@theta"),
        ("cogging@x", "coulomb_friction@theta"),
        ("coulomb_friction@x", "gravity_tilt@base"),
        ("periodic_disturbance@x", "coulomb_friction@theta"),
    ),
}
OUTSIDE = {
    "pendulum": (
        "even_drag@theta",
        "position_damping@theta",
        "torque_ripple@theta",
        "force_step@theta",
        "maxwell_element@theta",
    ),
    "cart-pole": (
        "even_drag@theta",
        "position_damping@theta",
        "force_step@x",
        "maxwell_element@x",
        "maxwell_element@theta",
    ),
}
_ENGINES = {
    ("pendulum", ""): ("laws", "bullet", "fmu"),
    ("pendulum", "coulomb_friction@theta"): ("laws", "bullet", "fmu"),
    ("pendulum", "stribeck_friction@theta"): ("laws", "fmu"),
    ("pendulum", "quadratic_drag@theta"): ("laws", "fmu"),
    ("cart-pole", ""): ("laws", "pymunk", "fmu", "balanced"),
    ("cart-pole", "coulomb_friction@x"): ("laws", "pymunk", "fmu", "balanced"),
    ("cart-pole", "coulomb_friction@theta"): ("laws", "pymunk", "fmu", "balanced"),
    ("cart-pole", "coulomb_friction@x + coulomb_friction@theta"): ("laws", "pymunk"),
    ("cart-pole", "linear_spring@x"): ("laws", "pymunk"),
    ("cart-pole", "linear_spring@theta"): ("laws", "pymunk"),
    ("cart-pole", "linear_spring@x + coulomb_friction@x"): ("laws", "pymunk"),
}


@dataclass(frozen=True)
class Task:
    """One pair of records (estimation and validation) and what is hidden in it.

    Attributes
    ----------
    study : str
        ``confusion``, ``two``, ``outside``, ``none`` or ``cost``.
    plant : str
    engine : str
        Who simulates the truth: ``laws`` (hand-written), ``bullet``, ``pymunk``, ``fmu``, ``balanced`` (pymunk, upright
        under LQR).
    effects : tuple of str
        ``effect@place``; empty for nothing missing.
    level : str
        ``nominal`` or ``quarter``; empty for nothing missing.
    noise : str
        ``low``, ``high`` or ``drawn`` (between the two).
    disturbance : float
        Unknown coloured torque over the rms torque.
    index : int
        Repetition.
    base : int
        0 for tuning, 100000 for judging: no record is drawn from both.
    model : str
        The nominal model: ``equations``, or ``fmu`` (the same as a black box).
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

    @property
    def key(self) -> str:
        """What names the row, and keys its random numbers."""
        hidden = " + ".join(self.effects) or "none"
        parts = (self.study, self.plant, self.engine, hidden, self.level, self.noise, f"{self.disturbance:g}")
        last = () if self.model == "equations" else (self.model,)
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
    cells: int = 2,
    alarms: int = 300,
) -> list[Task]:
    """Return the tasks of a study in the order in which they run.

    Parameters
    ----------
    study : str
        One of :data:`STUDIES`, or ``all``.
    base : int
        0 (tuning) or 100000 (judged).
    plants : sequence of str
    records : int, optional
        Only the first so many tasks.
    cells : int
        Records of each effect, out of the eight cells noise x size x disturbance: 2 have both sizes, 4 are a half
        fraction, 8 are all.
    alarms : int
        Records with nothing missing of each class (white, coloured).

    Raises
    ------
    InputError
        If a word is unknown.

    Examples
    --------
    >>> tasks = plan("false-alarms", alarms=2)
    >>> [(one.plant, one.disturbance) for one in tasks]
    [('pendulum', 0.0), ('pendulum', 0.02), ('cart-pole', 0.0), ('cart-pole', 0.02)]
    """
    if study not in (*STUDIES, "all"):
        raise InputError("study", expected=f"one of {', '.join(STUDIES)} or all", got=repr(study), remedy="correct it")
    wrong = sorted(set(plants) - set(PLANTS))
    if wrong or not plants:
        raise InputError("plants", expected=", ".join(PLANTS), got=", ".join(wrong) or "none", remedy="choose of these")
    if records is not None and records < 1:
        raise InputError("records", expected="at least 1", got=str(records), remedy="raise the number")
    parts: list[list[Task]] = []
    if study in ("confusion", "all"):
        parts += [_spread(*(make(plants, base, cells) for make in (_cells, _pairs, _outside)))]
    if study in ("false-alarms", "coverage", "all"):
        parts += [_nothing(plants, base, alarms)]
    found = _spread(*parts)
    if study in ("cost", "all"):
        found += _cost(plants, base)
    return found[:records]


def places(plant: str) -> list[str]:
    """Return every effect of the confusion study at every place it fits."""
    coordinates = ("theta",) if plant == "pendulum" else ("x", "theta")
    driven = coordinates[0]
    found = [f"{name}@{at}" for name in _COORDINATE for at in coordinates if _apart(name, at, driven)]
    found += [f"{name}@theta" for name in _ANGLE] + ["gravity_tilt@base"]
    found += [f"{name}@u" for name in _INPUT] + [f"{name}@{driven}" for name in _DRIVEN]
    return found + [f"{name}@{at}" for name in _OUTPUT for at in coordinates]


def _apart(name: str, at: str, driven: str) -> bool:
    """Return False for what makes no sense on a coordinate that nothing drives."""
    return at == driven or name != "periodic_disturbance"


def _cells(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return the first cells of noise x size x disturbance for every effect and none."""
    found = []
    for index in range(cells):
        rows: list[list[Task]] = []
        for plant in plants:
            here = []
            for number, name in enumerate(["", *places(plant)]):
                # every engine that has the effect takes a turn of its own, beside the hand-written laws
                for turn, engine in enumerate(_ENGINES.get((plant, name), ("laws",))):
                    # Four make a half fraction: two levels choose the third, the other way round for every other four
                    # effects. Neighbours in this order differ in size; effects start at different cells.
                    noise, size = ((0, 0), (1, 1), (1, 0), (0, 1))[(index + number + turn) % 4]
                    shaken = (noise + size + number // 4 + index // 4) % 2
                    if name.startswith("sensor_rectification"):
                        size = 0
                    here.append(
                        Task(
                            "confusion",
                            plant,
                            engine,
                            (name,) if name else (),
                            ("nominal", "quarter")[size] if name else "",
                            ("low", "high")[noise],
                            0.02 * shaken,
                            index,
                            base,
                        )
                    )
            order = stream("study-order", plant, index).permutation(len(here))
            rows.append([here[k] for k in order])
        found += _spread(*rows)
    return found


def _pairs(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return two effects at once, the pairs in turn at low and high noise."""
    found = []
    for index in range(max(1, cells // 2)):
        rows = []
        for plant in plants:
            here = []
            for number, pair in enumerate(PAIRS[plant]):
                engines = _ENGINES.get((plant, " + ".join(pair)), ("laws",))
                noise = ("low", "high")[(number + index) % 2]
                coloured = 0.02 * ((number // 2 + index // 2) % 2)
                engine = engines[index % len(engines)]
                here.append(Task("two", plant, engine, pair, "nominal", noise, coloured, index, base))
            rows.append(here)
        found += _spread(*rows)
    return found


def _outside(plants: Sequence[str], base: int, cells: int) -> list[Task]:
    """Return laws that the dictionary does not have, in turn at low and high noise."""
    found = []
    for index in range(max(1, cells // 2)):
        rows = []
        for plant in plants:
            rows.append(
                [
                    Task("outside", plant, "laws", (name,), "nominal", ("low", "high")[(number + index) % 2], 0.0,
                         index, base)
                    for number, name in enumerate(OUTSIDE[plant])
                ]
            )  # fmt: skip
        found += _spread(*rows)
    return found


def _nothing(plants: Sequence[str], base: int, count: int) -> list[Task]:
    """Return records with nothing missing, the classes and plants in turn."""
    found = []
    for number in range(count):
        plant, index = plants[number % len(plants)], number // len(plants)
        engines = _ENGINES[plant, ""]
        # the hand-written laws every other time, the engines between
        engine = "laws" if index % 2 == 0 else engines[1 + (index // 2) % (len(engines) - 1)]
        found += [Task("none", plant, engine, (), "", "drawn", level, index, base) for level in (0.0, 0.02)]
    return found


def _cost(plants: Sequence[str], base: int) -> list[Task]:
    """Return the records that are timed alone, with two workers: compiled models, and the FMU of each plant."""
    found = []
    for model in ("equations", "fmu"):
        for plant in plants:
            for name in ("", "coulomb_friction@x" if plant == "cart-pole" else "coulomb_friction@theta"):
                effects, level = ((name,), "nominal") if name else ((), "")
                found.append(Task("cost", plant, "laws", effects, level, "high", 0.0, 0, base, model))
    return found


def _spread(*rows: Sequence[Task]) -> list[Task]:
    """Merge lists so that each is spread evenly over the whole, in its own order."""
    rows = tuple(one for one in rows if one)
    if len({len(one) for one in rows}) == 1:
        return [one for one in chain.from_iterable(zip_longest(*rows)) if one is not None]
    marked = [((k + 0.5) / len(one), n, task) for n, one in enumerate(rows) for k, task in enumerate(one)]
    return [task for _, _, task in sorted(marked, key=lambda item: item[:2])]
