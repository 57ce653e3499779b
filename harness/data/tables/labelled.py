"""Readings that carry their names: ``u:1.2 y:3.4`` of a serial port, JSON lines, InfluxDB's line protocol, CAN logs."""

from __future__ import annotations

import csv
import functools
import io
import json
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from harness.data.tables.cells import is_number
from harness.data.tables.columns import MemoryTable
from harness.data.tables.keyed import Line
from harness.data.tables.stacked import MOST_ABOVE
from harness.data.tables.texts import text_of
from harness.data.times.stamps import is_time
from harness.errors import InputError

Named = list[tuple[str, str]]  # Names and values of one line.

Columns = dict[str, list[Any]]  # Values by title.

FEWEST = 3  # Lines of readings that make a table.
_WRITTEN = r"(?P<at>[\dT:., /-]*\d:\d\d:\d\d[\d.,]*Z?)"
_STAMPS = {
    re.compile(rf"(?:[EWIDV] \(|\[)?{_WRITTEN}[\])]?"): "time",
    re.compile(r"[EWIDV] \((?P<at>\d+)\)"): "time [ms]",  # Espressif, ESP-IDF, "Logging library": since the start
    re.compile(r"(?:\[[A-Z]+\] )?\[\s*(?P<at>\d+\.\d+)\]"): "time [s]",  # ROS 2 and the kernel of Linux
}
"""Stamps before readings, and the titles of their columns."""
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_BEHIND = re.compile(
    r"\s*(?P<sign>->|[:,;|-])?(?:\s+|(?<=>))"
    r"(?P<words>(?:(?![^\W\d][\w.\[\]/]*\s*[:=]\s*[+-]?[\d.])(?:[^\W\d][\w.]*|\[[^\]]*\]|<\w+>|\d+):?\s+(?:[-|]\s+)?)*)"
)
"""What a program says between a stamp and its readings: ``INFO controller:``."""
_NODE = re.compile(r"[^\W\d]\w*:\s+")
_SAID = re.compile(r"->|[:\[<]|^-\w")  # Signs of what a program says; a word alone may be a column.
_ITEM = re.compile(
    r"(?P<name>[^\W\d][\w.\[\]/²³°%-]*)\s*[:=]\s*"
    r'(?P<value>"[^"]*"|\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d[^\s,;|]*|[^\s,;|]+)'
    r"(?:[ ]?(?P<unit>(?:[^\W\d_]|[°%])[^\s,;|:=]*)(?=\s*(?:[,;|]|$)|\s+[^\W\d][^\s:=]*\s*[:=]))?[\s,;|]*"
)
_KEY, _TEXT = r"(?:\\.|[^\s,=\\])+", r'(?:"(?:\\.|[^"\\])*"|(?:\\.|[^\s,"\\])+)'
_INFLUX = re.compile(
    rf"(?P<series>{_KEY}(?:,{_KEY}={_TEXT})*) (?P<fields>{_KEY}={_TEXT}(?:,{_KEY}={_TEXT})*)(?: (?P<at>\d+))?"
)
_FIELD = re.compile(rf"({_KEY})=({_TEXT})")
_EPOCH_UNITS = {19: "ns", 16: "us", 13: "ms", 10: "s"}
"""Units of the time from 1970 by the number of its digits, until 2286."""
_SENTENCE = re.compile(r"\s*[$!](?P<words>[^*]+)\*(?P<sum>[0-9A-Fa-f]{2})\s*")
_VECTOR = re.compile(r"base\s+(?:hex|dec)\s+timestamps\s+(?P<kind>absolute|relative)", re.IGNORECASE)
_CANDUMP = re.compile(r"\s*\(\d+\.\d+\)\s+\w+\s+[\dA-F]+(?:##?[\dA-FR]*|\s+\[\d+\](?:\s+[\dA-F]{2})*)\s*.*")
"""A message as candump of Linux's can-utils writes it."""
_VARIABLE = re.compile(
    r"\s*(?P<at>\d+\.\d+)\s+(?:SV:(?:\s+\d+)+\s+)?(?P<name>[^\W\d][\w.]*|::\S+)\s*:?=\s*(?P<value>\S+)\s*"
)


def labelled(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    """Return the table that readings with names amount to, titles first, and what to say; None for any other lines.

    Raises InputError if the log is one of a bus whose messages hold signals only by a description of them, or a line
    among the others holds no readings.

    - ``lines`` sequence of (int, str)

    Examples
    --------
    >>> labelled([(1, "u:1.5 y:3"), (2, "u:1.6 y:4"), (3, "u:1.7 y:5")])[0]
    [(1, 'u,y'), (1, '1.5,3'), (2, '1.6,4'), (3, '1.7,5')]
    >>> labelled([(1, "m u=1,y=2i 1732874400000000000")] * 3)[0][:2]
    [(1, 'time [ns],u,y'), (1, '1732874400000000000,1,2')]
    >>> labelled([(1, "t,u"), (2, "0,1"), (3, "1,1")]) is None
    True
    """
    if (bus := next((found for _, line in lines[:5] if (found := _VECTOR.search(line))), None)) is not None:
        return _of_bus(lines, bus["kind"].lower())
    if lines and all(_CANDUMP.fullmatch(line) for _, line in lines[:FEWEST]):
        return _of_bus(lines, "absolute")
    if lines and all(_SENTENCE.fullmatch(line) for _, line in lines[: MOST_ABOVE + FEWEST]):
        return _of_sentences(lines)
    for read in (_of_json, _of_influx, _of_items):
        if len(lines) < FEWEST or not (last := _names_in(lines[-2][1], read)):
            continue  # settings above a table may read so, its rows do not
        above = [_names_in(line, read) & last for _, line in lines[: MOST_ABOVE + FEWEST]]
        first = next((row for row in range(len(above) - FEWEST + 1) if all(above[row : row + FEWEST])), None)
        if first is not None:
            return _table(lines[first:], read, lines[0][0] if first else None)
    return _of_stamped(lines)


def _led(line: str) -> tuple[Named, str, str]:
    """Return the stamp before the readings of a line, what a program says behind it, and the readings.

    Examples
    --------
    >>> _led("I (120) pid: u=1"), _led("[12.5] 3.5, 2"), _led("u:1")
    (([('time [ms]', '120')], 'pid: ', 'u=1'), ([('time [s]', '12.5')], '', '3.5, 2'), ([], '', 'u:1'))
    """
    line = _COLOUR.sub("", line).strip()
    stamps = ((found, title) for one, title in _STAMPS.items() if (found := one.match(line)) is not None)
    found, title = next(stamps, (None, ""))
    begin = 0 if found is None else found.end()
    behind = _BEHIND.match(line if begin else f" {line}", begin)
    if behind is None:
        return [], "", line
    at = [] if found is None else [(title, found["at"].strip(" ,"))]
    return at, (behind["sign"] or "") + behind["words"], line[behind.end() - (not begin) :]


def _of_stamped(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    """Return readings without names behind a stamp and an arrow or words as a table; None for other lines."""
    if len(lines) < FEWEST or not all(_led(line)[0] for _, line in lines[:FEWEST]):
        return None
    found = [(number, line, *_led(line)) for number, line in lines]
    rows = [
        (number, [at[0][1], *re.split(r"[,;\s]+", _NODE.sub("", rest, count=1).strip(" ,;"))])
        for number, line, at, said, rest in found
        if at and (_SAID.search(said) or _NODE.match(rest) or line.lstrip().startswith("["))
    ]
    rows = [(number, row) for number, row in rows if all(map(is_number, row[1:]))]
    if len(rows) < len(lines) - 1:
        return None
    head = [found[0][2][0][0], *(str(k + 1) for k in range(len(rows[0][1]) - 1))]
    return [(rows[0][0], _joined(head)), *((number, _joined(row)) for number, row in rows)], (
        "stamps before the readings, as a serial monitor writes them, are the time: the columns are called 1, 2, ..."
    )


def _names_in(line: str, read: Callable[[str], Named | None]) -> set[str]:
    """Return the names of the readings in a line."""
    return {name for name, _ in read(line) or ()}


def _table(lines: Sequence[Line], read: Callable[[str], Named | None], above: int | None) -> tuple[list[Line], str]:
    """Return the table of lines that are read so."""
    found: list[tuple[int, dict[str, str]]] = []
    for place, (number, line) in enumerate(lines):
        items = read(line)
        if place == len(lines) - 1 and (items is None or len(items) < len(found[-1][1])):
            break  # the last line is cut
        if items is None:
            raise InputError(
                "a line without readings among lines that name theirs",
                expected=f"such as {lines[0][1].strip()[:60]!r}",
                got=repr(line.strip()[:60]),
                remedy="remove it",
                place=f"line {number}",
            )
        found.append((number, dict(items)))
    rows = [items for _, items in found]
    if read is _of_influx and len(series := {row.pop("series") for row in rows}) == 1:
        rows = [{name.removeprefix(f"{min(series)}."): cell for name, cell in row.items()} for row in rows]
    titles = list(dict.fromkeys(name for row in rows for name in row))
    body = [_joined([row.get(title, "") for title in titles]) for row in rows]
    said = f"the readings carry their names: {', '.join(titles[:8])}{' ...' if len(titles) > 8 else ''} are columns"
    said += "" if above is None else f"; lines {above} to {lines[0][0] - 1} stand above them"
    return [
        (found[0][0], _joined(titles)),
        *((number, row) for (number, _), row in zip(found, body, strict=True)),
    ], said


def _joined(cells: Sequence[str]) -> str:
    """Return cells as a line, parted by commas."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()


def _of_items(line: str) -> Named | None:
    """Return the readings of ``u:1.2 y=3.4``, perhaps behind a stamp; None for any other line."""
    found, _, rest = _led(line)
    at = 0
    while at < len(rest):
        item = _ITEM.match(rest, at)
        if item is None:
            return None
        value = item["value"].strip('"')
        if item["unit"] and not is_number(value):
            return None
        found.append((item["name"], f"{value} {item['unit']}" if item["unit"] else value))
        at = item.end()
    names = [name for name, _ in found]
    readings = sum(is_number(value.split(" ")[0]) or is_time(value) for _, value in found)
    return found if readings and len(set(names)) == len(names) else None


def _of_json(line: str) -> Named | None:
    """Return the readings of an object of JSON in one line; None for any other line."""
    if not line.lstrip().startswith("{"):
        return None
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return list(_flat("", content)) or None


def _flat(prefix: str, content: Any) -> Named:
    """Return the plain values inside an object as texts, by their paths."""
    return [(name, _written(value)) for name, value in _leaves(prefix, content)]


def _written(value: Any) -> str:
    """Return a value of JSON as a cell."""
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _leaves(prefix: str, content: Any) -> list[tuple[str, Any]]:
    """Return the plain values inside an object, by their paths."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    if isinstance(content, dict | list):
        path = "{}.{}" if isinstance(content, dict) else "{}[{}]"
        return [
            pair for key, value in items for pair in _leaves(path.format(prefix, key) if prefix else str(key), value)
        ]
    return [(prefix, content)]


def _of_influx(line: str) -> Named | None:
    """Return the fields of a point of InfluxDB's line protocol, its series and its time; None for any other line.

    Reference: InfluxData, *Line protocol*: integers end in i, the time counts ns unless its writer says otherwise.
    """
    found = _INFLUX.fullmatch(line.strip())
    if found is None or len(found["at"] or "") not in _EPOCH_UNITS:
        return None  # "t=1 u=2,y=3" is no point of a series
    fields = _FIELD.findall(found["fields"])
    values = [(name, re.sub(r"(?<=\d)[iu]$", "", value)) for name, value in fields]
    if not any(is_number(value) for _, value in values):
        return None
    stamp = f"time [{_EPOCH_UNITS[len(found['at'])]}]", found["at"]
    series = re.sub(r"\\(.)", r"\1", found["series"])
    return [("series", series), stamp, *((f"{series}.{name}", value) for name, value in values)]


def _of_sentences(lines: Sequence[Line]) -> tuple[list[Line], str]:
    """Return the words of NMEA 0183's sentences (``$WORD,1.5,2*5A``) whose sums are right, and what to say."""
    kept, wrong = [], []
    for number, line in lines:
        found = _SENTENCE.fullmatch(line)
        said = -1 if found is None else int(found["sum"], 16)
        if found is not None and functools.reduce(operator.xor, found["words"].encode(), 0) == said:
            kept.append((number, found["words"]))
        else:
            wrong.append(number)
    text = "sentences of NMEA 0183: their words are columns"
    if wrong:
        text += f"; {len(wrong)} whose sums are wrong are left out (line {wrong[0]}{' ...' if len(wrong) > 1 else ''})"
    return kept or list(lines), text


def _of_bus(lines: Sequence[Line], kind: str) -> tuple[list[Line], str]:
    """Return the variables in a CAN log of Vector in text; its messages hold signals only by a DBC file.

    Raises InputError if there are none, or the stamps count from line to line.
    """
    found = [(number, one) for number, line in lines if (one := _VARIABLE.fullmatch(line)) and is_number(one["value"])]
    if not found or kind == "relative":
        raise InputError(
            "a log of a CAN bus",
            expected="signals: bytes of messages hold them only by a DBC file"
            if not found
            else "stamps from one origin",
            got=f"{len(lines)} lines of messages" if not found else "stamps from line to line",
            remedy="export the signals as CSV or MF4 from CANalyzer, CANoe or CANape, or by asammdf's bus logging with "
            "the DBC file",
        )
    titles = list(dict.fromkeys(one["name"] for _, one in found))
    rows = [
        (number, _joined([one["at"], *(one["value"] if one["name"] == title else "" for title in titles)]))
        for number, one in found
    ]
    head = _joined(["time [s]", *titles])
    return [(found[0][0], head), *rows], (
        f"variables of a CAN log: {', '.join(titles[:8])}; its messages hold signals only by a DBC file"
    )


def json_columns(content: Any) -> Columns | None:
    """Return the columns of the one table that JSON holds, by title; None where it holds none, or several.

    A table is an object of lists of one length, a list of objects (each a row), what pandas writes by default (an
    object of objects with the same keys), or its ``split``. It may stand in an object beside other things.

    Examples
    --------
    >>> json_columns({"run": 3, "log": [{"t": 0, "q": [1, 2]}, {"t": 1, "q": [3, 4]}]})
    {'t': [0, 1], 'q[0]': [1, 3], 'q[1]': [2, 4]}
    >>> json_columns({"t": [0, 1], "u": [2, 3]}), json_columns({"t": [0, 1], "u": [2]}), json_columns([1, 2])
    ({'t': [0, 1], 'u': [2, 3]}, None, None)
    >>> json_columns({"u": {"0": 2, "1": 3}, "y": {"0": 4, "1": 5}})
    {'u': [2, 3], 'y': [4, 5]}
    """
    if isinstance(content, list):
        rows = [dict(_leaves("", row)) for row in content if isinstance(row, dict)]
        titles = list(dict.fromkeys(name for row in rows for name in row))
        return {one: [row.get(one) for row in rows] for one in titles} if 1 < len(rows) == len(content) else None
    if not isinstance(content, dict):
        return None
    for read in (_split, _indexed, _side_by_side):
        if (found := read(content)) is not None:
            return found
    inside = [json_columns(one) for one in content.values() if isinstance(one, dict | list)]
    tables = [one for one in inside if one is not None]
    return tables[0] if len(tables) == 1 else None


def _split(content: dict[str, Any]) -> Columns | None:
    """Return the columns of titles beside rows, as pandas splits a table; None for anything else."""
    if not {"columns", "data"} <= set(content) <= {"columns", "data", "index"}:
        return None
    titles, body = content["columns"], content["data"]
    index = {"index": content["index"]} if content.get("index", []) != list(range(len(body))) else {}
    square = all(isinstance(row, list) and len(row) == len(titles) for row in body)
    return index | {title: [row[k] for row in body] for k, title in enumerate(titles)} if square else None


def _indexed(content: dict[str, Any]) -> Columns | None:
    """Return columns whose readings go by the keys of rows, the same in all; None for anything else."""
    columns = list(content.values())
    if len(columns) < 2 or not all(isinstance(column, dict) for column in columns):
        return None
    keys = list(columns[0])
    if len(keys) < 2 or any(list(column) != keys or _holds_more(column.values()) for column in columns):
        return None
    index: Columns = {"index": keys} if keys != [str(row) for row in range(len(keys))] else {}
    return index | {title: list(column.values()) for title, column in content.items()}


def _side_by_side(content: dict[str, Any]) -> Columns | None:
    """Return lists of plain values of one length; None where they are not, or there is one alone."""
    lists = {title: column for title, column in content.items() if isinstance(column, list)}
    if len(lists) < 2 or any(map(_holds_more, lists.values())):
        return None
    sizes = {len(column) for column in lists.values()}
    return lists if len(sizes) == 1 and sizes != {1} else None


def _holds_more(values: Iterable[Any]) -> bool:
    """Return True if a value is an object or a list."""
    return any(isinstance(value, dict | list) for value in values)


class JsonFile(MemoryTable):
    """A file of JSON that holds one table.

    Raises InputError if it holds none, or more than one.
    """

    def __init__(self, path: Path) -> None:
        try:
            content = json.loads(text_of(path, json=True)[0])
        except ValueError as error:
            raise InputError(
                "not a JSON file", expected="one object or list", got=str(error)[:120], remedy="check that it is whole"
            ) from error
        columns = json_columns(content)
        names = list(content) if isinstance(content, dict) else []
        if columns is None:
            raise InputError(
                "JSON that holds no table",
                expected='one table: {"time": [...], "u": [...]} or [{"time": 0, "u": 1}, ...]',
                got=f"an object with {', '.join(map(repr, list(content)[:6]))}"
                if isinstance(content, dict)
                else "a list",
                remedy="write it so, or as CSV; a model.json goes beside the data (--model, sysid compare)",
            )
        super().__init__(columns)
        if beside := [name for name in names if not isinstance(content[name], dict | list)]:
            self.notes.append(f"what stands beside the table is left aside: {', '.join(beside[:8])}")
