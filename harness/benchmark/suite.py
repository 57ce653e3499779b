"""Suites: a TOML file that names plants, scenarios, identifiers and seeds; and the cells that come of it."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Sequence
from pathlib import Path

import msgspec

from harness import registry
from harness.benchmark.parts import (
    RECORDED,
    RECORDING,
    Cell,
    Group,
    ScoreSettings,
    Suite,
    SuitePart,
    Task,
    axes_problem,
    expanded,
)
from harness.errors import InputError
from harness.fingerprint import files_named, fingerprint, own_code
from harness.parts.files import fingerprint as plant_fingerprint
from harness.parts.files import is_plant_file, stream_key
from harness.toml_file import read_toml
from harness.trust import registered_only


def find_suite(suite: str | Path) -> Path:
    """Return the file of a suite: a path that ends in ``.toml``, or the name of a registered suite.

    Raises InputError if there is no such file or name.

    Examples
    --------
    >>> find_suite("quick").name
    'quick.toml'
    """
    if is_file(suite):
        path = Path(suite)
        if not path.is_file():
            raise InputError(
                "no such suite", expected="a TOML file", got="no file", remedy="check the path", file=str(suite)
            )
        return path
    return Path(registry.load("suites", str(suite)))


def is_file(suite: str | Path) -> bool:
    """Return True for the path of a suite, False for the name of a registered one."""
    return isinstance(suite, Path) or str(suite).endswith(".toml")


def load_suite(suite: str | Path) -> Suite:
    """Read a suite.

    Parameters
    ----------
    suite : str or path
        Name of a registered suite, or a TOML file.

    Raises
    ------
    InputError
        If the file is no TOML, a key is unknown, a value has the wrong type, two rows would have one name, or it names
        code that is not trusted (:func:`harness.trust.trusting`).

    Examples
    --------
    >>> load_suite("quick").name
    'quick'
    """
    path = find_suite(suite)
    read = read_toml(path, Suite)
    if is_file(suite):  # a registered suite is installed, as code is
        for number, group in enumerate(read.groups):
            for kind in ("plants", "scenarios", "identifiers"):
                for index, part in enumerate(getattr(group, kind)):
                    place = f"groups[{number}].{kind}[{index}]"
                    registered_only(part.id, file=path, place=f"{place}.id")
                    registered_only(part.options, file=path, place=f"{place}.options", options=True)
            registered_only(msgspec.to_builtins(group.axes), file=path, place=f"groups[{number}].axes", options=True)
    read = msgspec.structs.replace(read, groups=tuple(_located(group, path.parent) for group in read.groups))
    for number, group in enumerate(read.groups):
        _check_group(group, f"groups[{number}]", path)
    read = msgspec.structs.replace(read, groups=tuple(expanded(group) for group in read.groups))
    if not read.groups or read.time_limit <= 0:
        raise InputError(
            "suite", expected="at least one group and a positive time_limit", got="none", remedy="add it", file=path
        )
    seen: set[tuple[str, ...]] = set()
    for number, group in enumerate(read.groups):
        for row in itertools.product(group.plants, group.scenarios, group.identifiers):
            names = tuple(part.name for part in row)
            if names in seen:
                raise InputError(
                    "two rows with one name",
                    expected="every plant x scenario x identifier once",
                    got=" x ".join(names),
                    remedy='give one of them a label = "..."',
                    file=path,
                    place=f"groups[{number}]",
                )
            seen.add(names)
    return read


def tasks_of(suite: Suite, seeds: Sequence[int] | None = None) -> tuple[Task, ...]:
    """Return the work of a suite in its fixed order.

    - ``suite``: what to run
    - ``seeds``: instead of the seeds of the file

    Examples
    --------
    >>> len(tasks_of(load_suite("quick"), seeds=[0])) < len(tasks_of(load_suite("quick"), seeds=[0, 1]))
    True
    """
    tasks = []
    for group in suite.groups:
        wanted = seeds if seeds is not None else (suite.seeds if group.seeds is None else group.seeds)
        limit = suite.time_limit if group.time_limit is None else group.time_limit
        for plant, scenario in itertools.product(group.plants, group.scenarios):
            for seed in wanted:
                cells = tuple(
                    Cell(_job(plant, scenario, identifier, seed, group.score), identifier)
                    for identifier in group.identifiers
                )
                tasks.append(Task(plant, scenario, int(seed), group.score, limit, cells))
    return tuple(tasks)


def cells_of(tasks: Sequence[Task]) -> list[tuple[Task, Cell]]:
    """Return every cell with its task, in the fixed order of the table: seeds innermost."""
    pairs = [(task, cell) for task in tasks for cell in task.cells]
    rank: dict[tuple[str, ...], int] = {}
    for task, cell in pairs:
        rank.setdefault((task.plant.name, task.scenario.name, cell.identifier.name), len(rank))
    return sorted(pairs, key=lambda p: (rank[p[0].plant.name, p[0].scenario.name, p[1].identifier.name], p[0].seed))


def _job(plant: SuitePart, scenario: SuitePart, identifier: SuitePart, seed: int, score: ScoreSettings) -> str:
    """Return the hash of everything that decides a row, the code of the project included."""
    content = {
        "project": own_code(),
        "plant": (plant_fingerprint(plant.id) if is_plant_file(plant.id) else plant.id, plant.name, plant.options),
        "scenario": (scenario.id, scenario.name, scenario.options),
        "identifier": (identifier.id, identifier.name, identifier.options),
        "seed": seed,
        "score": score,
    }
    kinds = (("plants", plant), ("scenarios", scenario), ("identifiers", identifier))
    if codes := [code for kind, part in kinds if (code := registry.code_of(kind, part.id))]:
        content["code"] = codes  # a plug-in that was changed is another
    if files := [path for _, part in kinds for path in files_named(part.options)]:
        content["files"] = fingerprint(files)
    if plant.streams or scenario.streams:
        content["streams"] = (plant.stream, scenario.stream)
    return hashlib.sha256(msgspec.json.encode(content, order="deterministic")).hexdigest()[:20]


def _located(group: Group, folder: Path) -> Group:
    """Return a group whose plants' files are found from anywhere; in the table they go by their names."""
    plants = [_placed(part, (folder / part.id).resolve()) if is_plant_file(part.id) else part for part in group.plants]
    return msgspec.structs.replace(group, plants=tuple(plants))


def _placed(part: SuitePart, path: Path) -> SuitePart:
    """Return a plant with the place of its file; its draws hang on what is in it, unless it has a name here."""
    streams = part.streams or part.label
    if not streams:
        with contextlib.suppress(InputError):  # a file that cannot be read is refused by its place, a little later
            streams = stream_key(str(path))
    return msgspec.structs.replace(part, id=str(path), label=part.label or path.name, streams=streams)


def _check_group(group: Group, place: str, path: Path) -> None:
    """Refuse an empty group, a part that is not registered, a negative seed, a score without records."""
    problems = [
        (not group.plants, "plants", "at least one"),
        (not group.scenarios, "scenarios", "at least one"),
        (not group.identifiers, "identifiers", "at least one"),
        (group.score.curve < 2, "score.curve", "at least 2 lengths"),
        (any(seed < 0 for seed in group.seeds or ()), "seeds", "numbers from 0 up"),
        (group.score.runs < 1 or group.score.held_out < 1, "score", "runs >= 1 and held_out >= 1"),
        (group.score.horizon is not None and group.score.horizon <= 0, "score.horizon", "a positive number of s"),
        (group.time_limit is not None and group.time_limit <= 0, "time_limit", "a positive number of s"),
        (
            len({p.id.startswith(RECORDING) for p in group.plants} | {s.id == RECORDED for s in group.scenarios}) > 1,
            "scenarios",
            f"the scenario {RECORDED!r} for recordings, and for nothing else",
        ),
        (bool(axes_problem(group.axes)), "axes", axes_problem(group.axes)),
    ]
    for kind in ("plants", "scenarios", "identifiers"):
        for number, part in enumerate(getattr(group, kind)):
            try:
                if kind == "plants" and part.id.startswith(RECORDING):
                    registry.entry("recordings", part.id.removeprefix(RECORDING))
                elif kind == "scenarios" and part.id == RECORDED:
                    continue
                elif kind == "plants" and is_plant_file(part.id):
                    plant_fingerprint(part.id)
                else:
                    registry.entry(kind, part.id)
            except InputError as error:
                raise error.located(file=path, place=f"{place}.{kind}[{number}].id") from error
    for wrong, key, expected in problems:
        if wrong:
            raise InputError(
                f"{key} of a group",
                expected=expected,
                got="something else",
                remedy="correct the suite",
                file=path,
                place=f"{place}.{key}",
            )
