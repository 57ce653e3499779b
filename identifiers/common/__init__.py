"""What every family of identifiers stands on.

Records and their lags, regression with its scaling and its judgement of the data, criteria of order, state observers,
the linear state-space model that most fits return, compiled kernels. It imports no other family. A newcomer adds a
piece here when two families need it, and not before.
"""
