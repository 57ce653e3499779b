"""Models that switch: affine pieces with their regions, jumps of the state where a guard is met.

A new method goes into a file of its own; imports :mod:`identifiers.common`, and trees of :mod:`identifiers.learned`.
"""
