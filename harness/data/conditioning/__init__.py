"""What is done to records, and looked for in them, before anything is fitted: time axes, decimation, trends, doubts.

Imports no other room of data but the declarations of ``harness.data.sections``.
"""
