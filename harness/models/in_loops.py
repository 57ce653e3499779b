"""What a record of a loop foretells of its outputs, and which part of its spectra what is new in them does not tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.judgement import feedback_of
from harness.models.arx_orders import EQUATIONS, MEMORY, LagTriangle
from harness.signals import FloatArray, Trajectory

ASKED = 5_000
"""Samples in which feedback is looked for."""
ANSWERED = 0.05
"""Share of an input's unpredictable part that past outputs explain, from which on a record counts as a loop's."""
Complex = npt.NDArray[np.complex128]


def innovations(records: Sequence[Trajectory]) -> list[FloatArray] | None:
    """Return what a long ARX model leaves of the outputs (N, ny) of every record, None where no loop is closed.

    The first samples, which it needs, are zeros.
    """
    spec, some, left = records[0].spec, [], ASKED
    for record in records:
        if left > 0:
            some.append(record[:left])
            left -= len(record)
    feedback = feedback_of(some)
    first = int(not spec.feedthrough)
    columns = 1 + MEMORY * spec.ny + (MEMORY + 1 - first) * spec.nu
    if not feedback.found or feedback.share < ANSWERED or sum(map(len, some)) < EQUATIONS * columns:
        return None
    whole = LagTriangle.of(some, MEMORY, first, MEMORY)
    chosen = whole.columns(MEMORY, [(first, MEMORY)] * spec.nu)
    theta = np.linalg.lstsq(whole.triangle[:, chosen], whole.triangle[:, whole.targets], rcond=1e-10)[0]
    return [_left(record, np.asarray(theta, dtype=np.float64), first) for record in records]


def _left(record: Trajectory, theta: FloatArray, first: int) -> FloatArray:
    """Return the errors one step ahead (N, ny) of the coefficients that LagTriangle's columns have."""
    n, found = len(record), np.zeros_like(record.y)
    if n <= MEMORY:
        return found
    columns = [np.ones((n - MEMORY, 1)), *(record.y[MEMORY - j : n - j] for j in range(1, MEMORY + 1))]
    columns += [record.u[MEMORY - j : n - j] for j in range(first, MEMORY + 1)]
    found[MEMORY:] = record.y[MEMORY:] - np.hstack(columns) @ theta
    return found


def without(both: Complex, crossed: Complex, nu: int) -> tuple[Complex, Complex]:
    """Return spectra of inputs (F, nu, nu), and of rests with them (F, ny, nu), without what is new in the outputs.

    What moves the inputs beside the controller is what is left of them: the part that tells what they do, at the noise
    that there is (Ljung 1999, eq. 13.53).

    Parameters
    ----------
    both : array (F, nu + ny, nu + ny)
        Of the inputs and innovations together.
    crossed : array (F, ny, nu + ny)
        Of the rests with them.
    nu : int
    """
    told, new = both[:, :nu, nu:], both[:, nu:, nu:]
    size = np.sqrt(np.maximum(np.einsum("fii->fi", new).real, 1e-300))
    inverse: Any = np.linalg.pinv(new / size[:, :, None] / size[:, None, :], rcond=1e-9, hermitian=True)
    inverse = inverse / size[:, :, None] / size[:, None, :]
    back = np.conj(np.swapaxes(told, 1, 2))
    return both[:, :nu, :nu] - told @ inverse @ back, crossed[:, :, :nu] - crossed[:, :, nu:] @ inverse @ back
