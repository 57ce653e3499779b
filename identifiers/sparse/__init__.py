"""Sparse regression: STLSQ, LASSO and best subsets over libraries of functions.

May import ``identifiers.common``. Add a selection rule in ``selection``.
"""
