"""The ``sysid`` command: words, options and printing; what it does is in :mod:`harness.api`.

``app`` puts the commands together, ``loop``, ``models`` and ``runs`` hold them, ``options`` what they share,
``terminal`` prints.
"""
