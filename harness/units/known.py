"""Units that are measured: a library of units knows pecks and carats too, and makes femtofermis of any letters."""

from __future__ import annotations

PREFIXED = frozenset(
    "meter gram second ampere kelvin mole candela radian steradian hertz newton pascal joule watt coulomb volt farad "
    "ohm siemens weber tesla henry lumen lux becquerel gray sievert katal liter bar volt_ampere watt_hour ampere_hour "
    "electron_volt calorie force_gram degree arcsecond revolutions_per_minute turn gauss poise stokes "
    "standard_gravity meter_H2O meter_Hg torr Nm count inch metric_ton molar strain Amp Amps amp amps Newton".split()
)
"""Names, as pint has them, before which people write a prefix."""

PLAIN = frozenset(
    "minute hour day week month year foot yard mile nautical_mile micron angstrom thou hectare "
    "metric_ton ton pound ounce slug force_kilogram force_pound force_ounce kip dyne poundal "
    "pound_force_per_square_inch kip_per_square_inch standard_atmosphere technical_atmosphere inch_H2O inch_Hg "
    "foot_H2O water mercury erg british_thermal_unit horsepower metric_horsepower "
    "degree_Celsius degree_Fahrenheit degree_Rankine delta_degree_Celsius delta_degree_Fahrenheit "
    "arcminute milliarcsecond grade revolutions_per_second mile_per_hour kilometer_per_hour kilometer_per_second "
    "meter_per_second foot_per_second counts_per_second knot gallon cubic_centimeter cubic_feet cubic_foot "
    "oersted maxwell percent permille ppm bit pixel tick lsb LSB "
    "decibel decibelmilliwatt decibelmicrowatt decibelwatt decibelvolt bel neper octave decade "
    "astronomical_unit inlb ftlb "
    "Nmm Ncm Nms Vs rev revs Kg KG million kp kmph kmh lbs kts rads".split()
)
"""Names before which nobody writes one."""

PREFIXES = frozenset("femto pico nano micro milli centi deci deca hecto kilo mega giga tera".split())
"""Those that measured values have: others make units of what stands for something else (%RH is no ronnahenry)."""


def is_known(prefix: str, name: str) -> bool:
    """Return True if a unit, as pint takes a text apart, is one that is measured.

    Examples
    --------
    >>> is_known("kilo", "meter"), is_known("", "foot"), is_known("milli", "year"), is_known("", "peck")
    (True, True, False, False)
    """
    if not prefix:
        return name in PREFIXED or name in PLAIN
    if name == "second" and prefix in ("deca", "hecto", "kilo", "mega", "giga", "tera"):
        return False  # Gs is a gauss, and whoever writes Ms means milliseconds
    return prefix in PREFIXES and name in PREFIXED


def is_with_seconds(text: str, symbol: str) -> bool:
    """Return True if a text is the symbol of a unit with an s behind it: mPas is no plural of mPa.

    Examples
    --------
    >>> is_with_seconds("mPas", "mPa"), is_with_seconds("volts", "V"), is_with_seconds("rads", "rad")
    (True, False, False)
    """
    return text.lower() == f"{symbol}s".lower() and (len(symbol) < 3 or not symbol.islower())
