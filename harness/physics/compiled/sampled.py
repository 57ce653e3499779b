"""Effects on samples: delays that blend neighbouring samples, quantisers; with their derivatives."""

from __future__ import annotations

import numpy as np

from harness.physics.definition.model_equations import Equations
from harness.signals import FloatArray


def delayed(signal: FloatArray, delay: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return a signal delayed by any fraction of a sample, and its derivative by the delay.

    - ``signal`` (N,): held at its first value before the record
    - ``delay``: [s]; a negative one counts as 0
    - ``dt``: sample time [s]
    - returns (array (N,), array (N,)): ``(1 - f) s[k - n] + f s[k - n - 1]`` with ``delay = (n + f) dt``: for a held
      signal its mean over the sample

    Examples
    --------
    >>> delayed(np.array([0.0, 1.0, 1.0]), 0.05, 0.1)[0].tolist()
    [0.0, 0.5, 1.0]
    """
    whole, fraction = divmod(max(delay, 0.0) / dt, 1.0)
    count = signal.shape[0]
    rows = np.arange(count) - int(min(whole, count))
    near = signal[np.maximum(rows, 0)]
    far = signal[np.maximum(rows - 1, 0)]
    return (1.0 - fraction) * near + fraction * far, (far - near) / dt


def delayed_between(signal: FloatArray, delay: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return a signal that is linear between samples delayed by any fraction of one, and its derivative by the delay.

    By the cubic through four samples (Lagrange): a straight line between two would smooth what it delays, and pass for
    a lag. Its arguments are those of :func:`delayed`.

    Examples
    --------
    >>> late, change = delayed_between(np.arange(6.0) ** 2, 0.05, 0.1)
    >>> late[2:5].tolist(), change[2:5].round(9).tolist()
    ([2.25, 6.25, 12.25], [-30.0, -50.0, -70.0])
    """
    whole, f = divmod(max(delay, 0.0) / dt, 1.0)
    count = signal.shape[0]
    rows = np.arange(count) - int(min(whole, count))
    near = [signal[np.clip(rows + shift, 0, count - 1)] for shift in (1, 0, -1, -2)]
    weights = (-f * (1 - f) * (2 - f) / 6, (1 - f * f) * (2 - f) / 2, f * (1 + f) * (2 - f) / 2, -f * (1 - f * f) / 6)
    slopes = (
        -(2 - 6 * f + 3 * f * f) / 6, (-1 - 4 * f + 3 * f * f) / 2, (2 + 2 * f - 3 * f * f) / 2, -(1 - 3 * f * f) / 6,
    )  # fmt: skip
    late = sum((weight * part for weight, part in zip(weights, near, strict=True)), np.zeros_like(signal))
    change = sum((weight * part for weight, part in zip(slopes, near, strict=True)), np.zeros_like(signal))
    return late, change / dt


# So many samples before a window are continued backwards by a parabola; earlier ones are held.
_BACKWARDS = 25


def _delayed_output(signal: FloatArray, delay: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return a simulated output delayed, and its derivative by the delay.

    A window starts in the middle of a motion: what the sensor still tells of the time before is taken from the
    parabola through the first three samples, not from a motion that stood still.
    """
    if signal.shape[0] < 3:
        return delayed(signal, delay, dt)
    back = np.arange(_BACKWARDS, 0, -1, dtype=float).reshape(-1, *[1] * (signal.ndim - 1))
    difference, bend = signal[1] - signal[0], signal[2] - 2 * signal[1] + signal[0]
    longer = np.concatenate([signal[0] - back * difference + 0.5 * back * (back + 1.0) * bend, signal])
    late, change = delayed(longer, delay, dt)
    return late[_BACKWARDS:], change[_BACKWARDS:]


def quantised(signal: FloatArray, step: float) -> FloatArray:
    """Return a signal rounded to multiples of a step (step 0: unchanged)."""
    return signal if step <= 0 else np.round(signal / step) * step


class SampledBlocks:
    """The sampled blocks of a system, applied to arrays of inputs and outputs.

    Parameters
    ----------
    system : Equations
    dt : float
        Sample time [s].
    held : bool
        False for inputs that move between samples.

    Attributes
    ----------
    delay_columns : tuple of int
        The parameters (by index) through which the inputs depend on p, one for each input delay.
    """

    def __init__(self, system: Equations, dt: float, *, held: bool = True) -> None:
        names = system.parameter_names
        self.dt = dt
        self._delayed = delayed if held else delayed_between
        self.input_delays = [(b.index, names.index(b.parameter)) for b in system.sampled if b.kind == "input_delay"]
        self.output_blocks = [
            (b.kind, b.index, names.index(b.parameter)) for b in system.sampled if b.kind != "input_delay"
        ]
        self.delay_columns = tuple(dict.fromkeys(column for _, column in self.input_delays))
        self.before = [
            (b.index, names.index(b.parameter), [channel.name for channel in system.states].index(b.before))
            for b in system.sampled
            if b.before
        ]

    def begun(self, u: FloatArray, p: FloatArray, x0: FloatArray) -> FloatArray:
        """Return inputs behind delays (N, nu) with what initial states (nx,) tell of the time before the record."""
        if any(x0[state] for _, _, state in self.before):
            u = u.copy()
            for column, parameter, state in self.before:
                arrived = delayed(np.concatenate([[0.0], np.ones(u.shape[0])]), float(p[parameter]), self.dt)[0][1:]
                u[:, column] += x0[state] * (1.0 - arrived)
        return u

    def inputs(self, u: FloatArray, p: FloatArray, jacobian: bool) -> tuple[FloatArray, FloatArray | None]:
        """Return the inputs that the equations see (M, N, nu), and if wanted their Jacobian (M, N, nu, delays)."""
        if not self.input_delays:
            return u, None
        seen = u.copy()
        input_jacobian = np.zeros((*u.shape, len(self.delay_columns)))
        for window in range(u.shape[0]):
            for column, parameter in self.input_delays:
                place = self.delay_columns.index(parameter)
                for other in range(len(self.delay_columns)):
                    input_jacobian[window, :, column, other] = self._delayed(
                        input_jacobian[window, :, column, other], p[window, parameter], self.dt
                    )[0]
                late, change = self._delayed(seen[window, :, column], p[window, parameter], self.dt)
                seen[window, :, column] = late
                input_jacobian[window, :, column, place] += change
        return seen, (np.ascontiguousarray(input_jacobian) if jacobian else None)

    def outputs(self, y: FloatArray, s: FloatArray | None, p: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return the outputs (M, N, ny) and sensitivities (M, N, ny, np + nx) that the sensors tell."""
        if not self.output_blocks:
            return y, s
        y = y.copy()
        for window in range(y.shape[0]):
            for kind, column, parameter in self.output_blocks:
                value = p[window, parameter]
                if kind == "quantise":
                    y[window, :, column] = quantised(y[window, :, column], value)
                    continue
                late, change = _delayed_output(y[window, :, column], value, self.dt)
                y[window, :, column] = late
                if s is not None:
                    s[window, :, column, :] = _delayed_output(s[window, :, column, :], value, self.dt)[0]
                    s[window, :, column, parameter] += change
        return y, s


class BySample:
    """What runs of others have in common with a simulator: their inputs are held over communication steps."""

    pieces = 1
    sampled: SampledBlocks

    def seen(self, u: FloatArray, p: FloatArray, jacobian: bool) -> tuple[FloatArray, FloatArray | None]:
        """Return the inputs that the plant sees, and their Jacobian by delays: of each sample one."""
        return self.sampled.inputs(u, p, jacobian)
