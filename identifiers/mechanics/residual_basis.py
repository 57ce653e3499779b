"""Functions of a residual force: Gaussians and wavelets of position and rate, whose centres lie in the data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from identifiers.common.reach import spread_out

Kind = Literal["gaussian", "wavelet"]
LEVELS = 3  # Scales of the wavelets: each halves the width of the one before and takes twice as many centres.


@dataclass(frozen=True, eq=False)
class Basis:
    """Radial functions of features z = ((q, v) - middle) / scale of one coordinate or of all.

    Gaussians ``exp(-r^2 / 2)``, or Mexican-hat wavelets ``(d - r^2) exp(-r^2 / 2)`` (d features; Zhang & Benveniste
    1992, IEEE Trans. Neural Networks 3:889), with ``r = |z - centre| / width``. Both vanish far from the data.
    """

    kind: Kind
    columns: tuple[int, ...]  # Which of (q_1 ... q_n, v_1 ... v_n) are the features.
    middle: FloatArray  # (d,)
    scale: FloatArray  # (d,)
    centres: FloatArray  # (k, d): In scaled features; each is an instant of the records
    widths: FloatArray  # (k,)

    @property
    def k(self) -> int:
        """Number of functions."""
        return len(self.centres)

    def values(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Return the functions (N, k) along a motion, q and v (N, n)."""
        z = (np.hstack([q, v])[:, list(self.columns)] - self.middle) / self.scale
        square = np.sum(((z[:, None, :] - self.centres) / self.widths[:, None]) ** 2, axis=2)
        return np.asarray(self._of(square, np.exp(-0.5 * square)))

    def symbolic(self, x: Any) -> Any:
        """Return the functions as a CasADi column (k,) of the state x (positions, then rates)."""
        import casadi as ca

        rows = []
        for centre, width in zip(self.centres, self.widths, strict=True):
            square = ca.SX(0)
            for place, column in enumerate(self.columns):
                far = ((x[column] - self.middle[place]) / self.scale[place] - centre[place]) / width
                square = square + far * far
            rows.append(self._of(square, ca.exp(-0.5 * square)))
        return ca.vertcat(*rows)

    def _of(self, square: Any, bell: Any) -> Any:
        return bell if self.kind == "gaussian" else (len(self.columns) - square) * bell

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        arrays = ("middle", "scale", "centres", "widths")
        return {"kind": self.kind, "columns": list(self.columns)} | {n: getattr(self, n).tolist() for n in arrays}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Basis:
        """Return the functions of a description."""
        columns = tuple(int(column) for column in content["columns"])
        arrays = [np.array(content[name], dtype=float) for name in ("middle", "scale", "centres", "widths")]
        middle, scale, centres, widths = arrays
        return cls(content["kind"], columns, middle, scale, centres.reshape(-1, len(columns)), widths)


def basis_of(kind: Kind, columns: tuple[int, ...], motion: FloatArray, count: int, width: float) -> Basis:
    """Return functions whose centres are instants of a motion.

    Raises InputError if there are fewer different instants than functions.

    - ``columns``: features among the columns of ``motion``
    - ``motion`` (N, 2 n): positions and rates
    - ``count``: how many functions; of wavelets over all scales together
    - ``width``: of a function, in distances to the nearest other centre

    Examples
    --------
    >>> path = np.column_stack([np.sin(np.arange(100)), np.cos(np.arange(100))])
    >>> basis = basis_of("gaussian", (0, 1), path, 5, 1.0)
    >>> basis.values(path[:, :1], path[:, 1:]).shape
    (100, 5)
    """
    features = motion[:, list(columns)]
    middle, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.where(scale > 1e-12 * np.abs(features).max(initial=1e-300), scale, 1.0)
    z = (features - middle) / scale
    counts = [count] if kind == "gaussian" else _by_level(count)
    centres, widths = [], []
    first = 0.0
    for level, number in enumerate(counts):
        own = spread_centres(z, number)
        if level == 0:
            first = width * _spacing(own)
        centres.append(own)
        widths.append(np.full(len(own), first / 2**level))
    return Basis(kind, columns, middle, scale, np.concatenate(centres), np.concatenate(widths))


def spread_centres(points: FloatArray, count: int) -> FloatArray:
    """Return so many of the points (N, d), each as far from the others as can be (farthest-point sampling).

    Gonzalez 1985, Theor. Comput. Sci. 38:293: covers the points within twice the best radius.
    """
    distinct = np.unique(points, axis=0)
    if count < 1 or len(distinct) < count:
        raise InputError(
            "functions of a residual force",
            expected=f"between 1 and {len(distinct)}, the number of different instants",
            got=str(count),
            remedy="lower the number, or record longer",
        )
    return spread_out(points, count)


def _spacing(centres: FloatArray) -> float:
    """Return the median distance of a centre to its nearest neighbour; 1 (a standard deviation) for a single one."""
    if len(centres) < 2:
        return 1.0
    far = np.linalg.norm(centres[:, None] - centres, axis=2) + np.diag(np.full(len(centres), np.inf))
    return float(np.median(far.min(axis=1)))


def _by_level(count: int) -> list[int]:
    """Return the numbers of wavelets of each scale, doubling, that sum to ``count``."""
    shares = np.array([2**level for level in range(LEVELS)]) / (2**LEVELS - 1)
    numbers = [max(1, int(share * count)) for share in shares]
    numbers[-1] = max(1, count - sum(numbers[:-1]))
    return numbers[: max(1, min(LEVELS, count))] if count < LEVELS else numbers
