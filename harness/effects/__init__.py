"""The dictionary of physical effects: blocks that a scenario hides in a plant and that the loop adds to a model."""

from __future__ import annotations

from harness.effects.along import Signals
from harness.effects.columns import ColumnBlock, column_blocks, motion_sizes
from harness.effects.compose import compose, recommended_substeps
from harness.effects.dictionary import Confusions, Dictionary, builtin, find
from harness.effects.effect import Effect, EffectParameter, Placed, effect, par
from harness.effects.places import fits, obstacle, place_all, port_of
from harness.effects.sampled import DelayLine, delay, quantise
from harness.effects.wrap import WrappedPlant
from harness.resolution import QuantisationTest, quantisation_test

__all__ = [
    "ColumnBlock",
    "Confusions",
    "DelayLine",
    "Dictionary",
    "Effect",
    "EffectParameter",
    "Placed",
    "QuantisationTest",
    "Signals",
    "WrappedPlant",
    "builtin",
    "column_blocks",
    "compose",
    "delay",
    "effect",
    "find",
    "fits",
    "motion_sizes",
    "obstacle",
    "par",
    "place_all",
    "port_of",
    "quantisation_test",
    "quantise",
    "recommended_substeps",
]
