"""Records refused by identifiers that learn what the inputs do: those that a law or a dependence determines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.algebra import divisor, unit_columns
from harness.errors import FitError
from harness.judgement.feedback import FORETOLD, SHORT, THIN, first_rows
from harness.judgement.law import dependence_text, law_of
from harness.signals import Trajectory

# What looks like a controller too: an output that holds the input itself.
_ANSWERS = "; if there is none, and an output answers within the sample, declare feedthrough = true"
# Inputs move nearly together if the others leave so little of one; its coefficient is chance if its standard deviation
# is half of what all inputs do, so that the interval holds nothing and twice as much.
_NEARLY, _CHANCE = 0.1, 0.5
# Samples for each that an input is said to follow from: below, anything follows.
_ROWS = 3


def refuse_law(records: Sequence[Trajectory], what: str, least_excitation: float = 2.0) -> None:
    """Raise if an input never moves, or is nothing but the answer of a controller to the measured outputs.

    For identifiers that learn what the inputs do. A model of known structure, whose parameters a motion under feedback
    can tell, need not ask.

    Parameters
    ----------
    records : sequence of Trajectory
    what : str
        Name of the identifier, for messages.
    least_excitation : float
        0 asks nothing.

    Raises
    ------
    FitError
        If an input is constant, :func:`law_of` finds a law, or inputs move together and the noise hides what each does.
    """
    if least_excitation <= 0:
        return
    _refuse_still(records, what)
    _refuse_together(records, what)
    if (law := law_of(records)) is None:
        if (law := law_of(records, held=True)) is not None:
            raise FitError(
                f"{what}: the data do not determine the model",
                expected="outputs that respond to an input from the next sample on",
                got=f"{law.text} up to {law.departure:.1e} of full size, though that input is held and jumps",
                remedy="declare feedthrough = true, or remove what the input adds to the readings (crosstalk)",
            )
        return
    raise FitError(
        f"{what}: the data do not determine the model",
        expected="inputs that something beside the controller moves",
        got=f"{law.text} up to {law.departure:.1e} of full size, which noise of the sensors explains",
        remedy="add an excitation to what the controller commands" + ("" if records[0].spec.feedthrough else _ANSWERS),
    )


def refuse_undetermined(records: Sequence[Trajectory], what: str, least_excitation: float = 2.0) -> None:
    """Raise if inputs move together, or by a law alone: for identifiers with no decision on rank of their own.

    Parameters
    ----------
    records, what, least_excitation
        As of :func:`refuse_law`.

    Raises
    ------
    FitError
        If the inputs depend on one another but for a constant, or :func:`law_of` finds a law.
    """
    spec = records[0].spec
    if least_excitation > 0 and spec.nu > 1:
        u = np.concatenate([record.u for record in records])
        size = divisor(u.std(axis=0))
        _, values, right = np.linalg.svd((u - u.mean(axis=0)) / size, full_matrices=False)
        if values[-1] <= THIN * values[0]:
            law = dependence_text(right[-1] / size, size, [channel.name for channel in spec.inputs])
            raise FitError(
                f"{what}: the data do not determine the model",
                expected="inputs that do not move together",
                got=f"{law} up to a constant",
                remedy="excite every input by itself, or leave one out",
            )
        _refuse_late(first_rows(records), what)
    refuse_law(records, what, least_excitation)


def _refuse_still(records: Sequence[Trajectory], what: str) -> None:
    """Raise if an input is the same in all samples of all records."""
    names = [
        channel.name
        for column, channel in enumerate(records[0].spec.inputs)
        if all((record.u[:, column] == records[0].u[:1, column]).all() for record in records)
    ]
    if names:
        raise FitError(
            f"{what}: the data do not determine the model",
            expected="inputs that move",
            got=f"constant {', '.join(names)}: the records do not show what a constant input does",
            remedy="excite every input, or leave it out",
        )


def _refuse_late(records: Sequence[Trajectory], what: str) -> None:
    """Raise if an input follows, to rounding, from a few samples of the others: a copy that is late, or filtered."""
    spec, u = records[0].spec, [record.u for record in records if len(record) > 2 * SHORT]
    if sum(len(one) - 2 * SHORT for one in u) <= _ROWS * (1 + (2 * SHORT + 1) * (spec.nu - 1)):
        return
    now = np.concatenate([one[SHORT:-SHORT] for one in u])
    near = [np.concatenate([one[j : len(one) - 2 * SHORT + j] for one in u]) for j in range(2 * SHORT + 1)]
    for column in range(spec.nu):
        others = np.hstack([np.ones((len(now), 1)), *(np.delete(one, column, axis=1) for one in near)])
        known, wanted = unit_columns(others), now[:, column]
        left = wanted - known @ np.linalg.lstsq(known, wanted, rcond=THIN)[0]
        if 0.0 < wanted.std() and left.std() <= FORETOLD * wanted.std():
            names = ", ".join(channel.name for i, channel in enumerate(spec.inputs) if i != column)
            raise FitError(
                f"{what}: the data do not determine the model",
                expected="inputs that move apart",
                got=f"{spec.inputs[column].name} follows from samples of {names}, {SHORT} before to {SHORT} after",
                remedy="excite every input by itself, or leave one out",
            )


def _refuse_together(records: Sequence[Trajectory], what: str) -> None:
    """Raise if inputs move so nearly together that, at the noise there is, what each does by itself is not known.

    The standard deviation of an input's coefficient, times the input's size, is ``s / sqrt(N (1 - R^2))`` with s the
    noise and R^2 the share of the input that the others explain (Belsley, Kuh & Welsch 1980, *Regression Diagnostics*,
    sec. 3.2). Where that is half of what all inputs do and R^2 is what makes it so, the coefficient is chance.
    """
    spec = records[0].spec
    if spec.nu < 2 or any(channel.kind == "category" for channel in (*spec.inputs, *spec.outputs)):
        return
    some = [record for record in first_rows(records) if len(record) > SHORT]
    rows = sum(len(record) - SHORT for record in some)
    if rows <= 2 * (SHORT * spec.ny + spec.nu + 1):
        return
    u = np.concatenate([record.u[SHORT - 1 : -1] for record in some])
    seen = np.concatenate(
        [np.hstack([record.y[SHORT - j : len(record) - j] for j in range(1, SHORT + 1)]) for record in some]
    )
    target = np.concatenate([record.y[SHORT:] for record in some])
    u, seen, target = (part - part.mean(axis=0) for part in (u, seen, target))
    known = unit_columns(np.hstack([seen, u]))
    theta = np.linalg.lstsq(known, target, rcond=THIN)[0]
    noise = (target - known @ theta).std(axis=0)
    effect = (known[:, -spec.nu :] @ theta[-spec.nu :]).std(axis=0)
    size = np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
    for column in range(spec.nu):
        others = np.delete(u, column, axis=1) / np.delete(size, column)
        gains = np.linalg.lstsq(others, u[:, column] / size[column], rcond=THIN)[0]
        left = float(np.std(u[:, column] / size[column] - others @ gains))
        if not 0.0 < left < _NEARLY or np.any(noise / (np.sqrt(rows) * left) < _CHANCE * effect):
            continue
        direction = np.insert(-gains, column, 1.0) / size
        law = dependence_text(direction, size, [channel.name for channel in spec.inputs])
        raise FitError(
            f"{what}: the data do not determine the model",
            expected="inputs that move apart by more than noise hides",
            got=f"{law} up to {left:.1e} of full size: what each does by itself is chance",
            remedy="excite every input by itself, or leave one out",
        )
