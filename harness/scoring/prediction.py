"""Equation error (one step ahead) and simulation error (free run): one definition, two horizons.

Both are :func:`predict` with another horizon (Ljung 1999, *System Identification*, sec. 3.1 and 16.5).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.exceptions import ComplexWarning

from harness.errors import InputError, PluginError
from harness.protocols import Filter, FreeRun, Model
from harness.signals import FloatArray, PlantSpec, Trajectory, residual

_FIRST = 50


SAME_CLOCK = 1e-3
"""Part of a sample time by which that of data may differ from a model's: as between the runs of one data set."""

DIVERGED = 1e6
"""NRMSE from which a prediction counts as diverged: it shows how fast the model grows, and nothing of the plant."""


@dataclass(frozen=True, eq=False)
class Score:
    """How far a model's predictions are from a record.

    Parameters
    ----------
    rms : array (ny,)
        Root mean square error of each output, in its unit; on a category output the share of wrong answers, rooted.
    nrmse : array (ny,)
        ``rms`` over the standard deviation of the measured output (on a category output: over the ``rms`` of always
        naming the most frequent category). 0 where both vanish, inf where only the measured output stands still.
    horizon : float or None
        Seconds; None for a free run over the whole record.
    burn_in : int
        Samples at the start that were not scored.
    initial_state : str
        How the initial state was found.
    samples : int
        Samples scored.
    """

    rms: FloatArray
    nrmse: FloatArray
    horizon: float | None
    burn_in: int
    initial_state: str
    samples: int

    def __repr__(self) -> str:
        how = "free run" if self.horizon is None else f"horizon {self.horizon:g} s"
        nrmse = ", ".join(f"{value:.4g}" for value in self.nrmse)
        return f"<Score: NRMSE {nrmse}; {how}, {self.samples} samples, initial state {self.initial_state}>"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        rows = [
            (k, f"{rms:.4g}", f"{nrmse:.4g}", f"{fit:.2f}")
            for k, (rms, nrmse, fit) in enumerate(zip(self.rms, self.nrmse, self.fit_percent, strict=True))
        ]
        return page(repr(self).strip("<>"), table(["output", "rms", "NRMSE", "fit %"], rows))

    @property
    def fit_percent(self) -> FloatArray:
        """Fit of each output, ``100 (1 - NRMSE)`` (ny,)."""
        return 100.0 * (1.0 - self.nrmse)

    @property
    def finite(self) -> bool:
        """False if a prediction diverged: it overflows, or misses by :data:`DIVERGED` times an output's scatter."""
        beyond = np.isfinite(self.nrmse) & (self.nrmse > DIVERGED)
        return bool((np.isfinite(self.rms) & ~beyond).all())


def same_language(spec: PlantSpec, data: Trajectory, what: str = "model") -> None:
    """Refuse data whose channels or sample time are not those of a model.

    Raises
    ------
    InputError
        If names or units of inputs or outputs, or the sample time, differ.
    """
    if not isinstance(data, Trajectory):
        raise InputError(
            "data", expected="a Trajectory, as load_dataset(...).dataset.runs hold", got=type(data).__name__,
            remedy="use the methods of harness.load_model(...), which read files and tables",
        )  # fmt: skip
    other = data.spec
    for side in ("inputs", "outputs"):
        mine = [(channel.name, channel.unit) for channel in getattr(spec, side)]
        theirs = [(channel.name, channel.unit) for channel in getattr(other, side)]
        if mine != theirs:
            raise InputError(
                f"{side} of the data",
                expected=f"those of the {what}: {', '.join(f'{n} [{u}]' for n, u in mine) or 'none'}",
                got=", ".join(f"{n} [{u}]" for n, u in theirs) or "none",
                remedy="rename or convert the signals, or fit a model to data of this kind",
            )
    if abs(spec.sample_time - other.sample_time) > SAME_CLOCK * spec.sample_time:
        raise InputError(
            "sample time of the data",
            expected=f"{spec.sample_time:.9g} s, that of the {what}",
            got=f"{other.sample_time:.9g} s",
            remedy="resample the data, or discretize the model anew",
        )


def predict(
    model: Model,
    data: Trajectory,
    horizon: int | None = 1,
    *,
    initial: FloatArray | None = None,
    initial_samples: int | None = None,
) -> FloatArray:
    """Predict the outputs of a record from what was known some steps before.

    Parameters
    ----------
    model : Model
    data : Trajectory
    horizon : int or None
        Steps ahead: the prediction of ``y[k]`` uses outputs up to ``y[k - horizon]`` and inputs up to ``u[k]``. None is
        the free run: no output is used after the initial state.
    initial : array (nx,), optional
        State at ``data.t[0]``; by default the model estimates it from the record.
    initial_samples : int, optional
        Let it see only so many samples for that.

    Returns
    -------
    array (N, ny)
        NaN in the first ``horizon`` rows, and from where a free run diverges.

    Raises
    ------
    InputError
        If channels or sample time are not the model's, or the horizon is not positive.
    """
    same_language(model.spec, data)
    if horizon is not None and horizon < 1:
        raise InputError("horizon", expected="1, 2, ... or None", got=repr(horizon), remedy="use None for a free run")
    x = _initial_state(model, data, initial, initial_samples)
    with _numbers_of(model):
        if horizon is None:
            return free_run(model, x, data.u)
        predictions = np.full((len(data), model.spec.ny), np.nan)
        if len(data) <= horizon:
            return predictions
        states = _ahead(model, filtered(model, x, data), data.u, horizon)
        predictions[horizon:] = model.output(states, data.u[horizon:])
    return predictions


def states_ahead(model: Model, data: Trajectory, horizon: int, *, initial_samples: int | None = None) -> FloatArray:
    """Return the states from which :func:`predict` reads its predictions.

    Parameters
    ----------
    model, data, initial_samples
        As for :func:`predict`.
    horizon : int
        Steps ahead.

    Returns
    -------
    array (N - horizon, nx)
        Row i belongs to sample ``horizon + i``; its output is not yet seen.

    Raises
    ------
    InputError
        As :func:`predict`, and if the record is not longer than the horizon.
    """
    same_language(model.spec, data)
    if not 1 <= horizon < len(data):
        raise InputError(
            "horizon", expected=f"1 .. {len(data) - 1} (samples - 1)", got=repr(horizon), remedy="shorten it"
        )
    with _numbers_of(model):
        x = _initial_state(model, data, None, initial_samples)
        return _ahead(model, filtered(model, x, data), data.u, horizon)


def errors(
    model: Model,
    data: Trajectory,
    horizon: float | None = None,
    *,
    initial_samples: int | None = None,
) -> tuple[FloatArray, str]:
    """Return measured minus simulated for a free run, whole or in windows.

    Parameters
    ----------
    model : Model
    data : Trajectory
    horizon : float, optional
        Length of a window [s]; by default one free run over the record. The initial state of a window is estimated from
        the window by a model without memory of the past (``burn_in`` 0); any other model starts from the state that it
        has filtered out of the record up to the window's first sample.
    initial_samples : int, optional
        See :func:`predict`.

    Returns
    -------
    (array (N, ny), str)
        The errors, wrapped on periodic channels; and how the initial state was found.

    Raises
    ------
    InputError
        If channels or sample time are not the model's, or the horizon is not positive.
    """
    same_language(model.spec, data)
    if horizon is not None and not (np.isfinite(horizon) and horizon > 0):
        raise InputError(
            "horizon of a simulation",
            expected="seconds, more than 0",
            got=repr(horizon),
            remedy="use None for a free run",
        )
    seen = "the whole record" if initial_samples is None else f"the first {initial_samples} samples"
    if horizon is None:
        predicted = predict(model, data, None, initial_samples=initial_samples)
        return residual(data.spec.outputs, data.y, predicted), f"estimated from {seen}"
    steps = max(1, round(horizon / data.spec.sample_time))
    n = len(data)
    predicted = np.full((n, model.spec.ny), np.nan)
    starts = np.arange(0, n, steps)
    with _numbers_of(model):
        if model.burn_in == 0:
            how = f"estimated in each window of {horizon:g} s"
            states = np.array([_initial_state(model, data[k : k + steps], None, initial_samples) for k in starts])
        else:
            how = f"filtered up to the start of each window of {horizon:g} s"
            states = filtered(model, _initial_state(model, data, None, initial_samples or _FIRST), data)[starts]
        whole = n // steps
        if whole:
            inputs = data.u[: whole * steps].reshape(whole, steps, -1)
            predicted[: whole * steps] = free_runs(model, states[:whole], inputs).reshape(whole * steps, -1)
        if n > whole * steps:
            predicted[whole * steps :] = free_runs(model, states[whole:], data.u[None, whole * steps :])[0]
    return residual(data.spec.outputs, data.y, predicted), how


def equation_error(model: Model, data: Trajectory, *, burn_in: int | None = None) -> Score:
    """Score the one-step-ahead predictions.

    Parameters
    ----------
    model : Model
    data : Trajectory
        Held out from the fit.
    burn_in : int, optional
        Samples not scored; by default what the model declares, and at least 1.

    Raises
    ------
    InputError
        If the data do not fit the model, or are too short to be scored.
    """
    skip = max(1, model.burn_in) if burn_in is None else max(1, burn_in)
    # The filter corrects the state at every sample, so that a short start is enough; over a whole record the free run
    # of an unstable model says nothing about its first sample.
    miss = residual(data.spec.outputs, data.y, predict(model, data, 1, initial_samples=_FIRST))
    how = f"estimated from the first {min(_FIRST, len(data))} samples, corrected at each sample"
    return _score(data, miss, skip, data.spec.sample_time, how)


def simulation_error(
    model: Model,
    data: Trajectory,
    *,
    horizon: float | None = None,
    burn_in: int | None = None,
    initial_samples: int | None = None,
) -> Score:
    """Score the free run: over the whole record, or in windows of ``horizon`` seconds (see :func:`errors`).

    A run that diverges scores infinity.
    """
    skip = model.burn_in if burn_in is None else burn_in
    miss, how = errors(model, data, horizon, initial_samples=initial_samples)
    return _score(data, miss, skip, horizon, how)


@contextmanager
def _numbers_of(model: Model) -> Iterator[None]:
    """Let a model diverge in silence, and refuse complex numbers: half of one is no answer."""
    with warnings.catch_warnings(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        warnings.simplefilter("error", ComplexWarning)
        try:
            yield
        except ComplexWarning as error:
            raise PluginError(
                f"{type(model).__name__} breaks its contract: expected real outputs and states, got complex ones; "
                "remedy: return real numbers"
            ) from error


def _initial_state(
    model: Model, data: Trajectory, initial: FloatArray | None, initial_samples: int | None
) -> FloatArray:
    """Return the state at the first sample, given or estimated; the true states are never passed on."""
    if initial is not None:
        return np.asarray(initial, dtype=np.float64)
    measured = data.measured()
    found: FloatArray = model.initial_state(
        measured if initial_samples is None else measured[: max(1, initial_samples)]
    )
    return found


def free_run(model: Model, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return the outputs (N, ny) of a free run from a state (nx,) under inputs (N, nu); NaN from where it diverges."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        outputs: FloatArray = free_runs(model, x[None], u[None])[0]
    return _until_divergence(outputs)


def free_runs(model: Model, x: FloatArray, u: FloatArray) -> FloatArray:
    """Return the outputs (M, N, ny) of free runs from states x (M, nx) under inputs u (M, N, nu)."""
    if isinstance(model, FreeRun):
        fast: FloatArray = model.free_run(x, u)
        return fast
    m, n = u.shape[:2]
    outputs = np.empty((m, n, model.spec.ny))
    for k in range(n):
        outputs[:, k] = model.output(x, u[:, k])
        x = model.step(x, u[:, k])
    return outputs


def filtered(model: Model, x: FloatArray, data: Trajectory) -> FloatArray:
    """Return the states (N, nx) after the output of the same sample was seen."""
    if isinstance(model, Filter):
        fast: FloatArray = model.filtered(x, data.u, data.y)
        return fast
    n = len(data)
    states = np.empty((n, x.shape[-1]))
    for k in range(n):
        states[k] = x = model.correct(x, data.u[k], data.y[k])
        x = model.step(x, data.u[k])
    return states


def _ahead(model: Model, states: FloatArray, u: FloatArray, horizon: int) -> FloatArray:
    """Return the states (N - h, nx), h steps ahead of every filtered state but the last h."""
    x = states[:-horizon]
    count = x.shape[0]
    for j in range(horizon):
        x = model.step(x, u[j : j + count])
    return x


def _until_divergence(outputs: FloatArray) -> FloatArray:
    """Return the outputs with NaN from the first row on that is not finite."""
    bad = ~np.isfinite(outputs).all(axis=1)
    if bad.any():
        outputs = outputs.copy()
        outputs[int(np.argmax(bad)) :] = np.nan
    return outputs


def _score(data: Trajectory, miss: FloatArray, skip: int, horizon: float | None, how: str) -> Score:
    """Return the score of errors, the first samples left out."""
    if len(data) <= skip:
        raise InputError(
            "record too short to be scored",
            expected=f"more than {skip} samples (burn-in)",
            got=str(len(data)),
            remedy="score on a longer record",
        )
    wrong = miss[skip:].copy()
    spread = np.empty(data.spec.ny)
    for column, channel in enumerate(data.spec.outputs):
        measured = data.y[skip:, column]
        if channel.kind == "category":
            wrong[:, column] = np.where(np.isnan(wrong[:, column]), np.nan, wrong[:, column] != 0.0)
            _, counts = np.unique(measured, return_counts=True)
            spread[column] = np.sqrt(1.0 - counts.max() / measured.size)
        else:
            spread[column] = np.std(np.unwrap(measured, period=channel.period) if channel.period else measured)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        rms = np.sqrt(np.mean(wrong**2, axis=0))
        rms[~np.isfinite(rms)] = np.inf
        nrmse = np.where(rms == 0.0, 0.0, rms / spread)
    return Score(rms, nrmse, horizon, skip, how, wrong.shape[0])
