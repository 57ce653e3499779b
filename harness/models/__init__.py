"""What fitted models have in common: estimates with deviations, predictive distributions, LQR on them.

Imports the ground floor only.
"""
