"""What a reader sees of a benchmark: tables, plots, the page, exports.

May import the rows of ``harness.benchmark``; nothing there imports it but ``running``.
"""
