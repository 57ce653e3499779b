"""Truths: what is hidden in a simulated record, and the C code that simulates it.

``simulation`` runs ``truth.c``; ``hidden`` draws the laws of the dictionary, ``hardware`` those of another formulation,
``disturbances`` what comes beside them, and ``applied`` puts around an engine what it does not have. Imports no other
room of the laboratory.
"""
