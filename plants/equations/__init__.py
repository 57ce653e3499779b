"""Plants given by their equations: mechanisms and ODEs of ``harness.physics``, linear systems, surrogates.

Add one in ``ode`` from a model of the catalogue.
"""
