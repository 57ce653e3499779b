"""Impulse responses as Gaussian processes: kernels that decay and are smooth, their numbers from the data.

May import the other linear identifiers. A newcomer adds a kernel in ``kernels``.
"""
