"""Transfer functions in continuous time: their numbers with intervals, their response, and what they are sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harness.errors import InputError
from harness.models.estimate import Estimate
from harness.models.spread import gain_and_phase_deviation
from harness.signals import Channel, FloatArray, PlantSpec
from harness.specs import spec_from_dict, spec_to_dict
from harness.units import quotient
from identifiers.common.linear_model import LinearModel
from identifiers.common.neighbours import along_covariance, spread_of
from identifiers.common.one_step_estimate import LEVEL
from identifiers.linear.continuous.rational import Hold, Rational, sampled

if TYPE_CHECKING:
    import control

MANY = 1e6  # Degrees of freedom of a covariance that is known: Student's quantile is the normal one.


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """Outputs over inputs in continuous time: a rational function with dead times for each output.

    Parameters
    ----------
    inputs, outputs : tuple of Channel
    rows : tuple of Rational
        One for each output, with a numerator and a dead time for each input.
    covariances : tuple of array (k, k)
        Of the parameter vectors.
    notes : dict

    Examples
    --------
    >>> lag = Rational(np.array([1.0]), np.array([[3.0]]), np.array([0.1]), 2.0)
    >>> model = TransferFunction((Channel("u"),), (Channel("y"),), (lag,), (np.zeros((3, 3)),))
    >>> print(model)
    y per u: 6 / (s + 2) exp(-0.1 s)
    >>> model.sampled(0.1).a_matrix.round(4).tolist()
    [[0.8187, 0.5438, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    rows: tuple[Rational, ...]
    covariances: tuple[FloatArray, ...]
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def poles(self) -> npt.NDArray[np.complex128]:
        """Poles of all outputs [rad/s], the slowest first."""
        found = np.concatenate([row.poles for row in self.rows])
        return found[np.argsort(np.abs(found), kind="stable")]

    def frequency_response(self, frequency: FloatArray) -> npt.NDArray[np.complex128]:
        """Return the response (F, ny, nu) at frequencies [Hz]."""
        return np.stack([row.response(frequency) for row in self.rows], axis=1)

    def response_covariance(self, frequency: FloatArray) -> FloatArray:
        """Return the covariance of real and imaginary part of the response, (F, ny, nu, 2, 2)."""
        found = []
        for row, covariance in zip(self.rows, self.covariances, strict=True):
            slopes = row.gradients(frequency)
            both = np.stack([slopes.real, slopes.imag], axis=-2)
            found.append(both @ covariance @ np.swapaxes(both, -1, -2))
        return np.stack(found, axis=1)

    def deviation(self, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return standard deviations of modulus and phase [rad] of the response, (F, ny, nu) each."""
        return gain_and_phase_deviation(self.frequency_response(frequency), self.response_covariance(frequency))

    def sampled(self, sample_time: float, hold: Hold = "zoh") -> LinearModel:
        """Return the model between samples of inputs that are held (``"zoh"``) or straight between them (``"foh"``).

        Exact, dead times that are no whole number of samples included; the intervals go along.

        Raises
        ------
        InputError
            If a numerator has the degree of the denominator.
        """
        spec = PlantSpec(self.inputs, self.outputs, float(sample_time))
        return sampled_model(spec, self.rows, self.covariances, hold, {**self.notes, "hold": hold})

    def to_control(self, *, pade: int = 3) -> control.TransferFunction:
        """Return it as python-control's; dead times by a Pade approximation of this order."""
        import control

        top: list[list[Any]] = []
        bottom: list[list[Any]] = []
        for row in self.rows:
            parts = [control.pade(float(late), pade) if late > 0 else ([1.0], [1.0]) for late in row.delay]
            top.append([np.convolve(b, late[0]) for b, late in zip(row.numerators, parts, strict=True)])
            bottom.append([np.convolve(row.denominator, late[1]) for late in parts])
        return control.TransferFunction(
            top, bottom, inputs=[c.name for c in self.inputs], outputs=[c.name for c in self.outputs]
        )

    @property
    def estimate(self) -> Estimate:
        """Coefficients, poles, static gains and dead times with units and intervals (normal, to first order)."""
        return estimate_of_rows(self.inputs, self.outputs, self.rows, self.covariances)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "kind": "transfer-function",
            "spec": spec_to_dict(PlantSpec(self.inputs, self.outputs, 1.0)),
            "rows": [
                {"a": r.a.tolist(), "b": r.b.tolist(), "delay": r.delay.tolist(), "rate": r.rate} for r in self.rows
            ],
            "covariances": [c.tolist() for c in self.covariances],
            "notes": self.notes,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> TransferFunction:
        """Return the transfer function of a description."""
        spec = spec_from_dict(content["spec"])
        rows = tuple(
            Rational(np.array(r["a"]), np.array(r["b"]), np.array(r["delay"]), float(r["rate"]))
            for r in content["rows"]
        )
        return cls(
            spec.inputs,
            spec.outputs,
            rows,
            tuple(np.array(c, dtype=float) for c in content["covariances"]),
            dict(content.get("notes", {})),
        )

    def __str__(self) -> str:
        lines = []
        for output, row in zip(self.outputs, self.rows, strict=True):
            bottom = _polynomial(row.denominator)
            for given, top, late in zip(self.inputs, row.numerators, row.delay, strict=True):
                dead = f" exp(-{late:.4g} s)" if late > 0 else ""
                over = _polynomial(top)
                over = f"({over})" if " " in over else over
                lines.append(f"{output.name} per {given.name}: {over} / ({bottom}){dead}")
        return "\n".join(lines)


def sampled_model(
    spec: PlantSpec,
    rows: Sequence[Rational],
    covariances: Sequence[FloatArray],
    hold: Hold,
    notes: dict[str, Any],
    *,
    freedom: float = MANY,
    method: str = "curvature of the likelihood",
) -> LinearModel:
    """Return transfer functions of every output between samples, side by side, with their spread."""
    if any(row.b.shape[1] > row.a.size for row in rows):
        raise InputError(
            "transfer function to be sampled",
            expected="numerators of a lower degree than the denominator",
            got=f"degree {rows[0].b.shape[1] - 1} over {rows[0].a.size}",
            remedy="fit it with fewer zeros",
        )
    whole = _side_by_side(spec, rows, hold)
    near, factor = [], 1.0
    for number, (row, covariance) in enumerate(zip(rows, covariances, strict=True)):
        if not np.any(covariance):
            continue
        vectors, factor = along_covariance(row.vector, covariance)
        for vector in vectors:
            moved = row.moved(vector)
            # a dead time that would pass a whole number of samples changes the chain: it stays within its sample
            low = np.floor(row.delay / spec.sample_time + 1e-9) * spec.sample_time
            late = np.clip(moved.delay, low, low + spec.sample_time * (1 - 1e-9))
            late = np.where(row.delay > 0, late, 0.0)
            other = [*rows]
            other[number] = Rational(moved.a, moved.b, late, moved.rate)
            near.append(_side_by_side(spec, other, hold))
    a, b, c, d = whole
    feed = PlantSpec(spec.inputs, spec.outputs, spec.sample_time, spec.states, spec.feedthrough or bool(np.any(d)))
    same = [one for one in near if one[0].shape == a.shape]
    spread = spread_of(same, factor=factor, freedom=freedom, method=method) if near else None
    nx, ny = len(a), spec.ny
    return LinearModel(feed, a, b, c, d, np.zeros((nx, ny)), np.zeros(nx), np.zeros(ny), notes=notes, spread=spread)


def _side_by_side(
    spec: PlantSpec, rows: Sequence[Rational], hold: Hold
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D of all outputs."""
    from scipy.linalg import block_diag

    parts = [sampled(row, spec.sample_time, hold) for row in rows]
    a = np.asarray(block_diag(*(part[0] for part in parts)), dtype=np.float64)
    c = np.asarray(block_diag(*(part[2] for part in parts)), dtype=np.float64)
    return a, np.vstack([part[1] for part in parts]), c, np.vstack([part[3] for part in parts])


def estimate_of_rows(
    inputs: Sequence[Channel],
    outputs: Sequence[Channel],
    rows: Sequence[Rational],
    covariances: Sequence[FloatArray],
    *,
    freedom: float = MANY,
    method: str = "curvature of the likelihood, to first order",
) -> Estimate:
    """Return coefficients, static gains, poles and dead times of every output with intervals."""
    from scipy.stats import t

    names: list[str] = []
    units: list[str] = []
    values: list[FloatArray] = []
    variances: list[FloatArray] = []
    for output, row, covariance in zip(outputs, rows, covariances, strict=True):
        own_names, own_units = _named(inputs, output, row)
        names += own_names
        units += own_units
        found = _numbers(row)
        slopes = np.empty((found.size, row.vector.size))
        for k, size in enumerate(np.maximum(np.sqrt(np.diag(covariance)), 1e-9 * np.abs(row.vector) + 1e-12)):
            step = 0.01 * size * np.eye(row.vector.size)[k]
            up, down = (_numbers(row.moved(row.vector + sign * step), row.poles) for sign in (1, -1))
            slopes[:, k] = (up - down) / (0.02 * size)
        values.append(found)
        variances.append(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
    whole = np.concatenate(values)
    half = t.ppf(0.5 + LEVEL / 2, freedom) * np.sqrt(np.maximum(np.concatenate(variances), 0.0))
    told = bool(half.max(initial=0.0) > 0)
    return Estimate(
        tuple(names),
        tuple(units),
        whole,
        np.diag(np.concatenate(variances)),
        np.column_stack([whole - half, whole + half]) if told else None,
        LEVEL,
        method if told else "no interval: nothing but rounding is left",
    )


def _named(inputs: Sequence[Channel], output: Channel, row: Rational) -> tuple[list[str], list[str]]:
    """Return names and units of :func:`_numbers`."""
    n = row.a.size
    names = [f"{output.name}: denominator s^{n - k}" for k in range(1, n + 1)]
    units = ["1/s" if k == 1 else f"1/s^{k}" for k in range(1, n + 1)]
    for given in inputs:
        names.append(f"{output.name} per {given.name}, static")
        units.append(quotient(output.unit, given.unit))
    for given in inputs:
        names.append(f"{output.name} per {given.name}, dead time")
        units.append("s")
    for number, pole in enumerate(_upper(row.poles), 1):
        names.append(f"{output.name}: pole {number}, frequency")
        units.append("rad/s")
        if pole.imag != 0:
            names.append(f"{output.name}: pole {number}, damping")
            units.append("1")
    return names, units


def _numbers(row: Rational, like: npt.NDArray[np.complex128] | None = None) -> FloatArray:
    """Return denominator, static gains, dead times, and frequency and damping of every pole."""
    wanted = _upper(row.poles if like is None else like)
    shape = []
    for pole in wanted:  # in the order of the poles of the middle, and as real or complex as they are
        own = row.poles[int(np.argmin(np.abs(row.poles - pole)))]
        shape += [abs(own)] if pole.imag == 0 else [abs(own), -own.real / max(abs(own), 1e-300)]
    static = row.b[:, -1] / (row.a[-1] if row.a[-1] != 0 else np.nan)
    return np.concatenate([row.denominator[1:], np.nan_to_num(static), row.delay, shape])


def _upper(poles: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Return the poles that are not the lower of a pair, slowest first."""
    kept = poles[poles.imag >= -1e-12 * np.abs(poles)]
    return kept[np.lexsort((kept.imag, np.abs(kept)))]


def _polynomial(coefficients: FloatArray) -> str:
    """Return a polynomial in words, highest power first."""
    n = len(coefficients) - 1
    words = []
    for k, value in enumerate(coefficients):
        power = n - k
        if value == 0 and n:
            continue
        s = "" if power == 0 else "s" if power == 1 else f"s^{power}"
        size = "" if s and abs(value) == 1 else f"{abs(value):.5g}"
        words.append((" - " if value < 0 else " + ", f"{size} {s}".strip()))
    if not words:
        return "0"
    first = ("-" if words[0][0] == " - " else "") + words[0][1]
    return first + "".join(sign + word for sign, word in words[1:])
