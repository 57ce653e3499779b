"""Times as tables hold them: dates and times of day in words, counters that begin anew; imports nothing of `data`."""

from __future__ import annotations
