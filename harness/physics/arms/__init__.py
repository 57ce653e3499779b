"""Arms from URDF: trees of bodies, regressors, inertial parameters, written back.

May import ``definition``, ``compiled`` and ``lumped``.
"""
