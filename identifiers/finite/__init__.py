"""Finite processes: counting, factored transitions, hidden Markov models, beliefs, bisimulation.

May import ``identifiers.common``. Add a method as one file, its entry point in ``pyproject.toml``.
"""
