"""Linear models from inputs and outputs: a file is named by its method.

Least squares from states, ARX and polynomial models (prediction error), DMD with control, Markov parameters, Ho-
Kalman (ERA, OKID), N4SID and its relatives, models along a trajectory, switching ones. May import
``identifiers.common``. Add a method as one file with a frozen dataclass that has ``fit(trajectories, *, rng) ->
Model``, its entry point in ``pyproject.toml``, and hold it with ``sysid check NAME``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "AlongTrajectory": "time_varying",
    "Arx": "arx",
    "ContinuousTransferFunction": "continuous.identifier",
    "Dmdc": "dmd",
    "FiniteSample": "bounds.finite_sample",
    "HoKalman": "ho_kalman",
    "ImpulseResponse": "impulse.identifier",
    "IterativeLearning": "iterative",
    "PredictionError": "prediction_error",
    "RecordLength": "length.record_length",
    "ResponseControl": "response_control",
    "StateLeastSquares": "least_squares",
    "Subspace": "n4sid",
    "TimeVarying": "iterative",
    "learn_input": "iterative",
    "linearised_along": "iterative",
    "markov_parameters": "markov",
    "welch": "spectral",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
