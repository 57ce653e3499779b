"""Calibration: the parameters of an FMU, or of a system of FMUs, that bring its free runs nearest to records.

``variables`` reads what can be free, ``runs`` simulates, ``search`` minimises, ``calibration`` says what came out,
``written`` hands the values on. A newcomer who wants another kind of model adds how its variables are read to
``variables``; it needs a plant with ``preset``. May import the rooms below ``harness.export`` and that one.
"""

from harness.calibration.calibration import Calibration
from harness.calibration.fitting import calibrate, ports_of_system

__all__ = ["Calibration", "calibrate", "ports_of_system"]
