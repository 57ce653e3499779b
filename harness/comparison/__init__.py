"""The day-one tools: models side by side on one data set, the frequency response in the data, the order they need."""

from __future__ import annotations

from harness.comparison.models import Compared, Comparison, compare
from harness.comparison.orders import OrderSelection, arx_orders, order_selection
from harness.comparison.reports import ReportComparison, compare_reports
from harness.comparison.residuals import Correlation, correlations
from harness.comparison.responses import Response, response
from harness.comparison.spectra import Spectrum, spectrum

__all__ = [
    "Compared",
    "Comparison",
    "Correlation",
    "OrderSelection",
    "ReportComparison",
    "Response",
    "Spectrum",
    "arx_orders",
    "compare",
    "compare_reports",
    "correlations",
    "order_selection",
    "response",
    "spectrum",
]
