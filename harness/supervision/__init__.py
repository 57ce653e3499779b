"""Processes of this machine: guarded work, workers, what a child may leave behind, Ctrl-C.

Imports the ground floor only. ``guarded`` runs a call in a process of its own, ``workers`` prepares those of a table
of jobs.
"""
