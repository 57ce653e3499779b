"""One row of a benchmark: what is stored of a cell, and how it travels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from harness.benchmark.parts import Cell, Task
from harness.errors import printable
from harness.jobs.stored import reading

STATUSES = ("ok", "unfit", "refused", "diverged", "timeout", "crashed", "terminated", "failed")
"""``ok``; data that cannot be learned from; parts that do not fit; and the ways in which a cell can break."""

LARGEST = 2**63 - 1  # Whole numbers that a column holds.


class Row(msgspec.Struct, kw_only=True, gc=False):
    """A cell and what came of it; None where a figure does not exist.

    ``equation_error`` and ``simulation_error`` are the root mean square over outputs and held-out records of the
    NRMSE (rms of the residual over the standard deviation of the output), so they carry no unit; the rms of each
    output in its own unit stands beside them. ``noise_floor`` is the same figure of the sensor noise in the held-out
    records: what the true plant from the true initial state would score, so no model can do better but by luck.
    ``least_equation_error`` and ``least_simulation_error``, where the plant is linear, are the least to be expected of
    an unbiased estimator that knows the order: process noise counts, and the Cramer-Rao bound of the parameters.
    ``log_score`` and ``coverage`` judge models that predict distributions, one step ahead, as means over outputs and
    held-out records: the log score [nats a sample] above that of the record's own normal distribution or frequencies,
    and the share of samples in the 90 % sets.
    ``log_regret`` is the regret in log loss [nats] of online identifiers that predict distributions, over the
    estimation records; ``average_log_regret`` the same for each sample. ``regret_law`` is how theory lets the regret
    grow (empty where no theorem says), ``regret_over_theory`` how fast it rises over what theory says, where theory has
    a factor.
    ``trace_t``, ``trace_measured`` and ``trace_residual`` (output by output) are what the overlay of a cell is drawn
    from: samples of its first held-out record, and measured minus simulated there.
    ``control_score`` is the cost of the regulator designed on a linear model over that of the best, on the true plant;
    ``predictive_cost`` that of predictive control on any model over that of the same on the true plant;
    ``control_status`` says how that went, or why there is none; ``control_regret`` counts samples of the optimal cost
    that were lost while learning to control; of ``model_order`` states so many are ``controllable``, ``observable``.
    ``axes`` and ``axis_values`` say where on the axes of its group a cell lies. ``memory_mib`` is the most that the
    worker process has had in memory so far.
    """

    job: str
    plant: str
    scenario: str
    identifier: str
    seed: int
    status: str = "ok"
    reason: str = ""
    axes: tuple[str, ...] = ()
    axis_values: tuple[float, ...] = ()
    noise_floor: float | None = None
    least_equation_error: float | None = None
    least_simulation_error: float | None = None
    equation_error: float | None = None
    simulation_error: float | None = None
    log_score: float | None = None
    coverage: float | None = None
    regret: float | None = None
    average_regret: float | None = None
    regret_exact: bool | None = None
    regret_over_theory: float | None = None
    regret_law: str = ""
    log_regret: float | None = None
    average_log_regret: float | None = None
    control_score: float | None = None
    control_status: str = ""
    control_regret: float | None = None
    predictive_cost: float | None = None
    model_order: int | None = None
    controllable: int | None = None
    observable: int | None = None
    stabilisable: bool | None = None
    detectable: bool | None = None
    outputs: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    equation_rms: tuple[float | None, ...] = ()
    simulation_rms: tuple[float | None, ...] = ()
    horizon: float | None = None
    burn_in: int | None = None
    initial_state: str = ""
    samples: int | None = None
    held_out_samples: int | None = None
    curve_steps: tuple[int, ...] = ()
    curve_regret: tuple[float, ...] = ()
    curve_theory: tuple[float | None, ...] = ()
    trace_t: tuple[float, ...] = ()
    trace_measured: tuple[tuple[float, ...], ...] = ()
    trace_residual: tuple[tuple[float | None, ...], ...] = ()
    data_seconds: float = 0.0
    fit_seconds: float = 0.0
    score_seconds: float = 0.0
    memory_mib: float | None = None


def blank(task: Task, cell: Cell, *, status: str = "ok", reason: str = "") -> Row:
    """Return the row of a cell of which nothing else is known."""
    at = {**task.plant.at, **task.scenario.at, **cell.identifier.at}
    return Row(
        axes=tuple(at),
        axis_values=tuple(at.values()),
        job=cell.job,
        plant=task.plant.name,
        scenario=task.scenario.name,
        identifier=cell.identifier.name,
        seed=task.seed,
        status=status,
        reason=one_line(reason),
    )


def one_line(text: object, limit: int = 400) -> str:
    """Return a reason as one line of bounded length.

    Examples
    --------
    >>> one_line("too   many    blanks ")
    'too many blanks'
    """
    line = printable(" ".join(str(text).split()))
    return line if len(line) <= limit else line[: limit - 3] + "..."


def encoded(row: Row) -> bytes:
    """Return a row as JSON, None in place of figures that are not finite."""
    return msgspec.json.encode(_finite(row))


def read_row(path: Path) -> Row:
    """Return the row of a shard.

    Raises InputError if the file is damaged.
    """
    with reading(path, "delete it and continue with --resume: that cell is done again"):
        return sound(msgspec.json.decode(path.read_bytes(), type=Row))


def sound(row: Row) -> Row:
    """Return a row whose parts fit together.

    Raises ValueError if they do not.
    """
    n = len(row.outputs)
    pairs = [("units", len(row.units), n), ("axis_values", len(row.axis_values), len(row.axes))]
    pairs += [("curve_regret", len(row.curve_regret), len(row.curve_steps))]
    pairs += [("curve_theory", len(row.curve_theory), len(row.curve_steps))] if row.curve_theory else []
    for name in ("equation_rms", "simulation_rms", "trace_measured", "trace_residual"):
        pairs += [(name, len(getattr(row, name)), n)] if getattr(row, name) else []
    for name in ("trace_measured", "trace_residual"):
        pairs += [(name, len(one), len(row.trace_t)) for one in getattr(row, name)]
    for name, found, wanted in pairs:
        if found != wanted:
            raise ValueError(f"{found} values in {name} where {wanted} belong")
    numbers = [getattr(row, name) for name in row.__struct_fields__] + list(row.curve_steps)
    if any(isinstance(value, int) and abs(value) > LARGEST for value in numbers):
        raise ValueError(f"a number above {LARGEST}")
    if row.status not in STATUSES:
        raise ValueError(f"a status {row.status[:40]!r}")
    return row


def _finite(row: Row) -> Row:
    """Return the row with None for figures that are not finite (JSON has no others)."""

    def clean(value: Any) -> Any:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        return tuple(clean(item) for item in value) if isinstance(value, tuple) else value

    return Row(**{name: clean(getattr(row, name)) for name in row.__struct_fields__})
