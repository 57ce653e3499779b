"""The catalogue of nominal models.

``catalogue`` has the mechanical ones, ``flight`` and ``tanks`` others. Add a model as a function that returns a
mechanism or an ODE, with its entry point in ``pyproject.toml``.
"""

from __future__ import annotations

from harness.physics.models.catalogue import *  # noqa: F403
from harness.physics.models.catalogue import __all__ as __all__
