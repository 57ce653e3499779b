"""dataset.toml and what stands for it: the declaration, the plan worked out from it, the records that come of it.

May import the other rooms of data. Add a key in ``harness.data.sections``.
"""
