"""Linear models of lifted states: extended DMD with control.

May import ``identifiers.common`` and ``identifiers.linear.least_squares``. Add a dictionary of observables in
``identifiers.common.library``.
"""
