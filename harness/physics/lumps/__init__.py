"""Lumped parameters: the regressor, its identifiable combinations, fits that are linear in them.

May import ``definition`` and ``compiled``.
"""
