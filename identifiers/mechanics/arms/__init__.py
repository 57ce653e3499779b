"""Robots from their files: inertial parameters and how surely they are told, gravity at rest, calibration, contacts.

May import the other mechanical identifiers; trees of bodies come from ``harness.physics.arms``. Add an identifier or an
analysis as one file, its entry point in ``pyproject.toml``.
"""
