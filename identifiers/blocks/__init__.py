"""Block-structured models: linear dynamics around a static curve, or with hysteresis inside.

May import ``identifiers.common`` and ``identifiers.linear``, whose models they start from. A new structure is a file of
its own, named by its method.
"""
