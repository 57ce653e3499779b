"""Data in the frequency domain: frequency responses with their variance, from files, from spectra, from arrays.

Imports the ground floor only; transfer functions are fitted to them in ``identifiers/linear/continuous``. A newcomer
adds a form of file in :mod:`harness.frequency.files`.
"""

from harness.frequency.data import FrequencyResponse
from harness.frequency.files import is_response, read_response, write_response

__all__ = ["FrequencyResponse", "is_response", "read_response", "write_response"]
