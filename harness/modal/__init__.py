"""Modes as an engineer reads them: frequencies, damping and shapes with intervals, and what the data determine.

:func:`identify_modes` fits a ladder of orders, keeps the poles that stay where they are from one order to the next, and
says of everything else that the data do not determine it. The subspace fit of its own gives every pole its covariance;
models of registered identifiers are asked through :mod:`harness.registry`, and get theirs by leaving out stretches.
This room may import the contracts and the registry; it knows no identifier by import.
"""

from __future__ import annotations

from harness.modal.modes import identify_modes
from harness.modal.poles import Mode, Pole, mac
from harness.modal.result import Modes, Undetermined
from harness.modal.stabilisation import Criteria

__all__ = ["Criteria", "Mode", "Modes", "Pole", "Undetermined", "identify_modes", "mac"]
