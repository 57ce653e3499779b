"""State-space models by maximum likelihood: prediction errors, the search, where it starts, orders by Schwarz's rule.

May import ``identifiers.common``. A new start is a function in ``starts``; a new noise model changes ``model``.
"""
