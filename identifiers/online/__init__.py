"""Identifiers that learn along the stream, and the baselines that every table has.

May import ``identifiers.common`` and ``identifiers.mechanics``. Add one with ``init``, ``predict`` and ``update``
(:class:`harness.protocols.OnlineIdentifier`).
"""
