"""Units as text: read in bounded time (``grammar``), and converted once, at the border, with pint (``conversion``)."""

from harness.units.conversion import base_units, convert, factors_of, fits, is_unit, refuse_two_readings, told
from harness.units.grammar import behind, product, quotient

__all__ = [
    "base_units",
    "behind",
    "convert",
    "factors_of",
    "fits",
    "is_unit",
    "product",
    "quotient",
    "refuse_two_readings",
    "told",
]
