"""What a finished closed loop left over, learned as a force without a name: labelled, with its hull, exportable."""

from harness.learned.residual import LearnedResidual, learn_residual

__all__ = ["LearnedResidual", "learn_residual"]
