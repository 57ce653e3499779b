"""What a fit to data from a loop has to say: one judge of the answer, as :mod:`harness.judgement` is of the records.

May import the other files of ``identifiers.common``; identifiers put :func:`~identifiers.common.loops.judge.loop_told`
on their ``fit``.
"""
