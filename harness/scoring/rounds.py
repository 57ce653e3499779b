"""Identification and control design in turns: what every round of data is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import FitError
from harness.models.lqr import CostRatio, lqr_cost_ratio, lqr_gain
from harness.protocols import Identifier
from harness.scoring.control import in_states
from harness.signals import FloatArray, Trajectory


@dataclass(frozen=True)
class RedesignRound:
    """One round: data under the controller so far, a new model, a new controller.

    Parameters
    ----------
    cost : CostRatio
        Of the new controller on the true plant; of the old one where the fit was refused.
    coverage : float
        Least singular value of all states and inputs so far, each scaled to rms 1: 1 covers all directions alike, 0
        leaves one out.
    refused : str
        Why the data were refused; empty where they were not.
    """

    cost: CostRatio
    coverage: float
    refused: str


def interleaved(
    identifier: Identifier,
    collect: Callable[[FloatArray, int], Trajectory],
    plant: tuple[FloatArray, FloatArray],
    first_gain: FloatArray,
    *,
    rounds: int = 5,
    q: FloatArray | None = None,
    r: FloatArray | None = None,
    rng: np.random.Generator,
) -> list[RedesignRound]:
    """Collect data under a controller, fit a model to all data so far, design the next controller; again.

    Parameters
    ----------
    identifier : Identifier
        Learns from measured states.
    collect : callable
        ``collect(gain (nu, nx), round) -> Trajectory`` runs the plant under ``u = -gain x`` and whatever excitation the
        caller adds.
    plant : (A, B)
        The truth about the equilibrium, for the cost.
    first_gain : array (nu, nx)
    rounds : int
    q, r : array, optional
        Weights of the LQR; identities by default.
    rng : numpy.random.Generator
    """
    nx, nu = np.shape(plant[1])
    q = np.eye(nx) if q is None else q
    r = np.eye(nu) if r is None else r
    gain, records = np.asarray(first_gain, dtype=float), []
    best = lqr_cost_ratio(plant, plant, q=q, r=r)
    found: list[RedesignRound] = []
    cost = CostRatio(float("nan"), "no design", float("nan"))
    for number in range(rounds):
        records.append(collect(gain, number))
        rows = np.concatenate([np.hstack([record.y, record.u]) for record in records])
        size = np.sqrt(np.mean(rows**2, axis=0))
        values = np.linalg.svd(rows / np.where(size > 0, size, 1.0), compute_uv=False)
        coverage = float(values[-1] / np.sqrt(len(rows)))
        try:
            model: Any = identifier.fit(records, rng=rng)
        except FitError as error:
            found.append(RedesignRound(cost, coverage, str(error)))
            continue
        a, b = in_states(model)
        new = lqr_gain(a, b, q, r)
        cost = lqr_cost_ratio((a, b), plant, q=q, r=r) if best.status == "ok" else cost
        if new is not None and cost.status == "ok":
            gain = new
        found.append(RedesignRound(cost, coverage, ""))
    return found
