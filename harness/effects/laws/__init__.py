"""The laws: one function each, with its unit, formula, relatives and the experiment that tells it.

Imports ``harness.effects.effect`` and ``functions`` only. Add a law as one function in the file of its family, with
its entry point in ``pyproject.toml`` and a line in the tests' list of names.
"""
