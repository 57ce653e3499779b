"""How a model is written: mechanisms and ODEs in SymPy, split into terms affine in lumped parameters, and as text.

May import ``definition`` and ``compiled``, for the system that a model gives.
"""
