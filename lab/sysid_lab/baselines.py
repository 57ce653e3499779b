"""What others would do with the records of a study: baselines for the closed loop, from the same dictionary.

- ``lasso``, ``best-subset``, ``stlsq``: the force that the nominal model leaves over along the smoothed motion,
  regressed on what the laws of the dictionary would do, at their first guesses, beside the nominal parameters. That is
  what sparse regression for residual physics does (Brunton, Proctor & Kutz 2016, PNAS 113:3932); laws with a state of
  their own, of the sensors or of the actuator have no column and are never named: a column with the input in it is the
  target of the regression itself.
- ``output-error``: forward selection by free runs. The law whose output-error fit has the least BIC (Schwarz 1978) is
  added while it lowers it, three at most, as population models are built step by step.

None knows of latent forces, of ties, or of laws that stand in for others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np

from harness.diagnosis.dictionary import laws_of, placed
from harness.diagnosis.kinds import EquationsKind
from harness.diagnosis.policy import POLICY
from harness.diagnosis.runs.equation_form import EquationForm
from harness.diagnosis.runs.form import FreeRunForm
from harness.diagnosis.runs.simple_fits import SimpleFit, SimpleFits
from harness.effects.compose import compose
from harness.effects.effect import Placed
from harness.errors import HarnessError, InputError, refuse_unknown
from harness.physics.compiled.system import System
from harness.signals import Dataset, FloatArray
from harness.supervision.workers import death, one_thread, worker_pool
from identifiers.common.normal import NormalEquations
from identifiers.sparse.selection import best_subset, lasso
from identifiers.sparse.stlsq import stlsq
from sysid_lab.leaderboard import read_answers, rows_of, write_answers
from sysid_lab.outcome import Answer

TIME_LIMIT = 600.0  # Seconds for one record.
_SHARES = np.geomspace(0.3, 0.01, 12)  # Thresholds that are tried, as shares of the leftover force: BIC chooses one.
_ALIKE = 0.999  # Cosine from which on two columns are one.
_ROUNDS = 3  # Times that the nominal parameters are fitted to the leftover force before any law is.


def answered(method: str, dataset: Dataset, system: System) -> Answer:
    """Return what a baseline answers to one record.

    Parameters
    ----------
    method : str
        A key of :data:`METHODS`.
    dataset : Dataset
        With estimation and validation runs.
    system : System
        The nominal model.

    Raises
    ------
    InputError
        If there is no such baseline.
    """
    refuse_unknown("baseline", method, METHODS)
    with one_thread():
        names = METHODS[method](dataset, system)
    return Answer("effects_found" if names else "nothing_missing", tuple(names))


# ---- regression of the leftover force --------------------------------------------------------------------------------


def _regressed(dataset: Dataset, system: System, choose: Callable[[NormalEquations], FloatArray]) -> list[str]:
    """Return the laws whose columns are chosen to explain the force that the nominal model leaves over."""
    form = EquationForm(system, dataset, sizes=EquationsKind().form(system, dataset).sizes, shape="weak")
    motions, p = form.motions["estimation"], system.vector()
    free = [k for k, parameter in enumerate(system.parameters) if not parameter.fixed]
    plain = form.equations(())
    for _ in range(_ROUNDS):
        left, known = _stacked([plain.weak_residual(motion, p, free) for motion in motions])
        p[free] -= np.linalg.lstsq(known, left, rcond=None)[0]
    left, known = _stacked([plain.weak_residual(motion, p, free) for motion in motions])
    basis = np.linalg.qr(known)[0]
    target, kept = -(left - basis @ (basis.T @ left)), dict[str, FloatArray]()
    for name, column in _columns(form, system, p):
        own = column - basis @ (basis.T @ column)
        if np.linalg.norm(own) < POLICY.seen * np.linalg.norm(column):
            continue  # the nominal parameters do as much
        own /= np.linalg.norm(own)
        if all(abs(own @ other) < _ALIKE for other in kept.values()):  # of two that do the same, the first
            kept[f"{name} {len(kept)}"] = own
    if not kept:
        return []
    chosen = choose(NormalEquations.of([(np.array(list(kept.values())), target[None])], len(kept), 1))
    return list(dict.fromkeys(name.split()[0] for name, size in zip(kept, chosen.ravel(), strict=True) if size != 0.0))


def _columns(form: EquationForm, system: System, p: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield names of laws of forces, and what each of their linear parameters does to the leftover force (rows,)."""
    inputs = {channel.name for channel in system.inputs}
    for one in placed(system, laws_of())[0]:
        linear = [parameter for parameter in one.effect.parameters if parameter.linear]
        if not linear or not form.judges(one) or one.at in inputs:
            continue
        try:
            made = form.equations((one,))
            values = dict(zip(system.parameter_names, map(float, p), strict=True))
            at = made.system.vector(values | {one.name(parameter.name): 0.0 for parameter in linear})
            where = [made.system.parameter_names.index(one.name(parameter.name)) for parameter in linear]
            found = _stacked([made.weak_residual(motion, at, where) for motion in form.motions["estimation"]])[1]
        except (HarnessError, ArithmeticError):
            continue
        yield from ((str(one), column) for column in found.T[np.isfinite(found).all(axis=0)])


def _stacked(parts: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Return residuals (rows,) and derivatives (rows, k) of all records and coordinates, one after the other."""
    return np.concatenate([r.ravel() for r, _ in parts]), np.concatenate([j.reshape(-1, j.shape[2]) for _, j in parts])


def _thresholded(equations: NormalEquations) -> FloatArray:
    """Return the coefficients of least BIC over thresholds."""

    def price(found: FloatArray) -> float:
        left = (
            equations.square[0] - 2 * found[:, 0] @ equations.right[:, 0] + found[:, 0] @ equations.gram @ found[:, 0]
        )
        return float(equations.rows * np.log(max(left, 1e-300)) + np.count_nonzero(found) * np.log(equations.rows))

    return min((stlsq(equations, float(share))[0] for share in _SHARES), key=price)


# ---- forward selection by free runs ----------------------------------------------------------------------------------


def _forward(dataset: Dataset, system: System) -> list[str]:
    """Return the laws that lower the BIC of output errors, one after the other."""
    kind, effects = EquationsKind(), list[Placed]()
    candidates = placed(system, laws_of())[0]
    while len(effects) < POLICY.most:
        form = kind.form(system, dataset)
        runs = kind.runs(form, dataset, form.noise_model.output_scale, kind.horizon(system, system.values(), dataset))
        assert isinstance(runs, FreeRunForm)
        others = [one for one in candidates if str(one) not in map(str, effects)]
        fits = SimpleFits(runs, system.values(), others)
        before = fits.nominal
        best = min(fits.table, key=_bic, default=None)
        if before is None or best is None or _bic(best) >= _bic(before):
            break
        effects += best.effects
        if any(one.effect.states or one.effect.sampled for one in effects):
            break  # no record tells the state that a next round would begin from
        system = compose(system, best.effects, sizes=form.sizes).with_parameters(best.values)
    return list(map(str, effects))


def _bic(fit: SimpleFit) -> float:
    """Return the BIC of a fit of free runs, every output with a noise of its own."""
    errors = np.concatenate(list(fit.fitted.estimation))
    count = sum(not parameter.fixed for parameter in fit.fitted.system.parameters)
    return float(len(errors) * np.log(np.mean(errors**2, axis=0)).sum() + count * np.log(errors.size))


METHODS: Mapping[str, Callable[[Dataset, System], list[str]]] = {
    "lasso": lambda dataset, system: _regressed(dataset, system, lambda equations: lasso(equations)[0]),
    "best-subset": lambda dataset, system: _regressed(
        dataset, system, lambda equations: best_subset(equations, POLICY.most)[0]
    ),
    "stlsq": lambda dataset, system: _regressed(dataset, system, _thresholded),
    "output-error": _forward,
}
"""Baselines by name: functions of the data and the nominal model that return names of effects."""


# ---- whole packages --------------------------------------------------------------------------------------------------


def answer_all(
    method: str,
    table: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    resume: bool = False,
    show: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> dict[str, str]:
    """Write the answer file of a baseline over the records of a package; return why some have no answer, by record.

    Parameters
    ----------
    method : str
        A key of :data:`METHODS`.
    table : path
        ``records.csv``, as ``sysid-lab generate`` writes it.
    out : path
        Answer file; it holds all answers so far at any time.
    workers : int
        Processes.
    resume : bool
        Keep the answers that are there.
    show : callable
        Called as ``show(done, total, what)``.

    Raises
    ------
    InputError
        If there is no such baseline, the table cannot be read, or the answer file is there and ``resume`` is not given.
    """
    refuse_unknown("baseline", method, METHODS)
    path = Path(out)
    files = [Path(table).parent / row["file"] for row in rows_of(table, ("file", "machine"), ())]
    if path.exists() and not resume:
        raise InputError("answer file", expected="a new one", got="one that is there", remedy="--resume", file=path)
    answers, failed = read_answers(path) if path.exists() else {}, dict[str, str]()
    left = [file for file in files if file.parent.name not in answers]
    with worker_pool(min(workers, max(len(left), 1))) as pool:
        waiting = {pool.schedule(_one, args=[method, file], timeout=TIME_LIMIT): file.parent.name for file in left}
        show(len(answers), len(files), method)
        for task in as_completed(waiting):
            name = waiting[task]
            try:
                answers[name] = task.result()
            except Exception as error:  # whatever ended one record leaves the others
                failed[name] = " ".join(str(error).split()) if isinstance(error, HarnessError) else death(error)
            write_answers(path, answers)
            show(len(answers) + len(failed), len(files), name)
    return failed


def _one(method: str, file: Path) -> Answer:
    """Return the answer to a record."""
    from harness.api import load_dataset
    from harness.physics import load_model

    loaded = load_dataset(file)
    assert loaded.nominal is not None
    return answered(method, loaded.dataset, load_model(loaded.nominal.model))
