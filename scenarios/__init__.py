"""Scenarios: excitation, feedback, noise and the suites that combine them."""
