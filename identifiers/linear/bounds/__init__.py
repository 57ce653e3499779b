"""Bounds for finite samples beside what was measured: regressions, responses, realisations.

May import the other linear identifiers. A newcomer adds a theorem beside the one it improves.
"""
