"""Fits of the parameters of a system: output error over windows, maximum likelihood, residual forces.

May import all other rooms of physics but ``arms``.
"""
