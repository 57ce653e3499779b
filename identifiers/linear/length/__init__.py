"""How long a record must be for an accuracy that is asked: what is wanted of a model, its information, the length.

May import the other linear identifiers. A newcomer adds what can be asked for in ``quantities``.
"""
