"""Balanced realisations: what each state is worth, and models cut to the states that count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.errors import InputError
from harness.models.lqr import spectral_radius
from harness.signals import FloatArray
from identifiers.common.linear_model import LinearModel

__all__ = ["balanced"]

# Directions weaker than this are neither reached nor seen: they are left out.
_NOTHING = 1e-12


def balanced(model: LinearModel, *, order: int | None = None) -> tuple[LinearModel, FloatArray]:
    """Return a stable model in balanced coordinates, and its Hankel singular values.

    Inputs and outputs count as they are: scale them first where units differ. Cutting to ``order`` states changes the
    frequency response by at most twice the sum of the values left out (Glover 1984, Int. J. Control 39:1115; square
    root method of Laub et al. 1987).

    Parameters
    ----------
    model : LinearModel
    order : int, optional
        Number of states kept; all that are both reached and seen without it.

    Returns
    -------
    LinearModel, array (n,)
        The model, whose filter gain is projected too, and all singular values, largest first.

    Raises
    ------
    InputError
        If the model is unstable, or has fewer states than asked for.

    Examples
    --------
    >>> from harness.signals import Channel, PlantSpec
    >>> spec = PlantSpec((Channel("u"),), (Channel("y"),), 1.0)
    >>> a, b, c = np.diag([0.9, 0.1]), np.ones((2, 1)), np.array([[1.0, 0.0]])
    >>> whole = LinearModel(spec, a, b, c, np.zeros((1, 1)), np.zeros((2, 1)), np.zeros(2), np.zeros(1))
    >>> small, values = balanced(whole)
    >>> small.eigenvalues.real.round(9).tolist(), values.round(3).tolist()
    ([0.9], [5.263])
    """
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c = model.a_matrix, model.b_matrix, model.c_matrix
    if spectral_radius(a) >= 1.0:
        raise InputError(
            "balanced realisation",
            expected="a stable model",
            got=f"spectral radius {spectral_radius(a):.4g}",
            remedy="fit with stable=true",
        )
    pairs = ((a, b @ b.T), (a.T, c.T @ c))
    reach, watch = (_root(np.asarray(solve_discrete_lyapunov(x, y), dtype=np.float64)) for x, y in pairs)
    left, values, right = np.linalg.svd(watch.T @ reach)
    kept = int(np.sum(values > _NOTHING * values[0])) if values.size and values[0] > 0 else 0
    if order is not None and not 1 <= order <= kept:
        raise InputError("order", expected=f"1 to {kept}", got=str(order), remedy="ask for fewer states")
    n = kept if order is None else order
    root = np.sqrt(values[:n])
    down = (left[:, :n] / root).T @ watch.T
    up = reach @ right[:n].T / root
    small = replace(
        model,
        a_matrix=down @ a @ up,
        b_matrix=down @ b,
        c_matrix=c @ up,
        filter_gain=down @ model.filter_gain,
        state_offset=down @ model.state_offset,
        notes={**model.notes, "hankel_singular_values": values[:kept].tolist()},
    )
    return small, values[:kept]


def _root(covariance: FloatArray) -> FloatArray:
    """Return L with L L' the covariance, which may be singular."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    found: FloatArray = vectors * np.sqrt(np.clip(values, 0.0, None))
    return found
