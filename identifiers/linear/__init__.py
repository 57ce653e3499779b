"""Linear models from inputs and outputs: a file is named by its method.

Least squares from states, ARX and polynomial models (prediction error), DMD with control, Markov parameters, Ho-
Kalman (ERA, OKID), N4SID and its relatives, models along a trajectory, switching ones. May import
``identifiers.common``. Add a method as one file with a frozen dataclass that has ``fit(trajectories, *, rng) ->
Model``, its entry point in ``pyproject.toml``, and hold it with ``sysid check NAME``.
"""
