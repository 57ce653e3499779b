"""Signals: what a channel is, what a plant speaks, what was recorded.

Time is the first axis everywhere. ``y[k]`` is sampled at ``t[k]``; ``u[k]`` is held on ``[t[k], t[k+1])``, so the
first output that ``u[k]`` can change is ``y[k+1]`` (or ``y[k]`` itself where the plant declares feedthrough).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from harness.display import drawing, page, table
from harness.errors import InputError
from harness.plots import plot_record

FloatArray = npt.NDArray[np.float64]
Use = Literal["estimation", "validation", "test"]
Kind = Literal["real", "integer", "boolean", "category"]
_CATEGORY = re.compile(r"category 0\s?\.\.\s?(?P<last>\d{1,6})")


@dataclass(frozen=True)
class Channel:
    """One scalar signal.

    Parameters
    ----------
    name : str
        Unique within the inputs, outputs or states of a plant.
    unit : str
        SI unit as text (``"N m"``, ``"rad"``); ``"1"`` is dimensionless.
    minimum, maximum : float
        Declared range, in ``unit``. For ``kind="category"`` the values are ``0 .. maximum``.
    kind : {"real", "integer", "boolean", "category"}
        What the float64 values stand for.
    period : float, optional
        Period of an angle-like channel, in ``unit``: residuals wrap to ``[-period/2, period/2)``.

    Raises
    ------
    InputError
        If the name is empty, the range is empty, or the period is not positive.

    Examples
    --------
    >>> Channel("theta", "rad")
    Channel(name='theta', unit='rad', minimum=-inf, maximum=inf, kind='real', period=None)
    """

    name: str
    unit: str = "1"
    minimum: float = -np.inf
    maximum: float = np.inf
    kind: Kind = "real"
    period: float | None = None

    def __post_init__(self) -> None:
        if not self.name or not self.name.strip():
            raise InputError("a channel without a name", expected="a name", got=repr(self.name), remedy="name it")
        if not self.minimum <= self.maximum:
            raise InputError(
                f"empty range of channel {self.name!r}",
                expected="minimum <= maximum",
                got=f"[{self.minimum}, {self.maximum}]",
                remedy="swap or widen the limits",
            )
        if self.period is not None and not self.period > 0:
            raise InputError(
                f"period of channel {self.name!r}",
                expected="a positive number or None",
                got=repr(self.period),
                remedy="give the period in the channel's unit, e.g. 2*pi for an angle in rad",
            )
        if self.kind == "category" and not (self.minimum >= 0 and np.isfinite(self.maximum)):
            raise InputError(
                f"range of category channel {self.name!r}",
                expected="0 <= minimum <= maximum < inf",
                got=f"[{self.minimum}, {self.maximum}]",
                remedy="give maximum = number of categories - 1 and minimum = 0",
            )

    @property
    def categories(self) -> int:
        """Number of categories of a ``category`` channel."""
        if self.kind != "category":
            raise InputError(
                f"channel {self.name!r} has no categories",
                expected="kind 'category'",
                got=repr(self.kind),
                remedy="ask only a category channel",
            )
        return int(self.maximum) + 1

    def __str__(self) -> str:
        return f"{self.name} [{f'category 0..{self.categories - 1}' if self.kind == 'category' else self.unit}]"


def stated_categories(unit: str) -> int | None:
    """Return how many categories a text says that stands in the place of a unit; None for any other text.

    Numbers that are names have no unit: the title of their column says so, as ``str`` of a channel writes it.

    Examples
    --------
    >>> str(Channel("state", "1", 0, 10, kind="category"))
    'state [category 0..10]'
    >>> stated_categories("category 0..10"), stated_categories("N m")
    (11, None)
    """
    found = _CATEGORY.fullmatch(unit.strip())
    return None if found is None else int(found["last"]) + 1


SAY_CATEGORIES = (
    'say that the numbers are names: --unit NAME="category 0..N" for each signal, or categories = N + 1 in a '
    "dataset.toml (sysid new dataset drafts one)"
)
"""The remedy where a method needs categories and got amounts."""


class Ported:
    """What has inputs and outputs."""

    inputs: Any
    outputs: Any

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)


@dataclass(frozen=True)
class PlantSpec(Ported):
    """What a plant or a model speaks: its channels, its sample time, whether inputs feed through.

    Parameters
    ----------
    inputs, outputs : tuple of Channel
        In the order of the columns of ``u`` and ``y``.
    sample_time : float
        Seconds between samples.
    states : tuple of Channel
        Names of the true states where the plant can tell them; empty otherwise.
    feedthrough : bool
        True if ``y[k]`` depends on ``u[k]``.

    Raises
    ------
    InputError
        If two channels of a group share a name, there is no output, or the sample time is not positive.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"),), 0.01)
    >>> print(spec)
    u [N m] -> theta [rad] every 0.01 s
    """

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    sample_time: float
    states: tuple[Channel, ...] = ()
    feedthrough: bool = False

    def __post_init__(self) -> None:
        for group in ("inputs", "outputs", "states"):
            channels = tuple(getattr(self, group))
            object.__setattr__(self, group, channels)
            names = [channel.name for channel in channels]
            if len(set(names)) != len(names):
                raise InputError(
                    f"two {group} share a name", expected="unique names", got=", ".join(names), remedy="rename one"
                )
        if not self.outputs:
            raise InputError("no outputs", expected="at least one output", got="none", remedy="measure something")
        if not (np.isfinite(self.sample_time) and self.sample_time > 0):
            raise InputError(
                "sample time",
                expected="a positive number of seconds",
                got=repr(self.sample_time),
                remedy="give it in s",
            )

    def __str__(self) -> str:
        inputs = ", ".join(map(str, self.inputs)) or "no input"
        return f"{inputs} -> {', '.join(map(str, self.outputs))} every {self.sample_time:g} s"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One uninterrupted record.

    Parameters
    ----------
    t : array (N,)
        Sample instants [s], uniform: ``t[k] = t[0] + k * spec.sample_time``.
    u : array (N, nu)
        Inputs; ``u[k]`` is held on ``[t[k], t[k+1])``.
    y : array (N, ny)
        Measured outputs, sampled at ``t[k]``.
    spec : PlantSpec
        Names, units and sample time.
    x : array (N, nx), optional
        True states, for scoring only; never shown to an identifier (see :meth:`measured`).
    missing : array of bool (N, ny), optional
        Readings that are none (a spike, a held value): ``y`` then holds what its neighbours foretell, so that whatever
        does not ask can go on, and :attr:`readings` holds NaN.

    Raises
    ------
    InputError
        If a shape, the time axis or a value (NaN, infinite) does not fit.

    Notes
    -----
    The arrays are copied to read-only float64, so that nobody can change a record that others share.

    Examples
    --------
    >>> spec = PlantSpec((Channel("u", "N"),), (Channel("q", "m"),), 0.5)
    >>> print(Trajectory(np.arange(3) * 0.5, np.zeros((3, 1)), np.ones((3, 1)), spec))
    3 samples over 1 s: u [N] -> q [m] every 0.5 s
    """

    t: FloatArray
    u: FloatArray
    y: FloatArray
    spec: PlantSpec
    x: FloatArray | None = None
    missing: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        t = _frozen(self.t, "t", ("N",), (None,))
        n = t.shape[0]
        u = _frozen(self.u, "u", ("N", "nu"), (n, self.spec.nu))
        y = _frozen(self.y, "y", ("N", "ny"), (n, self.spec.ny))
        x = None if self.x is None else _frozen(self.x, "x", ("N", "nx"), (n, None))
        if n == 0:
            raise InputError("an empty record", expected="at least one sample", got="0", remedy="check the rows chosen")
        dt = self.spec.sample_time
        deviation = np.abs(t - (t[0] + np.arange(n) * dt))
        tolerance = 1e-6 * dt + 8 * np.finfo(float).eps * np.abs(t).max()
        if deviation.max() > tolerance:
            k = int(np.argmax(deviation > tolerance))
            raise InputError(
                "time is not uniform",
                expected=f"t[{k}] = {t[0] + k * dt:.9g} s (sample time {dt:g} s)",
                got=f"{t[k]:.9g} s",
                remedy="resample the record or split it at the gap",
                place=f"t[{k}]",
            )
        for name, value in (("t", t), ("u", u), ("y", y), ("x", x)):
            object.__setattr__(self, name, value)
        if self.missing is not None:
            marked = _frozen(self.missing, "missing", ("N", "ny"), (n, self.spec.ny)) != 0.0
            marked.flags.writeable = False
            object.__setattr__(self, "missing", marked if marked.any() else None)

    def __len__(self) -> int:
        return int(self.t.shape[0])

    def __str__(self) -> str:
        return f"{len(self)} samples over {self.duration:g} s: {self.spec}"

    def __repr__(self) -> str:
        return f"<Trajectory: {self}>"

    def _repr_html_(self) -> str:
        lines = [(channel, self.u[:, k]) for k, channel in enumerate(self.spec.inputs)]
        lines += [(channel, self.y[:, k]) for k, channel in enumerate(self.spec.outputs)]
        return page(str(self), *(drawing(values, str(channel)) for channel, values in lines))

    def plot(self, axes: Any = None) -> Any:
        """Draw inputs and outputs over time; returns the matplotlib figure (see :mod:`harness.plots`)."""
        inputs, outputs = self.spec.inputs, self.spec.outputs
        return plot_record(self.t, (self.u, [*map(str, inputs)]), (self.y, [*map(str, outputs)]), axes)

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float((len(self) - 1) * self.spec.sample_time)

    @cached_property
    def readings(self) -> FloatArray:
        """What was measured (N, ny): ``y``, NaN where it is missing."""
        if self.missing is None:
            return self.y
        found = np.where(self.missing, np.nan, self.y)
        found.flags.writeable = False
        return found

    def __getitem__(self, rows: slice) -> Trajectory:
        """Return the rows of a slice with step 1 as a trajectory of its own."""
        start, stop, step = rows.indices(len(self))
        if step != 1:
            raise InputError("slice of a trajectory", expected="step 1", got=str(step), remedy="resample explicitly")
        x = None if self.x is None else self.x[start:stop]
        missing = None if self.missing is None else self.missing[start:stop]
        return Trajectory(self.t[start:stop], self.u[start:stop], self.y[start:stop], self.spec, x, missing)

    def measured(self) -> Trajectory:
        """Return the record without the true states: what an identifier may see."""
        return self if self.x is None else replace(self, x=None)


@dataclass(frozen=True, eq=False)
class Run:
    """A trajectory and what it is used for.

    ``estimation`` runs fit parameters, ``validation`` runs choose between models, ``test`` runs never influence a
    choice.
    """

    trajectory: Trajectory
    use: Use = "estimation"
    label: str = ""


@dataclass(frozen=True)
class Oddity:
    """Something about a record that the plant did not do, or that limits what the record can tell.

    Attributes
    ----------
    kind : str
        One of those that :mod:`harness.data.oddities` lists.
    run : int
        Number of the run.
    channel : str
        Name of the input or output; empty where it is none of one channel.
    rows : tuple of int
        The odd rows of the run, as it was read.
    words : str
        What was found, for a person.
    fault : bool
        False for what is as it should be and worth knowing, such as the step of an encoder.
    used : bool
        True where fits were kept from it: the readings count as missing, or the row was corrected.
    """

    kind: str
    run: int
    channel: str
    rows: tuple[int, ...]
    words: str
    fault: bool = True
    used: bool = False


@dataclass(frozen=True, eq=False)
class Dataset:
    """Runs of one plant with their use.

    Parameters
    ----------
    name : str
        For titles and reports.
    runs : tuple of Run
        At least one; all with the same :class:`PlantSpec`. Nothing is ever differenced across two runs.
    intersample : {"zoh", "foh", "smooth"}
        How the input moves between samples.
    noise : dict
        Known standard deviation of the sensor of an output, by output name, in its SI unit.
    resolution : dict
        Step of the grid on which the readings of an output lay when they were recorded, by output name, in its SI unit;
        those that still lie on it tell it themselves (:func:`harness.resolution.resolution`).
    warnings : tuple of str
        What the reader noticed and the user should know.
    recorded : dict
        Unit in which a signal was recorded, by name, where it was another than that of its channel may be: in that unit
        errors are told.
    oddities : tuple of Oddity or None
        What is odd about the records; None where nobody has looked (:func:`harness.data.oddities.examined` does).

    Examples
    --------
    >>> spec = PlantSpec((), (Channel("q", "m"),), 1.0)
    >>> run = Trajectory(np.arange(4.0), np.zeros((4, 0)), np.zeros((4, 1)), spec)
    >>> data = Dataset("still", (Run(run), Run(run, "validation")))
    >>> len(data.estimation), len(data.validation), len(data.test)
    (1, 1, 0)
    """

    name: str
    runs: tuple[Run, ...]
    intersample: Literal["zoh", "foh", "smooth"] = "zoh"
    noise: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    resolution: dict[str, float] = field(default_factory=dict)
    oddities: tuple[Oddity, ...] | None = None
    recorded: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "runs", tuple(self.runs))
        if not self.runs:
            raise InputError("a data set without runs", expected="at least one run", got="none", remedy="add a run")
        spec = self.runs[0].trajectory.spec
        for number, run in enumerate(self.runs):
            if run.trajectory.spec != spec:
                raise InputError(
                    f"run {number} speaks another language than run 0",
                    expected=str(spec),
                    got=str(run.trajectory.spec),
                    remedy="put runs of different plants into different data sets",
                )

    @property
    def spec(self) -> PlantSpec:
        """The channels and sample time that all runs share."""
        return self.runs[0].trajectory.spec

    def using(self, use: Use) -> tuple[Trajectory, ...]:
        """Return the trajectories of one use, in order."""
        return tuple(run.trajectory for run in self.runs if run.use == use)

    @property
    def estimation(self) -> tuple[Trajectory, ...]:
        """The runs that fit parameters."""
        return self.using("estimation")

    @property
    def validation(self) -> tuple[Trajectory, ...]:
        """The runs that choose between models."""
        return self.using("validation")

    @property
    def test(self) -> tuple[Trajectory, ...]:
        """The runs that never influence a choice."""
        return self.using("test")

    def __iter__(self) -> Iterator[Run]:
        return iter(self.runs)

    def __str__(self) -> str:
        uses = [f"{len(self.using(use))} {use}" for use in ("estimation", "validation", "test") if self.using(use)]
        return f"{self.name}: {', '.join(uses)} runs, {self.spec}"

    def __repr__(self) -> str:
        return f"<Dataset {self}>"

    def _repr_html_(self) -> str:
        rows = [(k, r.use, r.label, len(r.trajectory), f"{r.trajectory.duration:g}") for k, r in enumerate(self.runs)]
        runs = table(["run", "use", "label", "samples", "seconds"], rows)
        notes = table(["what was noticed"], [[text] for text in self.warnings]) if self.warnings else ""
        return page(str(self), runs, notes)


def residual(outputs: Sequence[Channel], measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return measured minus predicted, wrapped on periodic channels.

    Parameters
    ----------
    outputs : sequence of Channel
        One for each column.
    measured, predicted : array (..., ny)
        In the units of the channels.

    Returns
    -------
    array (..., ny)
        On a channel with a period P the difference lies in ``[-P/2, P/2)``.

    Examples
    --------
    >>> angle = Channel("theta", "rad", period=2 * np.pi)
    >>> residual([angle], np.array([[3.1]]), np.array([[-3.1]])).round(4).tolist()
    [[-0.0832]]
    """
    difference: FloatArray = np.asarray(measured, dtype=float) - np.asarray(predicted, dtype=float)
    for column, channel in enumerate(outputs):
        if channel.period is not None:
            half = channel.period / 2
            difference[..., column] = (difference[..., column] + half) % channel.period - half
    return difference


def _frozen(values: npt.ArrayLike, name: str, axes: tuple[str, ...], shape: tuple[int | None, ...]) -> FloatArray:
    """Return a read-only float64 copy, refusing a wrong shape, complex numbers or a value that is not finite."""
    if np.iscomplexobj(values):
        raise InputError(
            f"numbers of {name}",
            expected="real numbers",
            got="complex ones, whose imaginary part would be lost",
            remedy="take the real part, or give real and imaginary part a channel each",
        )
    array = np.array(values, dtype=np.float64)
    wanted = tuple(axis if size is None else size for axis, size in zip(axes, shape, strict=True))
    fits = array.ndim == len(shape) and all(
        size is None or size == got for size, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise InputError(
            f"shape of {name}",
            expected=f"({', '.join(map(str, wanted))}{',' if len(wanted) == 1 else ''}) with axes ({', '.join(axes)})",
            got=str(array.shape),
            remedy="put time on the first axis and one channel in each column (reshape(-1, 1) for one channel)",
        )
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(
            f"value in {name}",
            expected="finite numbers",
            got=f"{array[where]} at {name}{list(where)}",
            remedy="cut or repair the record before it is used",
            place=f"{name}{list(where)}",
        )
    array.flags.writeable = False
    return array
