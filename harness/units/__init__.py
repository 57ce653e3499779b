"""Units as text: read in bounded time (``grammar``), and converted once, at the border, with pint (``conversion``)."""

from harness.units.conversion import base_units, convert, fits, is_unit, refuse_two_readings

__all__ = ["base_units", "convert", "fits", "is_unit", "refuse_two_readings"]
