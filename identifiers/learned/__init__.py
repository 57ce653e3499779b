"""Networks, Gaussian processes, forests, Volterra series: models without equations.

May import ``identifiers.common``. What needs torch says so by the extra ``learned``. Add a network as one file, its
training through ``training`` or ``lag_training``.
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "AttentionNetwork": "attention",
    "EmbedToControl": "embed",
    "GaussianProcess": "gaussian_process",
    "LagrangianNetwork": "lagrangian",
    "NeuralNetwork": "neural",
    "NeuralOutputError": "recurrent",
    "NeuralStateSpace": "neural_state",
    "PolynomialStateSpace": "polynomial_state_space",
    "RandomForest": "trees",
    "Volterra": "volterra",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
