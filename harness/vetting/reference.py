"""Does a run agree with a reference? Tubes channel by channel, the first violation named with its time.

Files are those of fmi-cross-check (``X_ref.csv`` with ``X_in.csv`` and ``X_ref.opt`` beside it) and of csv-compare: a
first column of time, then a column for each variable, in the units of the FMU; or records of this project. Columns of
text are passed over.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import HarnessError, InputError, printable, refuse_unknown
from harness.options import as_options
from harness.parts.files import describe_fmu, make_plant
from harness.scoring.acceptance import Demand
from harness.signals import FloatArray
from harness.trust import names_fmu
from harness.vetting.tubes import EVERY, Tube, read_tubes, tube_of

DEFAULT = "0.2%"  # Width of a tube that nobody stated: what csv-compare takes.
OPTIONS = {"StartTime": "start", "StopTime": "stop", "StepSize": "step", "RelTol": "tolerance"}
"""Words of fmi-cross-check's ``_ref.opt``."""
BESIDE = ("truth:", "reference:")  # How columns of a record of this project begin that are no outputs.
STEPS = 500  # Samples of a run where neither reference nor options say a step.
INTEGERS = (
    "Integer",
    "Enumeration",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
)


@dataclass(frozen=True, eq=False)
class ComparedChannel:
    """One channel beside its reference.

    Attributes
    ----------
    name : str
    tube : Tube
    t, y : array (N,)
        The run, within the time of the reference.
    low, high : array (N,)
        The tube at these instants.
    reference : (array (M,), array (M,))
    first : int or None
        Row of the first violation.
    text : str
        What came.
    """

    name: str
    tube: Tube
    t: FloatArray
    y: FloatArray
    low: FloatArray
    high: FloatArray
    reference: tuple[FloatArray, FloatArray]
    first: int | None
    text: str

    @property
    def passed(self) -> bool:
        """True if the run stays inside, all through the reference."""
        return self.first is None


@dataclass(frozen=True, eq=False)
class Agreement:
    """A run beside a reference; ``lacking`` are channels of the reference that the run does not have, with why."""

    run: str
    reference: Path
    channels: tuple[ComparedChannel, ...]
    lacking: Mapping[str, str]
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """True if every channel stays in its tube."""
        return not self.lacking and all(channel.passed for channel in self.channels)

    @property
    def first(self) -> ComparedChannel | None:
        """The channel that leaves its tube first."""
        left = [channel for channel in self.channels if channel.first is not None]
        return min(left, key=lambda one: one.t[one.first or 0] if len(one.t) else -np.inf, default=None)

    def checks(self) -> list[Demand]:
        """Return a check for each channel, the one that fails first before the others."""
        found = [Demand(self.run, f"tube {one.name}", one.passed, one.text) for one in self.channels]
        found += [Demand(self.run, f"tube {name}", False, text) for name, text in self.lacking.items()]
        first = self.first
        return sorted(found, key=lambda one: first is None or one.name != f"tube {first.name}")

    def rows(self) -> list[dict[str, Any]]:
        """Return the channels for a table."""
        found = [
            {
                "channel": one.name,
                "passed": one.passed,
                "half width": f"{one.tube.absolute + one.tube.relative * float(np.ptp(one.reference[1])):.4g}",
                "in time [s]": f"{one.tube.time:g}",
                "largest miss": f"{_miss(one):.4g}",
                "said": one.text,
            }
            for one in self.channels
        ]
        empty = {"half width": "", "in time [s]": "", "largest miss": ""}
        return [*found, *({"channel": n, "passed": False, **empty, "said": text} for n, text in self.lacking.items())]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the signals, ready for JSON."""
        first = self.first
        return {
            "run": self.run,
            "reference": str(self.reference),
            "passed": self.passed,
            "first_violation": None
            if first is None or first.first is None or not len(first.t)
            else {"channel": first.name, "time": float(first.t[first.first])},
            "channels": self.rows(),
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        lines = [text for one in self.channels if not one.passed for text in [one.text]]
        lines += list(self.lacking.values())
        inside = sum(one.passed for one in self.channels)
        return "\n".join([*lines, f"{inside} of {len(self.channels) + len(self.lacking)} channels inside their tubes"])

    def plot(self) -> Any:
        """Draw every channel with its tube, and less the reference; what lies outside is red. Returns the figure."""
        from harness.plots import plain_texts, sheet

        shown = sorted(self.channels, key=lambda one: one.passed)[:MOST]
        count = max(len(shown), 1)
        figure = sheet(figsize=(9, 2.1 * count + 0.4), layout="constrained")
        for pair, one in zip(figure.subplots(count, 2, squeeze=False), shown, strict=False):
            middle = np.interp(one.t, *one.reference)
            out = ~((one.y >= one.low) & (one.y <= one.high))
            for axis, base in zip(pair, (np.zeros_like(one.t), middle), strict=True):
                axis.fill_between(one.t, one.low - base, one.high - base, color="#bbccee", linewidth=0, label="tube")
                axis.plot(one.t, middle - base, color="#888888", linewidth=0.8, label="reference")
                axis.plot(one.t, one.y - base, color="#4477aa", linewidth=0.9, label="run")
                axis.plot(one.t[out], (one.y - base)[out], ".", color="#cc3311", markersize=3)
                if one.first is not None and len(one.t):
                    axis.axvline(one.t[one.first], color="#cc3311", linewidth=0.7, linestyle="--", label="leaves it")
                axis.set_xlabel("time [s]")
            pair[0].set_ylabel(one.name)
            pair[1].set_ylabel("less the reference")
            pair[0].legend(loc="best", fontsize=7)
        return plain_texts(figure)

    def html(self) -> str:
        """Return a page by itself."""
        from harness.display import STYLE, page, table
        from harness.plots import inlined

        rows = [
            [("inside" if row["passed"] else "OUTSIDE"), *list(row.values())[:1], *list(row.values())[2:]]
            for row in self.rows()
        ]
        titles = ["", "channel", "half width", "in time [s]", "largest miss", "said"]
        body = page(
            f"{self.run} beside {self.reference.name}", table(titles, rows), inlined(self.plot(), "channels and tubes")
        )
        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(printable(self.run))}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>'
            f"<body>{body}</body></html>\n"
        )


MOST = 12  # Channels that are drawn, those that fail first.


def agreement(
    run: str | Path,
    reference: str | Path,
    *,
    tubes: Mapping[str, str] | None = None,
    inputs: str | Path | None = None,
    options: Mapping[str, Any] | None = None,
    start: float | None = None,
    stop: float | None = None,
    step: float | None = None,
    limit: float = 10.0,
) -> Agreement:
    """Compare a run with a reference.

    Parameters
    ----------
    run : path
        An FMU, which is run over the time of the reference; or a table of a run (CSV).
    reference : path
        A table; ``X_in.csv`` (inputs) and ``X_ref.opt`` beside ``X_ref.csv`` are read as fmi-cross-check means them.
    tubes : mapping, optional
        ``{"y": "0.01"}``; see :meth:`harness.vetting.tubes.Tube.read`. ``"*"`` is the tube of all channels that are not
        named, by default 0.2 % of the range.
    inputs : path, optional
        A table of inputs.
    options : mapping, optional
        Of the FMU's plant.
    start, stop, step : float, optional
        Of the run [s]; by default as ``X_ref.opt`` or the reference says.
    limit : float
        Longest time [s] for one call of the FMU.

    Raises
    ------
    InputError
        If a file cannot be read, or a tube names no channel of the reference.
    PlantError
        If the FMU breaks.
    """
    reference = Path(reference)
    told = read_tubes({EVERY: DEFAULT, **(tubes or {})})
    names, t, rows = _table(reference)
    measured = [k for k, name in enumerate(names) if not name.startswith(BESIDE)]
    names, rows = [names[k] for k in measured], rows[:, measured]
    refuse_unknown("tube", told, (EVERY, *names), file=reference)
    if names_fmu(run):
        window = _opt(reference) | {
            k: v for k, v in (("start", start), ("stop", stop), ("step", step)) if v is not None
        }
        beside = reference.with_name(reference.name.replace("_ref.csv", "_in.csv"))
        if inputs is None and beside != reference and beside.is_file():
            inputs = beside
        # inputs drive and are not compared
        driving = frozenset(row["name"] for row in describe_fmu(Path(run))["variables"] if row["causality"] == "input")
        own, times, values, lacking, notes = _simulated(
            Path(run), (names, t, rows), window, inputs, as_options(options), limit
        )
    else:
        if inputs is not None or options:
            raise InputError("inputs", expected="an FMU to run", got=str(run), remedy="leave them out")
        own, times, values = _table(Path(run))
        lacking, notes, driving = {}, [], frozenset()
    found = []
    for column, name in enumerate(names):
        tube = tube_of(told, name)
        assert tube is not None
        if name in lacking or name in driving:
            continue
        if name not in own:
            lacking[name] = f"{name}: the run has no such channel"
            continue
        found.append(_channel(name, tube, (t, rows[:, column]), times, values[:, own.index(name)]))
    return Agreement(Path(run).name, reference, tuple(found), lacking, tuple(notes))


def _miss(one: ComparedChannel) -> float:
    """Return by how much a channel leaves its tube at most; 0 inside, NaN where it is no number."""
    with np.errstate(invalid="ignore"):
        out = np.maximum(np.maximum(one.y - one.high, one.low - one.y), 0.0)
    return float(out.max(initial=0.0))


def _channel(
    name: str, tube: Tube, reference: tuple[FloatArray, FloatArray], t: FloatArray, y: FloatArray
) -> ComparedChannel:
    """Hold one channel against its reference."""
    begin, end = float(reference[0][0]), float(reference[0][-1])
    slack = 1e-9 * max(1.0, abs(end)) + tube.time
    keep = (t >= begin - 1e-9 * max(1.0, abs(begin))) & (t <= end + 1e-9 * max(1.0, abs(end)))
    t, y = t[keep], y[keep]
    low, high = tube.limits(*reference, t) if len(t) else (np.zeros(0), np.zeros(0))
    rounding = 1e-12 * max(1.0, float(np.abs(reference[1]).max(initial=0.0)))
    out = ~((y >= low - rounding) & (y <= high + rounding))  # what is no number is outside
    if out.any():
        row = int(np.argmax(out))
        text = f"{name} leaves its tube at t = {t[row]:g} s: {y[row]:g} is not within [{low[row]:g}, {high[row]:g}]"
        text += f" ({int(out.sum())} of {len(t)} samples outside)" if out.sum() > 1 else ""
        return ComparedChannel(name, tube, t, y, low, high, reference, row, text)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if not len(t) or t[0] > begin + slack + step or t[-1] < end - slack - step:
        span = f"{t[0]:g} to {t[-1]:g} s" if len(t) else "no instant"
        text = f"{name}: the run covers {span} of the reference's {begin:g} to {end:g} s"
        return ComparedChannel(name, tube, t, y, low, high, reference, max(len(t) - 1, 0), text)
    return ComparedChannel(name, tube, t, y, low, high, reference, None, f"inside at all {len(t)} samples")


def _table(path: Path) -> tuple[list[str], FloatArray, FloatArray]:
    """Return the names, the instants (N,) and the values (N, n) of a table whose first column is time."""
    if not path.is_file():
        raise InputError("no such table", expected="a CSV file", got="no file", remedy="check the path", file=path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            sample = file.read(4096)
            file.seek(0)
            lines = [
                line for line in csv.reader(file, delimiter=_delimiter(sample)) if any(cell.strip() for cell in line)
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("table", expected="CSV in UTF-8", got=str(error), remedy="convert it", file=path) from error
    if len(lines) < 3:
        raise InputError(
            "table",
            expected="a line of names and two of numbers",
            got=f"{len(lines)} lines",
            remedy="check it",
            file=path,
        )
    titles = [cell.strip() for cell in lines[0]]
    texts = [k for k, cell in enumerate(lines[1]) if k and _is_text(cell)]  # no tube holds them
    titles = [title for k, title in enumerate(titles) if k not in texts]
    try:
        rows = np.array(
            [[_cell(cell) for k, cell in enumerate(line) if k not in texts] for line in lines[1:]], dtype=float
        )
    except ValueError as error:
        raise InputError(
            "table",
            expected="as many numbers in every line as names",
            got=str(error)[:120],
            remedy="correct it",
            file=path,
        ) from error
    if rows.shape[1] != len(titles) or len(titles) < 2 or len(set(titles)) != len(titles):
        raise InputError(
            "table",
            expected="a column of time and others, each with a name of its own",
            got=f"{len(titles)} names over {rows.shape[1]} columns",
            remedy="correct the first line",
            file=path,
        )
    t = rows[:, 0]
    if not (np.isfinite(t).all() and (np.diff(t) >= 0).all()):
        raise InputError(
            "time", expected="a first column that does not fall", got=titles[0], remedy="sort it", file=path
        )
    return [_bare(title) for title in titles[1:]], t, rows[:, 1:]


def _delimiter(sample: str) -> str:
    """Return the sign that separates cells: the commonest of the three in the first line, outside of quotes."""
    line, quoted, counts = sample.partition("\n")[0], False, {",": 0, ";": 0, "\t": 0}
    for letter in line:
        quoted ^= letter == '"'
        if letter in counts and not quoted:
            counts[letter] += 1
    return max(counts, key=lambda sign: counts[sign])


def _cell(text: str) -> float:
    """Return a number; tools write truth values as words."""
    word = text.strip().lower()
    return {"true": 1.0, "false": 0.0, "": float("nan")}.get(word) if word in ("true", "false", "") else float(word)  # type: ignore[return-value]


def _is_text(cell: str) -> bool:
    """Return True for a cell that is no number."""
    try:
        _cell(cell)
    except ValueError:
        return True
    return False


def _bare(title: str) -> str:
    """Return a title without the unit in brackets behind it."""
    head, bracket, _ = title.rpartition(" [")
    return head if bracket and title.endswith("]") else title


def _opt(reference: Path) -> dict[str, float]:
    """Return what fmi-cross-check's option file beside a reference says."""
    path = reference.with_suffix(".opt")
    if not path.is_file():
        return {}
    found: dict[str, float] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        name, _, value = line.partition(",")
        if name.strip() in OPTIONS:
            try:
                found[OPTIONS[name.strip()]] = float(value)
            except ValueError:
                raise InputError(
                    name.strip(), expected="a number", got=repr(value), remedy="correct it", file=path
                ) from None
    return {name: value for name, value in found.items() if value > 0 or name == "start"}  # 0 means: not said


@dataclass(frozen=True)
class _Drive:
    """Inputs by name over their own time; ``between``: continuous ones move from row to row."""

    t: FloatArray
    values: Mapping[str, FloatArray]
    between: bool


def _drive(
    reference: tuple[Sequence[str], FloatArray, FloatArray], inputs: str | Path | None, rows: Mapping[str, Any]
) -> _Drive:
    """Return what drives an FMU: a table of inputs, else those that the reference holds from row to row."""
    names, t, values = reference if inputs is None else _table(Path(inputs))
    driven = dict(zip(names, values.T, strict=True))
    if inputs is None:
        return _Drive(t, {n: one for n, one in driven.items() if n in rows and rows[n]["causality"] == "input"}, False)
    unknown = [name for name in driven if name not in rows]
    if unknown:
        got = ", ".join(unknown[:5])
        raise InputError("inputs", expected="variables of the FMU", got=got, remedy="correct the names", file=inputs)
    return _Drive(t, driven, True)


def _step(window: Mapping[str, float], t: FloatArray, span: float, own: float | None, notes: list[str]) -> float:
    """Return the step [s] of a run: as asked, that of the reference where it has one, that of the FMU."""
    if "step" in window:
        return window["step"]
    steps = np.diff(t)[np.diff(t) > 0]
    regular = len(steps) and np.ptp(steps) < 1e-6 * steps.max()
    dt = float(np.median(steps)) if regular else float(own or span / STEPS)
    notes.append(f"run every {dt:g} s: nothing says a step (--step)")
    return dt


def _simulated(
    path: Path,
    reference: tuple[Sequence[str], FloatArray, FloatArray],
    window: Mapping[str, float],
    inputs: str | Path | None,
    options: dict[str, Any],
    limit: float,
) -> tuple[list[str], FloatArray, FloatArray, dict[str, str], list[str]]:
    """Run an FMU over the time of a reference; values are in its own units."""
    names, t, _ = reference
    content = describe_fmu(path)
    rows = {row["name"]: row for row in content["variables"]}
    notes: list[str] = []
    lacking = {name: f"{name}: the FMU has no such variable" for name in names if name not in rows}
    shown = [name for name in names if name in rows and rows[name]["causality"] != "input"]
    begin, end = window.get("start", float(t[0])), min(window.get("stop", float(t[-1])), float(t[-1]))
    dt = _step(window, t, end - begin, content["experiment"]["stepSize"], notes)
    drive = _drive(reference, inputs, rows)
    asked: dict[str, Any] = {"sample_time": dt, "start_time": begin, "outputs": shown, "timeout": limit}
    asked |= {"inputs": list(drive.values)} if drive.values else {}
    asked |= {"tolerance": window["tolerance"]} if "tolerance" in window else {}
    with make_plant(str(path), {**asked, **options}) as plant:
        at: FloatArray = begin + dt * np.arange(int(np.floor((end - begin) / dt + 1e-6)) + 1, dtype=np.float64)
        starts = np.asarray(getattr(plant, "input_starts", ()) or np.zeros(plant.spec.nu), dtype=float)
        u = np.tile(starts, (len(at), 1))
        for column, channel in enumerate(plant.spec.inputs):
            if channel.name in drive.values:
                row = rows[channel.name]
                u[:, column] = _held(drive, channel.name, at, dt, row) * (row["scale"] or 1.0) + (row["offset"] or 0.0)
        seen, ended = _stepped(plant, u)
    if ended:
        notes.append(f"the run ends at t = {at[len(seen) - 1]:g} s: {ended}")
    for column, name in enumerate(shown):
        seen[:, column] = (seen[:, column] - (rows[name]["offset"] or 0.0)) / (rows[name]["scale"] or 1.0)
    return shown, at[: len(seen)], seen, lacking, notes


def _held(drive: _Drive, name: str, at: FloatArray, dt: float, row: Mapping[str, Any]) -> FloatArray:
    """Return an input over each sample: a continuous one as it is half way, a discrete one as it was last."""
    values = drive.values[name]
    if drive.between and row["variability"] == "continuous" and row["type"] not in INTEGERS:
        return np.asarray(np.interp(at + 0.5 * dt, drive.t, values))
    place = np.clip(np.searchsorted(drive.t, at + 1e-9 * dt, "right") - 1, 0, len(values) - 1)
    return np.asarray(values[place])


def _stepped(plant: Any, u: FloatArray) -> tuple[FloatArray, str]:
    """Return the outputs as far as they come, and why they end."""
    first = plant.reset(rng=np.random.default_rng(0))
    rows = [np.asarray(first)]
    through = bool(plant.spec.feedthrough)
    try:
        if not through:
            return np.vstack([first, plant.rollout(u[:-1])]), ""
    except HarnessError:
        rows = [np.asarray(plant.reset(rng=np.random.default_rng(0)))]
    try:
        if through:
            rows[0] = np.asarray(plant.output(u[0]))
        for k in range(len(u) - 1):
            plant.step(u[k]) if through else rows.append(np.asarray(plant.step(u[k])))
            if through:
                rows.append(np.asarray(plant.output(u[k + 1])))
    except HarnessError as error:
        return np.array(rows), str(error)
    return np.array(rows), ""
