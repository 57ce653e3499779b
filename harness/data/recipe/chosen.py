"""Which columns of a bare table are meant, said by the caller: the options of the command line, and of Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict, get_args

from harness.data.recipe.ports import Ports
from harness.data.sections import Gaps, SignalSection
from harness.data.tables.headers import REFERENCE, seeming_unit
from harness.data.tables.table import Table
from harness.errors import InputError, did_you_mean, refuse_unknown
from harness.signals import Use
from harness.units import fits

TIME = "time"  # What names the clock among the columns and units.
NOTHING = "none"  # What ``--input`` says where nothing drives the outputs.


Found = dict[str | int, tuple[str, SignalSection]]
"""By title, or by number where two have one title, the name and the signal of a column."""


class ChosenSignals(TypedDict, total=False):
    """What a caller may say of the columns of a table that has no ``dataset.toml``."""

    input: str | Sequence[str] | None
    """Names of the inputs; an empty sequence, or ``"none"``, where nothing drives the outputs."""
    output: str | Sequence[str] | None  # Names of the outputs.
    column: Mapping[str, str | int] | None
    """Column by name of a signal, where it is called otherwise: ``{"theta": "Winkel", "time": "Zeit"}``; its number
    (from 0) where two have one title."""
    unit: Mapping[str, str] | None  # Unit by name of a signal, where its title states none: ``{"theta": "deg"}``.
    sample_time: float | None
    """Sample time [s] of a table without a time column, or whose clock is one of this rate with rough stamps."""
    gaps: Gaps | None  # ``"split"``: pieces between holes of a table are records of their own.
    sheet: str | None  # Sheet of an Excel workbook; by default the first, or the only one with rows of numbers.
    run: Any
    """Further records with the same columns: a file (or a table), ``(use, file)``, or a list of such; those without
    a use are for estimation."""


class Records(ChosenSignals, total=False):
    """What a caller may say of records beside the columns of their table."""

    validation: Any  # Validation data beside a bare file or table; without them the last third validates.
    undriven: Sequence[str]  # Inputs of the model that nothing drove (0 in all records); any other must be recorded.


class Noted(Records, total=False):
    """The same, of a call that tells what is odd about the records."""

    note: Callable[[str], None] | None  # Called with each oddity (:func:`harness.api.check_data`).


@dataclass(frozen=True)
class Chosen:
    """The columns that a caller chose."""

    # Names of signals; None where the caller did not say
    inputs: tuple[str, ...] | None = None
    outputs: tuple[str, ...] | None = None
    # By name of a signal (``time`` is the clock)
    columns: Mapping[str, str | int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sample_time: float | None = None  # [s]
    gaps: Gaps = "refuse"  # ``"split"`` or ``"refuse"``
    sheet: str | None = None  # Of workbooks
    runs: tuple[tuple[Use, Any], ...] = ()  # tuple of (use, file or table)
    whole: bool = False  # True where the table is one record, and no part of it validates

    @classmethod
    def of(cls, signals: ChosenSignals) -> Chosen:
        """Return the columns, units and uses that the caller's words choose.

        Raises InputError if a word is unknown, or the sample time is no positive number.

        Examples
        --------
        >>> chosen = Chosen.of({"input": "u [V]", "output": ["x", "y"], "run": [("test", "b.csv"), "c.csv"]})
        >>> chosen.inputs, chosen.outputs, chosen.runs
        (('u [V]',), ('x', 'y'), (('test', 'b.csv'), ('estimation', 'c.csv')))
        """
        unknown = [name for name in signals if name not in ChosenSignals.__annotations__]
        if unknown:
            raise InputError(
                "unknown argument",
                expected=f"one of {', '.join(ChosenSignals.__annotations__)}",
                got=", ".join(unknown),
                remedy="correct the name",
            )
        inputs, outputs = _names(signals.get("input")), _names(signals.get("output"))
        inputs = () if inputs == (NOTHING,) else inputs
        step = signals.get("sample_time")
        if step is not None and not (isinstance(step, float | int) and 0.0 < step < float("inf")):
            raise InputError(
                "sample time", expected="a number of seconds, more than 0", got=repr(step), remedy="correct it",
                place="--sample-time",
            )  # fmt: skip
        gaps = signals.get("gaps") or "refuse"
        refuse_unknown("gaps", gaps, get_args(Gaps), remedy="correct it", place="--gaps")
        given = signals.get("run")
        runs = [] if given is None else given if isinstance(given, list) else [given]
        return cls(
            inputs,
            outputs,
            _by_name("column", signals.get("column")),
            _by_name("unit", signals.get("unit")),
            step,
            gaps,
            signals.get("sheet"),
            tuple(_run(one) for one in runs),
        )

    @property
    def anything(self) -> bool:
        """True if the caller said something."""
        return self != Chosen()

    def by_signal(self, table: Table, ports: Ports | None) -> Chosen:
        """Return the same with every unit under the name of its signal, where the caller gave its column's own title.

        Raises InputError if a signal gets two units.
        """
        known = () if ports is None else (*ports.inputs, *ports.outputs)
        names = {TIME, *self.columns, *(channel.name for channel in known)}
        names |= {self._name(table, title) for title in (*(self.inputs or ()), *(self.outputs or ()))}
        titled = {title: name for name, title in self.columns.items() if isinstance(title, str)}
        if TIME not in self.columns and any(key not in names | set(titled) for key in self.units):
            clock = table.clock((*titled, *(self.inputs or ()), *(self.outputs or ())))
            titled |= {} if clock is None else dict.fromkeys((clock, table.split(clock)[0]), TIME)
        units: dict[str, str] = {}
        for key, unit in self.units.items():
            name = key if key in names else titled.get(key, key)
            if name in units:
                raise InputError(
                    f"two units of {name}", expected="one", got=f"{units[name]} and {unit}", remedy="leave out one",
                    place="--unit",
                )  # fmt: skip
            units[name] = unit
        return replace(
            self, units=units, columns={name: _numbered(one, table.titles) for name, one in self.columns.items()}
        )

    def sections(self, table: Table, ports: Ports | None) -> tuple[Found, list[str]]:
        """Return name and signal of each chosen column, by its title, and what there is to say.

        Raises InputError if inputs or outputs are not named, a name or a column is used twice, or a column is not
        there.

        - ``ports``: of a model, which give the signals their units; without, a column that states none holds plain
          numbers
        """
        if self.outputs is None or self.inputs is None:
            raise self._unnamed(table)
        wanted = [("input", self._name(table, title), title) for title in self.inputs]
        wanted += [("output", self._name(table, title), title) for title in self.outputs]
        names = [name for _, name, _ in wanted]
        _refuse_twice(names)
        known = {} if ports is None else {channel.name: channel.unit for channel in (*ports.inputs, *ports.outputs)}
        placed = self.placed(table, dict.fromkeys(names) | known)
        found: Found = {}
        plain = []
        for role, name, title in wanted:
            like = self.units.get(name) or known.get(name)
            column = self.columns.get(name, title)
            # what has no title is found by a selector, and one of two with one title by its number
            place = column if isinstance(column, int) else table.find(column, like) or column
            if place in found or placed.get(place, name) != name:
                raise _two_from_one(place, found[place][0] if place in found else placed[place], name)
            stated = self.units.get(name) or table.read(column, like)[1]
            if stated is None and known.get(name, "1") == "1":
                plain.append(name)  # nobody says otherwise, or the model's port is a plain number too
            unit = self.units.get(name, "1" if name in plain else None)
            found[place] = name, SignalSection(role=role, column=column, unit=unit)  # type: ignore[arg-type]
        for title in table.titles:
            if title.startswith(REFERENCE):
                found[title] = table.split(title)[0], SignalSection(role="reference")
        return found, self._said_of(plain)

    def _said_of(self, plain: Sequence[str]) -> list[str]:
        """Return what there is to say of signals of which nobody states a unit."""
        seeming = {name: unit for name in plain if (unit := seeming_unit(str(self.columns.get(name, name))))}
        seeming = {name: unit for name, unit in seeming.items() if not fits(unit, "1")}  # those are said where read
        notes = [] if not plain else [f"no unit is stated for {', '.join(plain)}: their numbers count as they are"]
        return notes + [
            f"{name} seems to say {unit}: --unit {name}={unit} if it does" for name, unit in seeming.items()
        ]

    def _name(self, table: Table, word: str) -> str:
        """Return the name of a signal that a caller calls by its name, or by its column's title with a unit."""
        title = None if word in self.columns else table.find(word)
        return table.split(word if title is None else title)[0]

    def placed(self, table: Table, units: Mapping[str, str | None]) -> dict[str | int, str]:
        """Return by title which signal the caller said that it holds, or ``time``.

        Raises InputError if a name is none of these, a column is not there, or holds two.

        - ``units``: unit (or None) by name of every signal that there can be
        """
        self._refuse_unknown((*units, TIME))
        found: dict[str | int, str] = {}
        for name, given in self.columns.items():
            title = given if isinstance(given, int) else table.find(given, self.units.get(name) or units.get(name))
            if title is None or isinstance(given, int):
                table.read(given)  # a selector, else refused
                title = given
            if title in found:
                raise _two_from_one(title, found[title], name)
            found[title] = name
        return found

    def _refuse_unknown(self, names: Sequence[str]) -> None:
        """Refuse a column or a unit of a signal that is none of these.

        Raises InputError if there is one.
        """
        for word, given in (("column", self.columns), ("unit", self.units)):
            for name in given:
                refuse_unknown(
                    f"{word} of an unknown signal",
                    name,
                    names,
                    remedy="correct the name, or choose it as an input or output",
                    place=f"--{word}",
                )

    def _unnamed(self, table: Table) -> InputError:
        """Return the refusal of a table whose columns are not chosen."""
        shown = ", ".join(map(repr, table.titles[:24])) + (" ..." if len(table.titles) > 24 else "")
        missing = [word for word, names in (("--input", self.inputs), ("--output", self.outputs)) if names is None]
        return InputError(
            "which columns are inputs and which are outputs",
            expected=f"{' and '.join(f'{word} NAME' for word in missing)}, or a model whose ports name the columns",
            got=f"columns {shown or '(none)'}",
            remedy="name them, give --model, or write a dataset.toml; --input none where nothing drives the outputs "
            "(identify and modes fit free motion)",
            file=table.path,
        )


def _refuse_twice(names: Sequence[str]) -> None:
    """Refuse names of signals that are chosen more than once."""
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(
            f"{twice[0]} is chosen twice",
            expected="each signal once, as an input or as an output",
            got=f"{names.count(twice[0])} times",
            remedy="leave out one",
            place="--input and --output",
        )


def _two_from_one(title: str | int, first: str, second: str) -> InputError:
    """Return the refusal of a column that is said to be two signals."""
    return InputError(
        "two signals from one column",
        expected="a column of its own for each signal",
        got=f"{first} and {second} from {title!r}",
        remedy="correct the column of one",
        place="--column",
    )


def _numbered(column: str | int, titles: Sequence[str]) -> str | int:
    """Return a column as it was chosen, or its number where no title is that number."""
    return int(column) if isinstance(column, str) and column.isdecimal() and column not in titles else column


def _names(given: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Return names as a tuple; None where nothing was said."""
    return None if given is None else (given,) if isinstance(given, str) else tuple(map(str, given))


def _by_name(word: str, given: Any) -> dict[str, Any]:
    """Return what was said of signals by their names."""
    if given is not None and not isinstance(given, Mapping):
        raise InputError(
            word, expected="a mapping from names of signals", got=repr(given), place=f"--{word}",
            remedy=f"say of which signal: {word}={{NAME: {given!r}}}",
        )  # fmt: skip
    return dict(given or {})


def _run(given: Any) -> tuple[Use, Any]:
    """Return use and file of a further record."""
    uses = get_args(Use)
    if isinstance(given, tuple) and len(given) == 2:
        use, data = given
        refuse_unknown("use of a record", use, uses, remedy="correct it", place="--run")
        return use, data
    for use in uses if isinstance(given, str) and not Path(given).exists() else ():
        if given.startswith(f"{use}="):
            return use, given.removeprefix(f"{use}=")
    word, equals, file = given.partition("=") if isinstance(given, str) else ("", "", "")
    if equals and not Path(given).exists() and Path(file).exists():
        raise InputError(
            "use of a record", expected=f"one of {', '.join(uses)}", got=repr(word), place="--run",
            remedy=did_you_mean(word, uses, "correct it"),
        )  # fmt: skip
    return "estimation", given
