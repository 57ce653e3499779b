"""Inputs that the equations of motion contradict: written a row late, or with rows that the plant did not feel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from harness.data.oddities import ODD, examined
from harness.data.oddities.dropouts import without
from harness.diagnosis.policy import DATA_POLICY
from harness.errors import HarnessError
from harness.judgement import law_of, taken_up_at_once
from harness.physics.compiled.simulator import Intersample
from harness.physics.compiled.system import System
from harness.physics.fitting.likelihood import Likelihood
from harness.physics.fitting.likelihood_fit import fit_likelihood
from harness.physics.fitting.maximum import LikelihoodFit
from harness.signals import Dataset, FloatArray, Oddity, Run, Trajectory
from harness.units import quotient

CROSSTALK = "crosstalk"
FOUND = ("shift", "between", CROSSTALK)
"""Kinds of oddity that the equations of motion find, or say more of."""
_SAMPLES = 2000
"""Rows of a record that are asked; more would tell no other thing."""
_STEPS = 12
"""Iterations of a fit that begins at the maximum for a slightly different input."""
_CANNOT = (HarnessError, ArithmeticError, np.linalg.LinAlgError)
"""What a model raises that cannot be fitted to a record."""


def inputs_checked(system: System, dataset: Dataset) -> Dataset:
    """Return a data set whose inputs are read as the equations of motion ask, with what was found.

    The nominal model is fitted by maximum likelihood, with forces that nobody measured, to a record as it is and with
    its input read earlier and later. Nothing mechanical lets a plant answer before it is asked: if the record is far
    likelier with the input read exactly one row (two rows) earlier than as it is, half a row earlier, and half a row
    earlier still, it was written so late. If half a row earlier is far likelier than both whole ones, an input that
    passes for held moves between its readings, and a line from one to the next is read. Where the input follows from
    the outputs by a law, that may be a controller, which answers in time, or the plant itself, of which an input that
    was written late is told by an output that answers at once: it is late where the equations, read so, keep their
    declared values within ``DATA_POLICY.own_values``. An input that acts a row later may be a dead time, and is only
    said. A reading that takes up a share of the input of its own row (crosstalk) answers too early as well: where the
    record without that share is far likelier than as it is and with the input read earlier, it is read so. Rows of an
    input that the outputs alone did not decide (:func:`harness.data.oddities.spikes.unfelt`) are asked alike.

    Parameters
    ----------
    system : System
        The nominal model.
    dataset : Dataset

    Returns
    -------
    Dataset
        Runs lose as many rows at their end as an input is late; ``intersample`` is ``foh`` where inputs were not held.
        Readings are without the crosstalk that was found.
    """
    dataset = examined(dataset)
    if not system.nx or not system.inputs or not dataset.estimation:
        return dataset
    for number, run in enumerate(dataset.runs):
        if any(_open(odd, number) for odd in dataset.oddities or ()):
            dataset = _glitches(system, dataset, number, run)
    return _shifted(system, dataset)


def _open(odd: Oddity, run: int) -> bool:
    """Return True for rows of an input of which the outputs alone do not tell whether the plant felt them."""
    return odd.run == run and odd.kind in ("spike", "word") and not odd.fault and not odd.used


# ---- rows that the plant did not feel ------------------------------------------------------------------------------


def _glitches(system: System, dataset: Dataset, number: int, run: Run) -> Dataset:
    """Return the data set with the open rows of one run decided, as far as they can be."""
    record = run.trajectory
    u, told = record.u.copy(), list(dataset.oddities or ())
    names = [channel.name for channel in record.spec.inputs]
    asked = [odd for odd in told if _open(odd, number)]
    for odd in asked:
        column = names.index(odd.channel)
        u[:, column] = without(u[:, column], np.array(odd.rows))
    first = max(min(min(odd.rows) for odd in asked) - _SAMPLES // 4, 0)
    part = slice(first, min(first + _SAMPLES, len(record)))
    equations = _asked(system, record[part], dataset)
    gained = 0.0 if equations is None else _gain(equations, replace(record, u=u)[part])
    if not np.isfinite(gained) or abs(gained) < ODD.felt:
        return dataset
    rest = [odd for odd in told if odd not in asked]
    if gained < 0.0:  # the plant felt them: they are inputs like others
        return replace(dataset, oddities=tuple(rest))
    found = [
        replace(odd, words=f"{odd.words.rpartition(':')[0]}: the plant did not feel it, by its equations", fault=True,
                used=True) for odd in asked
    ]  # fmt: skip
    runs = list(dataset.runs)
    runs[number] = replace(run, trajectory=replace(record, u=u))
    return _with(replace(dataset, runs=tuple(runs), oddities=tuple(rest)), found)


# ---- rows late -----------------------------------------------------------------------------------------------------


def _shifted(system: System, dataset: Dataset) -> Dataset:
    """Return the data set with inputs read as many rows earlier as they were written late."""
    record = max(dataset.estimation, key=len)
    moving = [k for k in range(record.spec.nu) if np.ptp(record.u[:, k]) > 0]
    if len(record) < ODD.fewest or not moving:
        return dataset
    law = law_of([record])
    cut = record[: min(len(record), _SAMPLES)]
    spare = DATA_POLICY.rows_late + 1

    def read(rows: float, taken_up: FloatArray | None = None) -> Trajectory:
        """Return the record with its inputs read some rows earlier, without the ends that this may cost."""
        y = cut.y if taken_up is None else cut.y - cut.u @ taken_up
        return replace(cut, u=_earlier(cut.u, rows), y=y)[spare : len(cut) - spare]

    equations = _asked(system, read(0.0), dataset)
    if equations is None:
        return dataset
    rows, gained = _late(equations, read)
    without = -np.inf
    # readings half a row early are those of a controller that works faster than the log, which answers them in turn
    at_once = rows >= 1.0 or any(odd.kind == CROSSTALK for odd in dataset.oddities or ())
    if law is None and at_once and (taken_up := taken_up_at_once([record])) is not None:
        without = _gain(equations, read(0.0, taken_up))
        if without >= max(gained, 0.0) + ODD.shift:
            return _without_crosstalk(dataset, record, taken_up, without)
    if not rows or (law is not None and not (rows >= 1.0 and equations.keeps(read(rows)))):
        return dataset
    return _read_so(dataset, record, moving, rows, gained, doubted=without > gained - ODD.shift)


def _read_so(
    dataset: Dataset, record: Trajectory, moving: Sequence[int], rows: float, gained: float, *, doubted: bool
) -> Dataset:
    """Return the data set with its inputs read as they were found to be written, and that said.

    - ``rows``: by which they are late; below 0 early, which is only said
    - ``gained``: in log-likelihood by reading them so
    - ``doubted``: whether crosstalk would explain it as well
    """
    late, one = int(abs(rows)), len(moving) == 1
    names = " and ".join(record.spec.inputs[k].name for k in moving)
    many, verb = "one row" if late == 1 else f"{late} rows", "is" if one else "are"
    number = next(k for k, run in enumerate(dataset.runs) if run.trajectory is record)
    if not late:
        if rows < 0 or dataset.intersample != "zoh":
            return dataset
        words = (
            f"{names} {'moves' if one else 'move'} between readings: the plant follows a line from one to "
            f"the next (log-likelihood {gained:.0f} higher than held), as where a controller works faster than the "
            'log, and it is read so here; declare intersample = "foh"'
        )
        return _with(replace(dataset, intersample="foh"), [Oddity("between", number, names, (), words, used=True)])
    if rows < 0:
        words = (
            f"{names} {verb} recorded {many} early, or the plant has a dead time of {many}: the equations of motion "
            f"ask for it (log-likelihood {gained:.0f} higher), and the record does not tell which"
        )
        return _with(dataset, [Oddity("shift", number, names, (), words)])
    words = (
        f"{names} {verb} recorded {many} late: the plant answers before (log-likelihood {gained:.0f} higher with "
        f"the input read {many} earlier, as it is here); write u[k] beside the y[k] that it follows, before the step"
    )
    if doubted:
        words += "; readings that take up some of the input within the row (crosstalk) would explain it as well"
    runs = [replace(run, trajectory=_reread(run.trajectory, late)) for run in dataset.runs]
    return _with(replace(dataset, runs=tuple(runs)), [Oddity("shift", number, names, (), words, used=True)])


def _without_crosstalk(dataset: Dataset, record: Trajectory, taken_up: FloatArray, gained: float) -> Dataset:
    """Return the data set whose readings have lost what they take up (nu, ny) of the inputs of their row."""
    spec, size = record.spec, np.abs(taken_up) * record.u.std(axis=0)[:, None]
    largest = size.max(axis=0)
    number = next(k for k, run in enumerate(dataset.runs) if run.trajectory is record)
    runs = [replace(run, trajectory=replace(run.trajectory, y=run.trajectory.y - run.trajectory.u @ taken_up))
            for run in dataset.runs]  # fmt: skip
    found = []
    for column in np.flatnonzero(largest > 0):
        output, most = spec.outputs[column], int(np.argmax(size[:, column]))
        given = spec.inputs[most]
        words = (
            f"{output.name} takes up {taken_up[most, column]:.4g} {quotient(output.unit, given.unit)} of "
            f"{given.name} within the same row (crosstalk): the equations of motion ask for it (log-likelihood "
            f"{gained:.0f} higher without it, as the record is read here, and less so with the input read earlier)"
        )
        found.append(Oddity(CROSSTALK, number, output.name, (), words, used=True))
    rest = tuple(odd for odd in dataset.oddities or () if odd.kind != CROSSTALK)
    return _with(replace(dataset, runs=tuple(runs), oddities=rest), found)


def _late(equations: _Equations, read: Callable[[float], Trajectory]) -> tuple[float, float]:
    """Return by how many rows an input is late (below 0: early), 0 if none, and the log-likelihood of the likeliest."""
    sides = {sign: _gain(equations, read(0.5 * sign)) for sign in (1.0, -1.0)}
    sign = max(sides, key=lambda side: sides[side])
    if sides[sign] < 0.0:
        return 0.0, 0.0
    known = {0.0: 0.0, 0.5: sides[sign]}
    for rows in DATA_POLICY.rows_tried:
        known[rows] = _gain(equations, read(sign * rows))
        if known[rows] < max(known.values()):
            break
    late = max(known, key=lambda rows: known[rows])
    beside = [known[rows] for rows in (0.0, late - 0.5, late + 0.5) if rows in known and rows != late]
    clear = late in (0.5, 1.0, 2.0) and known[late] >= max(beside) + ODD.shift
    return sign * late if clear else 0.0, known[late]


def _reread(record: Trajectory, rows: int) -> Trajectory:
    """Return a record with its inputs read some rows earlier."""
    return replace(record, u=_earlier(record.u, rows))[: len(record) - rows]


def _earlier(u: FloatArray, rows: float) -> FloatArray:
    """Return inputs read some rows earlier, the last ones held; between rows their mean over each sample.

    Examples
    --------
    >>> u = np.array([[0.0], [1.0], [3.0]])
    >>> _earlier(u, 1).ravel().tolist(), _earlier(u, -0.5).ravel().tolist()
    ([1.0, 3.0, 3.0], [0.0, 0.5, 2.0])
    """
    whole = int(np.floor(rows))
    part = rows - whole
    places = np.arange(len(u)) + whole
    near, far = (u[np.clip(places + more, 0, len(u) - 1)] for more in (0, 1))
    return np.asarray((1.0 - part) * near + part * far)


# ---- likelihoods ---------------------------------------------------------------------------------------------------


class _Equations:
    """The nominal model at its maximum for a record, and how likely records beside it are."""

    def __init__(self, system: System, record: Trajectory, intersample: Intersample) -> None:
        self._likelihood, self._base = fit_likelihood(system, [record.measured()], intersample=intersample)
        self._intersample = intersample

    def gain(self, record: Trajectory) -> float:
        """Return how much likelier the model makes a record with another input."""
        return self._base.nll - self._fitted(record).nll

    def keeps(self, record: Trajectory) -> bool:
        """Return True where the model keeps its declared values for a record with another input."""
        found, most = self._fitted(record).point.p, DATA_POLICY.own_values
        free = [not one.fixed and one.declared and one.value != 0.0 for one in self._likelihood.system.parameters]
        ratio = np.array([found[k] / self._likelihood.system.parameters[k].value for k in np.flatnonzero(free)])
        return bool(ratio.size and ((ratio >= 1.0 / most) & (ratio <= most)).all())

    def _fitted(self, record: Trajectory) -> LikelihoodFit:
        """Return the maximum for a record with another input."""
        own = self._likelihood
        other = Likelihood(
            own.system, [record.measured()], own.noise_model, intersample=self._intersample, passes=own.filter
        )
        return other.maximise(self._base.point, most=_STEPS)


def _asked(system: System, record: Trajectory, dataset: Dataset) -> _Equations | None:
    """Return the model at its maximum, None where it cannot be fitted."""
    try:
        return _Equations(system, record, dataset.intersample)
    except _CANNOT:
        return None


def _gain(equations: _Equations, record: Trajectory) -> float:
    """Return how much likelier a record is, minus infinity where the model cannot be fitted to it."""
    try:
        return equations.gain(record)
    except _CANNOT:
        return -np.inf


def _with(dataset: Dataset, found: Sequence[Oddity]) -> Dataset:
    """Return the data set with more that was found."""
    said = [f"run {odd.run}: {odd.words}" for odd in found]
    return replace(dataset, oddities=(*(dataset.oddities or ()), *found), warnings=(*dataset.warnings, *said))
