"""A plant in a process of its own: what crashes or hangs there ends that process only.

``isolated`` is the plant that stands for it, ``child`` runs the other side, ``frames`` what passes between them.
"""
