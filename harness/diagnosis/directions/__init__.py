"""Directions of the score test: how a law, or a force without a name, moves the outputs along a smoothed record."""
