"""Identifiers that learn along the stream, and the baselines that every table has.

May import ``identifiers.common`` and ``identifiers.mechanics``. Add one with ``init``, ``predict`` and ``update``
(:class:`harness.protocols.OnlineIdentifier`).
"""

from __future__ import annotations

from harness.extras import on_demand

_SHOWN = {
    "FollowTheLeader": "leader",
    "GradientDescent": "gradient_descent",
    "HoldLast": "baselines",
    "ParameterTrajectory": "parameter_trajectory",
    "RecursiveLeastSquares": "rls",
    "RecursiveLumped": "lumped_recursive",
    "RecursivePolynomial": "recursive_polynomial",
    "Redesign": "redesign",
    "RegretAlong": "regret_along",
    "SpectralFiltering": "spectral_filtering",
    "TrueModel": "baselines",
    "ekf": "filters_online",
    "recursion_along": "parameter_trajectory",
    "ukf": "filters_online",
}
__all__ = [*_SHOWN]
__getattr__ = on_demand(__name__, _SHOWN)
