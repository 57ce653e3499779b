"""Models whose equations are known: lumped and inertial parameters, grey boxes, filters, residual physics.

May import ``identifiers.common``; the equations come from ``harness.physics``. Add a method as one file, its entry
point in ``pyproject.toml``.
"""
