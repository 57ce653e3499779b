"""What is odd about records: found by stated tests at stated rates, shown, and kept out of the fits.

==============  ======================================================================================================
``spike``       readings that the rows before and after contradict; rows of an input that no output felt
``word``        the same with one value again and again: 0, -1, 9999
``held``        readings that only repeat: a sensor slower than its record
``stuck``       a stretch without a change
``filled``      readings on straight lines between others: a log that was filled in, or brought to a faster clock
``filtered``    readings that went through a filter: a mean over some rows, a digital low-pass
``rail``        readings that rest at their largest or smallest value
``leap``        rows that were lost, or one written twice, of which the clock shows nothing; a sensor that slipped
``dropout``     a stretch of an input that holds a word for nothing, and that no output felt
``hum``         a line above the motion that no input has
``burst``       a stretch in which a sensor scatters more than elsewhere
``shift``       an input that was written a row late (found with the equations of motion)
``between``     an input that moves between its readings where it passed for held (found so too)
``mismatch``    runs of one use that follow two models
``step``, ``slow``, ``fast``, ``trend``, ``crosstalk``
                no faults: the step of an encoder, sampling beside the pace of the motion, a drift, an output that holds
                the inputs of the same row
==============  ======================================================================================================

Inputs that switch between levels, rest at a rail or jump are meant so: nothing is said of them.
"""

from harness.data.oddities.examine import examined, lines
from harness.data.oddities.numbers import ODD, described
from harness.data.oddities.page import DataCheck, odd_pictures, oddities_data

__all__ = ["ODD", "DataCheck", "described", "examined", "lines", "odd_pictures", "oddities_data"]
