"""Polynomial models of one output at a time: their coefficients, where a search begins, the search, its record.

May import ``identifiers.common`` and the realization of :mod:`identifiers.linear.ho_kalman`. A new structure is a way
to choose :class:`~identifiers.linear.polynomials.model.Orders`, and a start.
"""
