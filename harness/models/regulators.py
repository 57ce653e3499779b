"""Regulators designed on identified models, and where they rely on what the data do not determine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.errors import InputError
from harness.models.determined import bands_of, outside
from harness.models.lqr import lqr_gain, reachable, spectral_radius, state_observable
from harness.models.spread import gains
from harness.signals import FloatArray

LOUD = 0.3  # A loop gain above this makes the closed loop what the model says; below it the plant does as it likes.
POINTS = 300  # Frequencies that are looked at.


@dataclass(frozen=True, eq=False)
class Regulator:
    """``u = -K x``, x the model's filtered state."""

    gain: FloatArray  # (nu, nx): K
    warnings: tuple[str, ...]  # What the design relies on though the data do not determine it
    # States that the inputs reach, and that the outputs show
    controllable: int
    observable: int

    def __str__(self) -> str:
        facts = f"{self.controllable} controllable and {self.observable} observable"
        return f"u = -K x of {self.gain.shape[1]} states, {facts}" + "".join(
            f"\nwarning: {one}" for one in self.warnings
        )


def regulator(model: Any, q: Any = None, r: Any = None) -> Regulator:
    """Return the LQR for ``sum y' q y + u' r u`` of a linear model, in deviations from its equilibrium.

    The loop gain is compared with the frequencies that the model's data determine (:mod:`harness.models.determined`).

    Raises InputError if the model cannot be stabilised.

    - ``q, r``: identities by default
    """
    a, b, c, _ = model.matrices
    ny, nu = c.shape[0], b.shape[1]
    weight = np.eye(ny) if q is None else np.atleast_2d(np.asarray(q, dtype=float))
    effort = np.eye(nu) if r is None else np.atleast_2d(np.asarray(r, dtype=float))
    facts = reachable(a, b), state_observable(a, c)
    gain = lqr_gain(a, b, c.T @ weight @ c, effort)
    if gain is None:
        raise InputError(
            "regulator of a model",
            expected="inputs that reach every mode that does not die out, weights that see it",
            got=f"{facts[0]} of {len(a)} states controllable, {facts[1]} observable, spectral radius "
            f"{spectral_radius(a):.4g}",
            remedy="identify with an input, or an output, that moves with it, or a model of lower order",
        )
    bands = bands_of(model)
    if bands is None:
        said = "the model does not say which frequencies its data determine"
        return Regulator(gain, (said,), *facts)
    step = model.spec.sample_time
    f = np.geomspace(1e-4, 0.5, POINTS) / step
    loop = gains((a, b, gain, np.zeros((nu, nu))), f, step)
    warnings = []
    for column, given in enumerate(model.spec.inputs):
        loud = np.linalg.norm(loop[:, :, column], axis=1) > LOUD
        for row, output in enumerate(model.spec.outputs):
            if not np.any(c[row]):
                continue
            blind = loud & outside(bands.get(f"{output.name} per {given.name}", []), f)
            if blind.any():
                low, high = f[blind][0], f[blind][-1]
                warnings.append(
                    f"the loop gain is above {LOUD:g} between {low:.3g} and {high:.3g} Hz, where the data do not "
                    f"determine {output.name} per {given.name}: excite the plant there, or weigh the input more"
                )
    return Regulator(gain, tuple(warnings), *facts)
