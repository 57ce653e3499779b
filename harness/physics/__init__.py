"""Physics: one symbolic definition of a model, from which everything else is derived.

Names are loaded when they are asked for: SymPy and CasADi take a moment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.extras import on_demand
from harness.physics.definition.parameters import Parameter

if TYPE_CHECKING:
    from harness.physics import models
    from harness.physics.compiled.simulator import Simulator
    from harness.physics.compiled.system import BodyTerm, Coordinate, Hidden, Port, SampledBlock, System
    from harness.physics.fitting.output_error import OutputErrorFit, fit_output_error, simulate_error
    from harness.physics.lumps.lumped_model import LumpedFit, LumpedModel, lumped
    from harness.physics.models import load_model
    from harness.physics.symbolic.equation_text import equations
    from harness.physics.symbolic.mechanism import Mechanism
    from harness.physics.symbolic.ode import Ode

__all__ = [
    "BodyTerm",
    "Coordinate",
    "Hidden",
    "LumpedFit",
    "LumpedModel",
    "Mechanism",
    "Ode",
    "OutputErrorFit",
    "Parameter",
    "Port",
    "SampledBlock",
    "Simulator",
    "System",
    "equations",
    "fit_output_error",
    "load_model",
    "lumped",
    "models",
    "simulate_error",
]

_WHERE = {
    "BodyTerm": "compiled.system",
    "Coordinate": "compiled.system",
    "Hidden": "compiled.system",
    "Port": "compiled.system",
    "SampledBlock": "compiled.system",
    "System": "compiled.system",
    "LumpedFit": "lumps.lumped_model",
    "LumpedModel": "lumps.lumped_model",
    "lumped": "lumps.lumped_model",
    "Mechanism": "symbolic.mechanism",
    "Ode": "symbolic.ode",
    "OutputErrorFit": "fitting.output_error",
    "fit_output_error": "fitting.output_error",
    "simulate_error": "fitting.output_error",
    "Simulator": "compiled.simulator",
    "equations": "symbolic.equation_text",
    "load_model": "models",
    "models": "",
}

__getattr__ = on_demand(__name__, _WHERE)
