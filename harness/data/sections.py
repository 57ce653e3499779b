"""What may stand in a dataset.toml: one frozen record for each table, its keys explained."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

Gaps = Literal["refuse", "split"]
Column = str | int


class NominalParameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is known of a parameter of the nominal model.

    ``value`` alone is a known value (fixed). ``start`` is where the fit begins; ``minimum`` and ``maximum`` are bounds.
    """

    value: float | None = None
    """Known value, in the model's unit: it is not fitted."""
    start: float | None = None
    """Where the fit begins."""
    minimum: float | None = None
    """Lower bound of the fit."""
    maximum: float | None = None
    """Upper bound of the fit."""

    @property
    def fixed(self) -> bool:
        """True for a known value, which is not fitted."""
        return self.value is not None


class NominalSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The model that the user believes in: its name, options of its definition, what is known of its parameters.

    With ``analogy = true`` the model's equations are meant and the units are those of the data (an electrical circuit
    as a mass, spring and damper).
    """

    model: str
    """Built-in name, `FILE.fmu`, `FILE.urdf`, `FILE.xml` (MJCF) or `FILE.py:NAME` (Python and FMUs run only where the
    command line names them too, or after `--trust FILE`)."""
    analogy: bool = False
    """The equations are meant, not the units."""
    options: dict[str, Any] = {}
    """Options of the model's definition."""
    parameters: dict[str, NominalParameter | float] = {}
    """By name of the parameter: a number (known), or a table."""


class SignalSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One signal: which column it is, what it means to the model, its unit."""

    role: Literal["input", "output", "reference"]
    """Input, output, or reference (what came from outside a control loop)."""
    unit: str | None = None
    """Unit of the numbers in the column; by default what the title says. It overrides the title."""
    port: str | None = None
    """Name of the model's input or output; by default the name of the signal."""
    derivative: int = 0
    """How often the signal is the time derivative of its port: 1 for a rate, 2 for an acceleration."""
    column: Column | None = None
    """Title or number (from 0) of the column; by default the name of the signal."""
    scale: float = 1.0
    """Factor on the numbers of the column, before the unit."""
    offset: float = 0.0
    """Added after the factor, in the column's unit."""
    noise: float | None = None
    """Standard deviation of the sensor's noise where it is known, in the column's unit."""
    categories: int | None = None
    """Number of categories of a signal that counts 0, 1, 2, ..."""


class TimeSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The time column: its name and unit (by default what its title says, else s)."""

    column: Column = "time"
    """Title or number of the time column."""
    unit: str | None = None
    """Its unit; by default what the title says, else s."""


class BesideSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file that another logger wrote during the same run; its signals go by their titles as those of the run's file.

    Its clock began elsewhere: ``offset`` says by how much, or ``same`` names a quantity that both files hold, from
    which it is estimated. ``[resample]`` says on which grid the signals come together.
    """

    file: str
    """File of data, found as that of the run."""
    sheet: str | None = None
    """Sheet of an Excel workbook; by default the first."""
    time: Column | None = None
    """Title of its time column; by default the one that is called so."""
    offset: float | None = None
    """Seconds to be added to its stamps to have them on the clock of the run's file; 0 for a clock in common."""
    same: tuple[str, ...] = ()
    """Titles of one quantity, in the run's file and in this one: the offset is estimated from it, and printed."""


class RunSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One uninterrupted piece of a file, and what it is used for."""

    file: str
    """File of data, beside the description or below `$SYSID_HARNESS_DATA`."""
    sheet: str | None = None
    """Sheet of an Excel workbook; by default the first."""
    use: Literal["estimation", "validation", "test"] = "estimation"
    """What the run is for: models are fitted to estimation runs, chosen on validation runs, and judged on test runs."""
    label: str = ""
    """Name in reports."""
    rows: tuple[int, int] | None = None
    """First and last row (from 0, the last one left out) of the piece."""
    discard: int = 0
    """Rows left out at the start of the piece."""
    columns: dict[str, Column] = {}
    """Columns of this run that differ from those of the signals."""
    beside: tuple[BesideSection, ...] = ()
    """Files of other loggers that recorded the same run."""

    @property
    def files(self) -> tuple[str, ...]:
        """All its files."""
        return (self.file, *(one.file for one in self.beside))


class ResampleSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The declared remedy for time that is not uniform: the new sample time [s] and how to interpolate outputs.

    ``max_gap`` [s] is the longest hole that may be bridged; without it, five new sample times. Towards a lower rate
    ``antialias`` filters before, so that nothing folds back: see :mod:`harness.data.conditioning.decimation`.
    """

    sample_time: float | None = None
    """New sample time [s]; by default the median of the record's own."""
    method: Literal["linear", "cubic"] = "linear"
    """Interpolation between samples."""
    max_gap: float | None = None
    """Longest gap [s] that is bridged."""
    antialias: bool = True
    """Filter before the rate is lowered."""


class FilterSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A Butterworth filter on all inputs and outputs alike, which leaves a linear relation between them as it is.

    It runs forward in time from the steady state of the first sample (Ljung 1999, sec. 14.4). With ``low`` alone it
    passes what is above, with ``high`` alone what is below, with both the band between them.
    """

    low: float | None = None
    """Lower edge [Hz]."""
    high: float | None = None
    """Upper edge [Hz], below half the sampling frequency."""
    order: int = 4
    """Order of the filter; a band has twice as many poles."""


class SourceFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One file of a public recording with its SHA-256."""

    file: str
    """Name of the file."""
    sha256: str
    """Its SHA-256: another content is refused."""


class SourceSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where a public recording comes from."""

    citation: str
    """How the authors ask to be cited."""
    download: str
    """Where and how to get it."""
    licence: str
    """What may be done with it."""
    files: tuple[SourceFile, ...]
    """What must be there."""
    doi: str = ""
    """Its DOI."""
    package: str = ""
    """Python package that brings it (extra `download`)."""


class Description(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole of a dataset.toml.

    ``undriven`` names the inputs of the nominal model that nothing drove while the data were recorded: they count as 0
    (an FMU keeps their start values). An input that is neither recorded nor named there is refused. ``duplicates`` says
    which of several rows with one time stamp counts.
    """

    name: str
    """Name in reports."""
    signals: dict[str, SignalSection]
    """One table for each signal, by name."""
    runs: tuple[RunSection, ...]
    """The records."""
    nominal: NominalSection | None = None
    """The model that you believe in."""
    sample_time: float | None = None
    """Sample time [s]; by default that of the time column."""
    time: TimeSection | None = None
    """The time column."""
    intersample: Literal["zoh", "foh", "smooth"] | None = None
    """What the input does between samples: held (what is taken where nothing is declared), linear, or smooth."""
    gaps: Gaps = "refuse"
    """What happens to gaps in the time column: refused, or the run split there."""
    duplicates: Literal["refuse", "first", "last", "mean"] = "refuse"
    """Which of several rows with one time stamp counts."""
    resample: ResampleSection | None = None
    """A new time base."""
    detrend: Literal["none", "constant", "linear"] = "none"
    """What is taken from every input and output: nothing, its mean, or its straight line; for linear models only."""
    filter: FilterSection | None = None
    """A filter on every input and output; for linear models only."""
    undriven: tuple[str, ...] = ()
    """Inputs of the model that nothing drove."""
    feedthrough: bool = False
    """Outputs answer the input of the same sample (an accelerometer, a contact force)."""
    source: SourceSection | None = None
    """Where public data come from."""
    description: str = ""
    """A sentence about the data."""
