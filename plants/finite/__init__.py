"""Finite Markov processes, fully observed and not.

Add one as a function that returns ``FiniteMdp`` or ``FinitePomdp``.
"""
