"""The day-one tools: models side by side on one data set, and the frequency response that the data themselves show."""

from __future__ import annotations

from harness.comparison.models import Compared, Comparison, compare
from harness.comparison.residuals import Correlation, correlations
from harness.comparison.spectra import Spectrum, spectrum

__all__ = ["Compared", "Comparison", "Correlation", "Spectrum", "compare", "correlations", "spectrum"]
