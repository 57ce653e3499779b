"""Units as text: read in bounded time (``grammar``), converted once, at the border, with pint (``conversion``).

What a person is shown goes back into the units in which it was recorded (``own``).
"""

from harness.units.conversion import base_units, convert, factors_of, fits, is_unit, refuse_two_readings, told
from harness.units.grammar import behind, product, quotient
from harness.units.own import own_gains, own_record, own_unit, own_values

__all__ = [
    "base_units",
    "behind",
    "convert",
    "factors_of",
    "fits",
    "is_unit",
    "own_gains",
    "own_record",
    "own_unit",
    "own_values",
    "product",
    "quotient",
    "refuse_two_readings",
    "told",
]
