"""Networks, Gaussian processes, forests, Volterra series: models without equations.

May import ``identifiers.common``. What needs torch says so by the extra ``learned``. Add a network as one file, its
training through ``training`` or ``lag_training``.
"""
