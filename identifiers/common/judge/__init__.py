"""One judge of what an identifier answers, as :mod:`harness.judgement` is of the records that it is given.

``told`` asks, ``loops`` and ``own_record`` find; identifiers put :func:`~identifiers.common.judge.told.told` on their
``fit``. May import the other files of ``identifiers.common``.
"""
