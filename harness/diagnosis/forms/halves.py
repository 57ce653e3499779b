"""What repeats keeps its phase: each half of a validation record is judged with the phase that the other one tells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from harness.physics.compiled.kalman_pass import Filtered, Pass
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.maximum import Point
from harness.signals import FloatArray, Trajectory

Told = Sequence[tuple[FloatArray, FloatArray]]


def told_by_halves(
    records: Sequence[Trajectory],
    whole: Point,
    phases: Sequence[str],
    likelihood: Callable[[Trajectory], Likelihood],
    first_state: Callable[[Trajectory], FloatArray],
) -> list[tuple[FloatArray, FloatArray]]:
    """Return for every record the parameters with the phases that its first half tells, and its second.

    A phase that is fitted where it is judged would let any line of a spectrum pass for something periodic.

    - ``whole``: parameters, initial states and noise of the whole records
    - ``phases``: parameters that each half tells for itself
    - ``likelihood``: of half a record
    - ``first_state``: the initial state that half a record tells
    """
    told = []
    for record, x0 in zip(records, whole.x0, strict=True):
        sides: list[FloatArray] = []
        for half, start in ((record[: len(record) // 2], x0), (record[len(record) // 2 :], None)):
            part = likelihood(half)
            if start is None:
                start = first_state(half)
            free = [*phases, *part.start_names]
            sides.append(part.maximise(replace(whole, x0=[start]), free=free, most=25, exact=False).point.p)
        told.append((sides[0], sides[1]))
    return told


def judged_by_halves(
    paths: list[Filtered], passes: Pass, records: Sequence[Trajectory], point: Point, told: Told
) -> list[Filtered] | None:
    """Return passes over records with each half as the other tells its phases; None where one diverges.

    - ``paths``: of the whole records, changed in place
    - ``told`` sequence of (array, array): of :func:`told_by_halves`
    """
    for passed, record, x0, (first, second) in zip(paths, records, point.x0, told, strict=True):
        middle = len(record) // 2
        for p, judged in ((second, slice(None, middle)), (first, slice(middle, None))):
            other = passes(record, p, x0, point.noise)
            if other is None:
                return None
            passed.e[judged], passed.s[judged] = other.e[judged], other.s[judged]
    return paths
