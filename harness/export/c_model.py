"""A system as the sources of a co-simulation FMU: model.c and modelDescription.xml for the glue in harness.fmi."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from harness.errors import InputError

if TYPE_CHECKING:
    from harness.physics.simulator import Simulator

__all__ = ["description", "model_source"]


def model_source(simulator: Simulator) -> str:
    """Return model.c: the simulator's own step, with its delays and quantisers.

    The variables stand in the array v in the order of :func:`description`: time, inputs, outputs, states,
    parameters; behind them the memory of the delays. With communication steps of the simulator's sample time the FMU
    repeats its roll-outs.
    """
    from harness.physics.ccode import system_source

    system = simulator.system
    inputs = 1
    outputs = inputs + system.nu
    states = outputs + system.ny
    parameters = states + system.nx
    blocks = simulator.sampled
    delays = [(f"SEEN + {column}", parameters + place) for column, place in blocks.input_delays]
    late = [(column, parameters + place) for kind, column, place in blocks.output_blocks if kind == "output_delay"]
    values = system.vector()
    longest = [values[place] for _, place in blocks.input_delays] + [values[place - parameters] for _, place in late]
    ring = max(64, 4 * int(np.ceil(max(longest, default=0.0) / simulator.dt)) + 4)
    rings = len(delays) + len(late)
    lines = [
        f"/* {system.name}{''.join(f' + {effect}' for effect in system.effects)}: written by sysid-harness. */",
        system_source(system, "model"),
        f"enum {{ U = {inputs}, Y = {outputs}, X = {states}, P = {parameters}, RING = {ring},",
        "  COUNT = VARIABLES, SUBSTEP, SEEN, LINES = SEEN + MODEL_NU,",
        f"  MEMORY = 2 + MODEL_NU + {rings} * RING }};",
        f"static const double SAMPLE = {simulator.dt!r};",
        f"enum {{ SUBSTEPS = {simulator.substeps} }};",
        _DELAY,
        "static const char *check(const double *v)",
        "{",
        *(f"    {line}" for line in _checks(simulator, parameters, [place for _, place in [*delays, *late]])),
        "    (void)v;",
        "    return NULL;",
        "}",
        "",
        "static void prepare(double *v)",
        "{",
        "    if (MODEL_NZ) model_initial(v + X, v + U, v + P, v + X + MODEL_NX - MODEL_NZ);",
        "    v[COUNT] = v[SUBSTEP] = 0;",
        "}",
        "",
        "static double internal_step(const double *v) { (void)v; return SAMPLE / SUBSTEPS; }",
        "",
        "static void advance(double *v, double h)",
        "{",
        "    if (v[SUBSTEP] == 0) { /* a new sample: what the delays remember moves on */",
        "        for (int i = 0; i < MODEL_NU; i++) v[SEEN + i] = v[U + i];",
    ]
    if late:
        lines += ["        double y[MODEL_NY];", "        model_output(v + X, v + SEEN, v + P, v, y);"]
    lines += [
        f"        push(v, {number}, v[{place}]); v[{place}] = late(v, {number}, v[{parameter}], 1, 0);"
        for number, (place, parameter) in enumerate(delays)
    ]
    lines += [f"        push(v, {number}, y[{column}]);" for number, (column, _) in enumerate(late, start=len(delays))]
    delayed_columns = {column for column, _ in blocks.input_delays}
    fresh = [column for column in range(system.nu) if column not in delayed_columns]
    lines += [
        "        v[COUNT] += 1;",
        "    }",
        "    v[SUBSTEP] = v[SUBSTEP] + 1 < SUBSTEPS ? v[SUBSTEP] + 1 : 0;",
        *(f"    v[SEEN + {column}] = v[U + {column}];" for column in fresh),
        "    model_step(v + X, v + SEEN, v + P, v[V_time], h);",
        "}",
        "",
        "static void evaluate(double *v)",
        "{",
        "    double u[MODEL_NU + 1];",
        "    for (int i = 0; i < MODEL_NU; i++) u[i] = v[U + i];",
        "    model_output(v + X, u, v + P, v, v + Y);",
    ]
    number = len(delays)
    for kind, column, place in blocks.output_blocks:
        if kind == "quantise":
            step = f"v[{parameters + place}]"
            lines.append(f"    if ({step} > 0) v[Y + {column}] = rint(v[Y + {column}] / {step}) * {step};")
        else:
            lines.append(f"    v[Y + {column}] = late(v, {number}, v[{parameters + place}], 0, v[Y + {column}]);")
            number += 1
    return "\n".join([*lines, "}", ""])


def description(simulator: Simulator, parameters: Mapping[str, float], x0: Mapping[str, float] | None = None) -> str:
    """Return modelDescription.xml for FMI 2.0 (that for FMI 3.0 is derived from it).

    Parameters
    ----------
    simulator : Simulator
    parameters : mapping
        Values of the system's parameters: the start values of the FMU's tunable parameters.
    x0 : mapping, optional
        Start values of the states; 0 where not given.

    Raises
    ------
    InputError
        If a parameter or state is unknown.
    """
    system = simulator.system
    values = system.values(parameters)
    starts = dict.fromkeys((channel.name for channel in system.states), 0.0)
    for name, value in (x0 or {}).items():
        if name not in starts:
            raise InputError(
                "initial state",
                expected=f"one of {', '.join(starts)}",
                got=repr(name),
                remedy="correct the name",
            )
        starts[name] = value
    source = model_source(simulator)
    token = hashlib.sha256(f"{source}{values}".encode()).hexdigest()[:32]
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=system.name,
        guid=f"{{{token}}}",
        description=str(system),
        generationTool="sysid-harness",
        variableNamingConvention="flat",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier(system.name),
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    variables: list[tuple[dict[str, str], dict[str, str]]] = []
    for channel in system.inputs:
        variables.append(({"name": channel.name, "causality": "input"}, {"unit": channel.unit, "start": "0"}))
    for channel in system.outputs:
        variables.append(
            ({"name": channel.name, "causality": "output", "initial": "calculated"}, {"unit": channel.unit})
        )
    for channel in system.states:
        variables.append(
            (
                {"name": f"state.{channel.name}", "causality": "local", "initial": "exact"},
                {"unit": channel.unit, "start": repr(float(starts[channel.name]))},
            )
        )
    for one in system.parameters:
        numbers = {"unit": one.unit, "start": repr(float(values[one.name]))}
        if np.isfinite(one.minimum):
            numbers["min"] = repr(one.minimum)
        if np.isfinite(one.maximum):
            numbers["max"] = repr(one.maximum)
        variables.append(({"name": one.name, "causality": "parameter", "variability": "tunable"}, numbers))
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys([*(numbers["unit"] for _, numbers in variables), "s"]):
        units.append(_unit(unit))
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize=repr(simulator.dt))
    listed = ElementTree.SubElement(root, "ModelVariables")
    for reference, (attributes, numbers) in enumerate(variables, start=1):
        attributes.setdefault("variability", "continuous")
        node = ElementTree.SubElement(listed, "ScalarVariable", attributes, valueReference=str(reference))
        ElementTree.SubElement(node, "Real", numbers)
    structure = ElementTree.SubElement(root, "ModelStructure")
    if system.outputs:
        outputs = ElementTree.SubElement(structure, "Outputs")
        unknowns = ElementTree.SubElement(structure, "InitialUnknowns")
        direct = " ".join(str(1 + i) for i in range(system.nu)) if system.feedthrough else ""
        for i in range(system.ny):
            index = str(1 + system.nu + i)
            ElementTree.SubElement(outputs, "Unknown", index=index, dependencies=direct)
            ElementTree.SubElement(unknowns, "Unknown", index=index)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def identifier(name: str) -> str:
    """Return a C identifier for a model's name.

    Examples
    --------
    >>> identifier("cart-pole")
    'cart_pole'
    """
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return text if text and not text[0].isdigit() else f"m_{text}"


def _unit(unit: str) -> ElementTree.Element:
    """Return the definition of a unit in the base units that FMI knows (FMI 2.0.5, sec. 2.2.2)."""
    from harness.units import base_units

    node = ElementTree.Element("Unit", name=unit)
    base, factor, offset = base_units(unit)
    attributes = {name: str(power) for name, power in base.items() if power == int(power)}
    if len(attributes) == len(base):
        if factor != 1.0:
            attributes["factor"] = repr(factor)
        if offset != 0.0:
            attributes["offset"] = repr(offset)
        ElementTree.SubElement(node, "BaseUnit", attributes)
    return node


def _checks(simulator: Simulator, first: int, delays: list[int]) -> list[str]:
    """Return the lines of check(): bounds of the parameters, and delays that the memory can hold."""
    lines = []
    for place, one in enumerate(simulator.system.parameters, start=first):
        if np.isfinite(one.minimum):
            lines.append(f'if (!(v[{place}] >= {one.minimum!r})) return "{one.name} is below {one.minimum:g}";')
        if np.isfinite(one.maximum):
            lines.append(f'if (!(v[{place}] <= {one.maximum!r})) return "{one.name} is above {one.maximum:g}";')
    lines += [f'if (!(v[{p}] <= (RING - 2) * SAMPLE)) return "a delay is beyond the memory";' for p in delays]
    return lines


_DELAY = """
/* Delay lines on samples: the newest value of line i stands at slot (count mod RING). */
static inline void push(double *v, int line, double value)
{
    double *ring = v + LINES + line * RING;
    if (v[COUNT] == 0) /* before the first sample the signal stood still */
        for (int i = 0; i < RING; i++) ring[i] = value;
    ring[(long)v[COUNT] % RING] = value;
}

/* (1 - f) s[k - n] + f s[k - n - 1] with delay = (n + f) SAMPLE; s[k] is in the line already, or it is now. */
static inline double late(const double *v, int line, double delay, int pushed, double now)
{
    const double *ring = v + LINES + line * RING, steps = delay > 0 ? delay / SAMPLE : 0;
    const long n = (long)steps, k = (long)v[COUNT];
    double s[2];
    for (int i = 0; i < 2; i++) {
        const long back = n + i;
        if (!pushed && (back == 0 || k == 0)) s[i] = now;
        else s[i] = ring[((k - back) % RING + RING) % RING];
    }
    return (1 - (steps - n)) * s[0] + (steps - n) * s[1];
}
"""
