"""The figures of public benchmarks: free runs that see a window of outputs, and what is scored behind it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.benchmark.public.rules import Rule
from harness.errors import InputError
from harness.protocols import Model
from harness.scoring import free_run
from harness.scoring.prediction import DIVERGED
from harness.signals import FloatArray, Trajectory


def window_rmse(measured: FloatArray, modelled: FloatArray, window: int) -> FloatArray:
    """Return the root mean square error of each output behind the window.

    Raises InputError if the shapes differ, or nothing is left behind the window.

    - ``measured, modelled`` (N, ny): outputs; where the model's are not finite, or miss by
      :data:`harness.scoring.prediction.DIVERGED` times the scatter of what was measured, the error is infinite
    - ``window``: samples at the start that are not scored
    - returns (ny,): as ``RMSE(test.y[n:], y_model[n:])`` of ``nonlinear_benchmarks.error_metrics``

    Examples
    --------
    >>> window_rmse(np.array([[0.0], [0.0], [1.0], [2.0]]), np.array([[9.0], [9.0], [4.0], [-1.0]]), 2)
    array([3.])
    """
    if measured.shape != modelled.shape or len(measured) <= window:
        raise InputError(
            "outputs of a test record",
            expected=f"the same shape for both, more than {window} samples",
            got=f"measured {measured.shape}, modelled {modelled.shape}",
            remedy="simulate the whole record",
        )
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.sqrt(np.mean((modelled[window:] - measured[window:]) ** 2, axis=0))
        grown = error > DIVERGED * np.std(measured[window:], axis=0)
    return np.where(np.isfinite(error) & ~grown, error, np.inf)


def simulated(model: Model, test: Trajectory, window: int | None) -> FloatArray:
    """Return the outputs (N, ny) of a free run over a test record.

    Parameters
    ----------
    model : Model
    test : Trajectory
    window : int or None
        The model is shown so many outputs and no other: one without memory of the past (``burn_in`` 0) estimates its
        initial state from them, any other filters its state through them, and what it then says of them is what was
        measured. None lets a model see the whole record for its initial state: the figure of such a run is another one.
    """
    record = test.measured()
    if window is None or model.burn_in == 0:
        return free_run(model, model.initial_state(record if window is None else record[:window]), test.u)
    x = model.initial_state(record[:window])
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(window):
            x = model.step(model.correct(x, test.u[k], test.y[k]), test.u[k])
    return np.vstack([test.y[:window], free_run(model, x, test.u[window:])])


def figure(rule: Rule, measured: Sequence[FloatArray], modelled: Sequence[FloatArray]) -> float:
    """Return the figure of a group of test records in the rule's unit: the mean over records and outputs.

    Parameters
    ----------
    rule : Rule
    measured, modelled : sequence of array (N, ny)
        Of most sets one record with one output, so that it is its root mean square error.
    """
    errors = [window_rmse(y, model, rule.window) for y, model in zip(measured, modelled, strict=True)]
    return float(rule.scale * np.mean(errors))


def horizon_errors(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the summed mean errors of predictions of a flight, as the nano-drone benchmark asks.

    Parameters
    ----------
    measured : array (N, 13)
        Position, velocity, quaternion (x, y, z, w) and angular velocity.
    predicted : array (M, H, 13)
        ``predicted[k, h - 1]`` is the state ``h`` steps after sample ``k``, foretold from the state at ``k`` and the
        inputs from there on; M = N - H starts.

    Returns
    -------
    array (4,)
        For position [m], velocity [m/s], orientation [rad] and angular velocity [rad/s] the mean distance over all
        starts, summed over the horizons 1 to H (Busetto et al. 2026, arXiv 2512.14450, its SimErr). Orientations are
        compared by ``2 atan2(|v|, w)`` of the rotation (v, w) between them, as the official function does it: a
        quaternion of the other sign is 2 pi off.

    Raises
    ------
    InputError
        If the shapes do not belong together.

    Examples
    --------
    >>> still = np.tile(np.eye(13)[9], (5, 1))
    >>> horizon_errors(still, np.tile(still[0], (3, 2, 1)))
    array([0., 0., 0., 0.])
    """
    starts, horizon = predicted.shape[:2]
    if measured.ndim != 2 or predicted.shape[2:] != measured.shape[1:] or starts + horizon != len(measured):
        raise InputError(
            "predictions of a flight",
            expected=f"(N - H, H, 13) for {measured.shape} measured",
            got=str(predicted.shape),
            remedy="predict from every sample that has H samples behind it",
        )
    truth = np.stack([measured[1 + h : 1 + h + starts] for h in range(horizon)], axis=1)
    parts = (slice(0, 3), slice(3, 6), slice(10, 13))
    position, velocity, rate = (np.linalg.norm(truth[..., at] - predicted[..., at], axis=-1) for at in parts)
    (v, w), (p, r) = ((one[..., 6:9], one[..., 9:10]) for one in (truth, predicted))
    between = w * p - r * v - np.cross(v, p)
    angle = 2.0 * np.arctan2(np.linalg.norm(between, axis=-1), np.sum(truth[..., 6:10] * predicted[..., 6:10], axis=-1))
    return np.array([float(one.mean(axis=0).sum()) for one in (position, velocity, angle, rate)])
