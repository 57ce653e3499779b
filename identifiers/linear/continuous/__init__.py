"""Transfer functions in continuous time, from frequency responses and from sampled records.

May import the other linear identifiers. A newcomer adds a criterion beside ``response_fit`` and ``record_fit``.
"""
