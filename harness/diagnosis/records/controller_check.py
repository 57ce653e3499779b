"""Records that show a controller: an input that follows from the outputs tells nothing of what inputs do."""

from __future__ import annotations

from harness.diagnosis.records.columns_check import Doubt
from harness.diagnosis.systems import AnySystem
from harness.judgement import law_of
from harness.signals import Dataset


def check_controller(dataset: Dataset, system: AnySystem) -> list[Doubt]:
    """Return a doubt where an input of the estimation records is nothing but the answer of a controller.

    A model that takes all of itself from the records, as ``linear`` does, is then that controller turned round (gain
    ``-1/K``), however well it fits: the doubt is certain. Declared physics, whose parameters the motion can tell, is
    only warned of: whatever force nobody measured went through the controller too (Ljung 1999, sec. 13.4).

    Parameters
    ----------
    dataset : Dataset
    system : System
        The nominal model.
    """
    if getattr(system, "feedthrough", False):  # an output that answers at once gives its input away, controller or not
        return []
    law = law_of(dataset.estimation)
    if law is None:
        return []
    words = f"these data show the controller: {law.text} up to {law.departure:.1e} of full size"
    remedy = (
        "add an excitation to what the controller commands, and record that; if the reading takes up the input within "
        "the sample (crosstalk), declare feedthrough = true"
    )
    if getattr(system, "starts", None) is not None:
        return [Doubt(f"{words}, and nothing beside it moves that input; {remedy}", certain=True)]
    told = f"what an unmeasured force did and what the input did cannot be told apart; {remedy}"
    return [Doubt(f"{words}, and nothing beside it moves that input: {told}", certain=False)]
