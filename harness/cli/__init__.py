"""The ``sysid`` command: words, options and printing; what it does is in :mod:`harness.api`.

``app`` puts the commands together, ``loop``, ``models``, ``runs`` and others hold them, ``options`` what they share;
``words`` reads what is typed, ``results`` prints what was found, ``terminal`` is what both write to.
"""
