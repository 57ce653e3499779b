"""Lines of other forms, written anew as a table: heads whose rows begin with a key, tables as pandas prints them.

Behind keys stand names, units and the sampling of all channels, each in a row of its own. Of a printed table each title
ends where the numbers below it end, and the index stands before them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from harness.data.tables.cells import EMPTY, is_number, is_unit_cell
from harness.data.tables.headers import split_header
from harness.data.tables.stacked import MOST_ABOVE
from harness.errors import InputError

Line = tuple[int, str]  # Number of a line in its file, and its text.
_FEWEST = 3  # Rows of a printed table.
_OUT = re.compile(r"\.{2,3}(?:\s+\.{3})*")  # The row that stands for those that pandas leaves out.
_SHAPE = re.compile(r"\[\d+ rows x \d+ columns\]")

NAMES = ("tracename", "path", "name", "symbolname", "channel name")
"""Keys of the row of names, in small letters, the fullest first where a head has several."""
UNITS = ("vunit", "unit", "units", "y_unit_label")
STEPS = {"hresolution": "hunit", "delta_x": "", "sampletime[ms]": ""}
"""Keys of the row of sample times, and that of their unit where it is no other."""
PAIRED_STEPS = {"sampletime[ms]": "ms", "interval": "s"}
"""The same where each channel has a key and a clock of its own, with the unit in which the clock then counts."""
STARTS = ("hoffset", "x0")
UNEVEN = 0.01  # Part of the stated step by which the first step of a clock may differ: else it counts something else.
_END = "***End_of_Header***"
MOST_CELLS = 48  # Of a row of eight channels.
BLOCK = 6  # Columns that a Tektronix gives a channel: two of settings, time and readings between two empty ones.
SETTINGS = 30  # Rows beside which a scope writes its settings.


def keyed(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    """Return the lines of a table under titles that its keyed head gives, and what to say; None for any other head.

    LabVIEW writes its settings above a table with titles, of which only the sampling counts; Yokogawa's recorders and
    ControlDesk leave the first cell of every row to the keys; TwinCAT's scope and National Instruments' loggers give
    each channel a key, and a clock.

    References: National Instruments, *Specification for the LabVIEW Measurement File (.lvm)*; Yokogawa, *DL850 ASCII
    file format*; Beckhoff, *TwinCAT Scope: export to CSV*.

    Examples
    --------
    >>> head = ["TraceName,u,y", "VUnit,V,mm", "HResolution,0.01,0.01", "HUnit,s,s"]
    >>> keyed(list(enumerate([*head, ",1,2", ",3,4", ",5,6"], start=1)))[0][:2]
    [(4, 'time [s],u [V],y [mm]'), (5, '0,1,2')]
    >>> keyed(list(enumerate(["t,u", "0,1", "1,2", "2,3"], start=1))) is None
    True
    """
    ends = [row for row, (_, line) in enumerate(lines[:MOST_ABOVE]) if line.startswith(_END)]
    if ends and len(lines) - ends[-1] > 2:
        return _of_labview(lines, ends[-1])
    begin = next((row for row in range(1, min(len(lines), MOST_ABOVE) - 2) if _is_row(lines[row][1])), 0)
    return _of_scope(lines) or (_of_keys(lines, begin) if begin else None)


def _of_scope(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    """Return the table below the head of a scope; None for any other."""
    head = [line for _, line in lines[:SETTINGS]]
    if (siglent := siglent_titles(head)) is not None:
        title, end = siglent
        said = f"lines {lines[0][0]} to {lines[end - 1][0]} are read as one header"
        return [(lines[end - 1][0], title), *lines[end:]], said
    if (scope := scope_of([[cell.strip() for cell in line.split(",")] for line in head])) is None:
        return None
    titles, above, cells_of, said = scope
    taken = ((number, [cell.strip() for cell in line.split(",")]) for number, line in lines[above:])
    return [(lines[0][0], ",".join(titles)), *((n, ",".join(cells_of(cells))) for n, cells in taken)], said


def _of_keys(lines: Sequence[Line], begin: int) -> tuple[list[Line], str] | None:
    """Return the table that begins at a line, below rows with keys; None where these do not name its columns."""
    sign = max(",;\t", key=lines[begin][1].count)
    head = [[cell.strip(' "') for cell in line.split(sign)] for _, line in lines[:begin]]
    by_key = {row[0].lower(): row for row in head if len(row) > 1 and row[0]}
    key = next((key for key in NAMES if key in by_key), None)
    if key is None or not {*UNITS, *STEPS} & set(by_key):
        return None
    paired = len(by_key[key]) > 3 and len(set(by_key[key][::2])) == 1
    if not paired and any(line[0] != sign for _, line in lines[begin:]):
        return None
    body = [(number, line.split(sign)[0 if paired else 1 :]) for number, line in lines[begin:]]
    titled = _titled(by_key, key, [row for _, row in body], paired=paired)
    if titled is None:
        return None
    titles, clock = titled
    if clock is not None:
        body = [(number, [f"{clock[0] + clock[1] * k:.12g}", *row]) for k, (number, row) in enumerate(body)]
    said = f"lines {lines[0][0]} to {lines[begin - 1][0]} hold names, units and sampling, and are read as one header"
    return [(lines[begin - 1][0], sign.join(titles)), *((number, sign.join(row)) for number, row in body)], said


def _titled(
    by_key: dict[str, list[str]], key: str, rows: Sequence[Sequence[str]], *, paired: bool
) -> tuple[list[str], tuple[float, float] | None] | None:
    """Return the titles of rows, and start and step of a clock that stands in the head alone; None if they do not fit.

    - ``by_key``: rows of the head
    - ``key``: of the row of names
    - ``rows``: cells below the head, without those of keys
    - ``paired``: True where each channel has a key and a clock of its own
    """
    width = len(rows[0])
    each = 2 if paired else 1
    names = by_key[key][1::each]
    if any(len(row) != width for row in rows) or width != len(names) * each:
        return None
    units = next((by_key[one][1::each] for one in UNITS if one in by_key), [])
    titles = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, [*units, *[""] * width], strict=False)]
    if paired:
        clock = next((f"time [{unit}]" for one, unit in PAIRED_STEPS.items() if _counts(by_key.get(one), rows)), "time")
        return [title for name in titles for title in (clock, name)], None
    if not names[0] and units:
        return [f"time [{units[0]}]", *titles[1:]], None
    step = _sampling(by_key)
    return None if step is None else ([f"time [{step[2]}]", *titles], step[:2])


def _counts(stated: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> bool:
    """Return True if the first column of rows goes on by the step that the head states for it."""
    if not stated or not is_number(stated[1]):
        return False
    step = float(stated[1])
    return abs(float(rows[1][0]) - float(rows[0][0]) - step) < UNEVEN * step


def _is_row(line: str) -> bool:
    """Return True for a row of readings: numbers, behind an empty cell perhaps."""
    cells = [cell.strip() for cell in line.split(max(",;\t", key=line.count))]
    return len(cells) > 1 and all(map(is_number, cells[1:])) and (not cells[0] or is_number(cells[0]))


def _sampling(by_key: dict[str, list[str]]) -> tuple[float, float, str] | None:
    """Return start, step and unit of the time that a head states once for all channels; None where it does not."""
    key = next((key for key in STEPS if key in by_key), None)
    steps = {cell for cell in by_key[key][1:] if cell} if key is not None else set()
    starts = {cell for one in STARTS for cell in by_key.get(one, [])[1:] if cell} or {"0"}
    if key is None or len(steps) != 1 or len(starts) != 1 or not all(map(is_number, steps | starts)):
        return None
    units = {cell for cell in by_key.get(STEPS[key], ["", "s"])[1:] if cell}
    return (float(min(starts)), float(min(steps)), min(units)) if len(units) == 1 else None


def _of_labview(lines: Sequence[Line], end: int) -> tuple[list[Line], str]:
    """Return the table below a head of LabVIEW, with its time where only the head gives it, and without comments."""
    sign = "\t" if "\t" in lines[end + 1][1] else ","
    head = [line.replace(",", ".").split(sign) if sign == "\t" else line.split(sign) for _, line in lines[:end]]
    by_key = {row[0].lower(): [cell.strip() for cell in row] for row in head}
    titles = [cell.strip() for cell in lines[end + 1][1].split(sign)]
    spoken = set(by_key.get("x_dimension", [])[1:]) - {""} == {"Time"}
    body = [(number, line.split(sign)) for number, line in lines[end + 2 :]]
    if titles[-1] == "Comment":
        titles = titles[:-1]
        body = [
            (number, row[: max(len(titles), 1)]) if len(row) > len(titles) else (number, row) for number, row in body
        ]
    said = f"lines {lines[0][0]} to {lines[end][0]} stand above the table: they are left aside"
    if by_key.get("x_columns", ["", ""])[1] == "No" and spoken and (step := _sampling(by_key)) is not None:
        empty = titles[0] == "X_Value"
        body = [
            (number, [f"{step[0] + step[1] * k:.12g}", *(row[1:] if empty and not row[0].strip() else row)])
            for k, (number, row) in enumerate(body)
        ]
        titles = ["time", *titles[1:]] if empty else ["time", *titles]
        said += f", but for its sampling: every {step[1]:g} s"
    titles = [f"{title} [s]" if spoken and title in ("X_Value", "time") else title for title in titles]
    titles = _with_labels(titles, [cell for cell in by_key.get("y_unit_label", [])[1:] if cell])
    return [(lines[end + 1][0], sign.join(titles)), *((number, sign.join(row)) for number, row in body)], said


def _with_labels(titles: Sequence[str], units: Sequence[str]) -> list[str]:
    """Return titles with the units that a head gives its signals, where it gives each of them one."""
    found = list(titles)
    signals = [place for place, title in enumerate(found) if title not in ("X_Value [s]", "X_Value", "time [s]")]
    for place, unit in zip(signals, units, strict=True) if len(units) == len(signals) else ():
        found[place] += f" [{unit}]" if is_unit_cell(unit) and split_header(found[place])[1] is None else ""
    return found


def siglent_titles(lines: Sequence[str]) -> tuple[str, int] | None:
    """Return the line of titles that the settings of a Siglent scope give, and how many lines stand for it.

    Channels and their units stand in rows of their own, above ``Second,Value,Value``.

    Examples
    --------
    >>> siglent_titles(["Record Length,Analog:9", "Vertical Units,CH1:V,CH2:A", "Source,CH1,CH2", "Second,Value,Value"])
    ('time [s],CH1 [V],CH2 [A]', 4)
    """
    rows = {line.split(",")[0]: [cell.strip() for cell in line.split(",")[1:]] for line in lines}
    end = next((row for row, line in enumerate(lines, start=1) if line.startswith("Second,")), None)
    if end is None or not lines[0].startswith("Record Length,") or "Source" not in rows:
        return None
    units = dict(cell.partition(":")[::2] for cell in rows.get("Vertical Units", []))
    names = [f"{name} [{units[name]}]" if units.get(name) else name for name in rows["Source"] if name]
    return ",".join(("time [s]", *names)), end


Cells = Callable[[list[str]], list[str]]
Scope = tuple[list[str], int, Cells, str]  # Titles, the rows above, what takes the cells of a row, and what to say.


def scope_of(rows: Sequence[Sequence[str]]) -> Scope | None:
    """Return what a scope's waveform holds; None for other tables.

    Raises InputError if other columns stand beside those of a Tektronix.

    Examples
    --------
    >>> rows = [["X", "CH1", "Start", "Increment"], ["Sequence", "Volt", "-0.5", "0.01"], ["0", "1.5", ""]]
    >>> titles, above, cells_of, _ = scope_of(rows)
    >>> titles, above, cells_of(["3", "1.25", ""])
    (['time [s]', 'CH1 [Volt]'], 2, ['-0.47', '1.25'])
    """
    names, units = ([cell for cell in row if cell] for row in rows[:2]) if len(rows) > 1 else ([], [])
    first = names[:1] + units[:1]
    if first == ["X", "Sequence"]:
        return _rigol(names, units)
    return _tektronix(rows) if first == ["Record Length", "Sample Interval"] else None


def _rigol(names: Sequence[str], units: Sequence[str]) -> Scope | None:
    """Return a table in which samples are counted; start and increment of the time stand once, behind the titles."""
    if names[-2:] != ["Start", "Increment"] or len(names) != len(units) or not all(map(is_number, units[-2:])):
        return None
    start, step = map(float, units[-2:])
    titles = [f"{name} [{unit}]" for name, unit in zip(names[1:-2], units[1:-2], strict=True)]

    def counted(cells: list[str]) -> list[str]:
        time = f"{start + step * float(cells[0]):.12g}" if is_number(cells[0]) else cells[0]
        return [time, *cells[1 : len(titles) + 1]]

    return ["time [s]", *titles], 2, counted, f"time: sample 0 at {start:g} s, every {step:g} s, as line 2 says"


def _tektronix(rows: Sequence[Sequence[str]]) -> Scope | None:
    """Return a table with settings beside the first rows, in its first three columns; so for each channel in turn."""
    each = {k: {row[k]: row[k + 1] for row in rows if len(row) > k + 4 and row[k]} for k in range(0, MOST_CELLS, BLOCK)}
    each = {k: settings for k, settings in each.items() if settings.get("Horizontal Units") == "s"}
    if 0 not in each:
        return None
    known = {k + place for k in each for place in range(BLOCK - 1)}
    if further := next((cell for row in rows for k, cell in enumerate(row) if cell.strip() and k not in known), ""):
        raise InputError(
            "columns beside the channels of the scope",
            expected="five columns for each, as a Tektronix writes them: settings, time and readings",
            got=repr(further),
            remedy="give each channel a file of its own",
            place="line 1",
        )
    titles = [
        title
        for settings in each.values()
        for title in ("time [s]", f"{settings.get('Source', 'y')} [{settings.get('Vertical Units', '1')}]")
    ]

    def read(cells: list[str]) -> list[str]:
        return [cell for k in each for cell in cells[k + 3 : k + 5]]

    return titles, 0, read, "the settings of the scope beside the first rows are left aside"


def printed(lines: Sequence[Line]) -> tuple[list[Line], str] | None:
    r"""Return the table that pandas prints, with tabs between its cells, and what to say; None for any other lines.

    Titles may hold blanks, so that only the places of their ends tell them apart. An index without a name that counts
    the rows is left out.

    Raises InputError if rows are left out, as in what ``print`` shows of a long table.

    Examples
    --------
    >>> rows = ["   time  motor torque", "0  0.00         1.500", "1  0.01        -0.500", "2  0.02         0.250"]
    >>> printed(list(enumerate(rows, start=1)))[0][:2]
    [(1, 'time\tmotor torque'), (2, '0.00\t1.500')]
    """
    if len(lines) <= _FEWEST or not (head := lines[0][1].rstrip()).startswith(" ") or "\t" in head:
        return None
    named = lines[1][1].strip() if not any(map(is_number, lines[1][1].split())) else ""
    rows = [(number, line.rstrip()) for number, line in lines[2 if named else 1 :]]
    if _SHAPE.fullmatch(rows[-1][1]):
        rows.pop()
    kept = [(number, row) for number, row in rows if not _OUT.fullmatch(row)]
    found = _aligned(head, [row for _, row in kept])
    if found is None:
        return None
    titles, index, cells = found
    if len(kept) < len(rows):
        place = next(f"line {number}" for number, row in rows if _OUT.fullmatch(row))
        raise InputError(
            "a printed table without all its rows",
            expected="every row",
            got=f"'...' in {place}",
            remedy='write the frame by df.to_csv("log.csv"), or print df.to_string()',
            place=place,
        )
    if any(index) and (named or index != [str(k) for k in range(len(index))]):
        titles, cells = [named, *titles], [[first, *row] for first, row in zip(index, cells, strict=True)]
    body = [(number, "\t".join(row)) for (number, _), row in zip(kept, cells, strict=True)]
    return [(lines[0][0], "\t".join(titles)), *body], "each title is that of the numbers which end where it does"


def _aligned(head: str, rows: Sequence[str]) -> tuple[list[str], list[str], list[list[str]]] | None:
    """Return titles, the index of every row (empty for none) and cells, where columns end together; None elsewhere."""
    if len(rows) < _FEWEST or any(len(row) != len(head) for row in rows):
        return None
    ends = sorted(set.intersection(*({one.end() for one in re.finditer(r"\S+", row)} for row in rows)))
    titles = _between(head, ends)
    first = next((k for k, title in enumerate(titles) if title), len(titles))  # before it ends the index
    titles, ends = titles[first:], ends[first:]
    if not titles or not all(titles):
        return None
    index, cells = [], []
    for row in rows:
        leading, *others = _between(row, ends)
        *own, cell = leading.split() or [""]
        index.append(" ".join(own))
        cells.append([cell, *others])
    right = all(is_number(row[0]) or row[0].lower() in EMPTY for row in cells) and any(index) == all(index)
    return (titles, index, cells) if right else None


def _between(line: str, ends: Sequence[int]) -> list[str]:
    """Return what stands in a line between these places."""
    return [line[begin:end].strip() for begin, end in zip([0, *ends], ends, strict=False)]
