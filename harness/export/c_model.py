"""A system as the sources of a co-simulation FMU: model.c and modelDescription.xml for the glue in harness.fmi."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np

from harness.errors import refuse_unknown
from harness.export.describe import FmuVariable, describe, xml_text

if TYPE_CHECKING:
    from harness.physics.compiled.simulator import Simulator


def model_source(simulator: Simulator, given: Collection[str] = ()) -> str:
    """Return model.c: the simulator's own step, with its delays and quantisers.

    The variables stand in the array v in the order of :func:`description`: time, inputs, outputs, states,
    parameters; behind them the memory of the delays. With communication steps of the simulator's sample time the FMU
    repeats its roll-outs. What a delayed sensor tells of the time before the first sample is the first reading.

    A hidden state of an effect starts where the effect says, from the input of the first step, unless its start value
    was set by the client or is in ``given`` (names of states).
    """
    from harness.physics.compiled.ccode import system_source

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
    hidden = system.states[system.nx - system.hidden_count :]
    ring = max(64, 4 * int(np.ceil(max(longest, default=0.0) / simulator.dt)) + 4)
    rings = len(delays) + len(late)
    lines = [
        f"/* {system.name}{''.join(f' + {effect}' for effect in system.effects)}: written by sysid-harness. */",
        *(f"/* {remark.replace('*/', '* /')} */" for remark in system.remarks),
        system_source(system, "model"),
        f"enum {{ U = {inputs}, Y = {outputs}, X = {states}, P = {parameters}, Z = P - MODEL_NZ, RING = {ring},",
        "  COUNT = VARIABLES, SUBSTEP, SEEN, OWN = SEEN + MODEL_NU, LINES = OWN + MODEL_NZ,",
        f"  MEMORY = 2 + MODEL_NU + MODEL_NZ + {rings} * RING }};",
        f"static const double SAMPLE = {simulator.dt!r};",
        f"enum {{ SUBSTEPS = {simulator.substeps} }};",
        "/* hidden states whose start values were chosen when this file was written */",
        f"static const char GIVEN[] = {{ {', '.join([*('01'[c.name in given] for c in hidden), '0'])} }};",
        DELAY,
        *([_WITHIN] if delays else []),
        _HIDDEN,
        "static const char *check(const double *v)",
        "{",
        *(f"    {line}" for line in _checks(simulator, parameters, [place for _, place in [*delays, *late]])),
        "    (void)v;",
        "    return NULL;",
        "}",
        "",
        "static void prepare(double *v)",
        "{",
        "    for (int i = 0; i < MODEL_NZ; i++) v[OWN + i] = GIVEN[i] || v[Z + i] != START[Z + i];",
        "    hidden_start(v);",
        "    v[COUNT] = v[SUBSTEP] = 0;",
        "}",
        "",
        "static double internal_step(const double *v) { (void)v; return SAMPLE / SUBSTEPS; }",
        "",
        "static void advance(double *v, double h)",
        "{",
        "    if (v[SUBSTEP] == 0) { /* a new sample: what the delays remember moves on */",
        "        if (v[COUNT] == 0) hidden_start(v);",
        "        for (int i = 0; i < MODEL_NU; i++) v[SEEN + i] = v[U + i];",
    ]
    if late:
        lines += ["        double y[MODEL_NY];", "        model_output(v + X, v + SEEN, v + P, v, y);"]
    lines += [f"        push(v, {number}, v[{place}]);" for number, (place, _) in enumerate(delays)]
    lines += [f"        push(v, {number}, y[{column}]);" for number, (column, _) in enumerate(late, start=len(delays))]
    delayed_columns = {column for column, _ in blocks.input_delays}
    fresh = [column for column in range(system.nu) if column not in delayed_columns]
    lines += [
        "        v[COUNT] += 1;",
        "    }",
        *(
            f"    v[{place}] = within(v, {number}, v[{parameter}]); /* a held input changes within a sample */"
            for number, (place, parameter) in enumerate(delays)
        ),
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
            lines.append(f"    v[Y + {column}] = late(v, {number}, v[{parameters + place}], v[Y + {column}]);")
            number += 1
    return "\n".join([*lines, "}", ""])


def description(simulator: Simulator, parameters: Mapping[str, float], x0: Mapping[str, float] | None = None) -> str:
    """Return modelDescription.xml for FMI 2.0 (that for FMI 3.0 is derived from it).

    Raises InputError if a parameter or state is unknown.

    - ``parameters``: values of the system's parameters: the start values of the FMU's tunable parameters
    - ``x0``: start values of the states; 0 where not given
    """
    system = simulator.system
    values = system.values(parameters)
    starts = dict.fromkeys((channel.name for channel in system.states), 0.0)
    refuse_unknown("initial state", x0 or (), starts)
    for name, value in (x0 or {}).items():
        starts[name] = value
    variables = [FmuVariable(channel.name, "input", channel.unit) for channel in system.inputs]
    variables += [FmuVariable(channel.name, "output", channel.unit) for channel in system.outputs]
    variables += [FmuVariable(f"state.{c.name}", "state", c.unit, float(starts[c.name])) for c in system.states]
    variables += [
        FmuVariable(
            parameter.name,
            "parameter",
            parameter.unit,
            float(values[parameter.name]),
            parameter.minimum,
            parameter.maximum,
        )
        for parameter in system.parameters
    ]
    token = hashlib.sha256(f"{model_source(simulator, x0 or ())}{values}{starts}".encode()).hexdigest()[:32]
    direct = range(system.nu) if system.feedthrough else ()
    root = describe(
        system.name,
        "; ".join([str(system), *system.remarks]),
        token,
        variables,
        sample_time=simulator.dt,
        direct=direct,
    )
    return xml_text(root)


def _checks(simulator: Simulator, first: int, delays: list[int]) -> list[str]:
    """Return the lines of check(): bounds of the parameters, and delays that the memory can hold."""
    lines = []
    for place, parameter in enumerate(simulator.system.parameters, start=first):
        if np.isfinite(parameter.minimum):
            lines.append(
                f'if (!(v[{place}] >= {parameter.minimum!r})) return "{parameter.name} is below {parameter.minimum:g}";'
            )
        if np.isfinite(parameter.maximum):
            lines.append(
                f'if (!(v[{place}] <= {parameter.maximum!r})) return "{parameter.name} is above {parameter.maximum:g}";'
            )
    lines += [f'if (!(v[{p}] <= (RING - 2) * SAMPLE)) return "a delay is beyond the memory";' for p in delays]
    return lines


_HIDDEN = """
/* Hidden states of effects start where the effect says, unless their start values were set. */
static void hidden_start(double *v)
{
    double z[MODEL_NZ + 1];
    if (!MODEL_NZ) return;
    model_initial(v + X, v + U, v + P, z);
    for (int i = 0; i < MODEL_NZ; i++)
        if (!v[OWN + i]) v[Z + i] = z[i];
}
"""

DELAY = """
/* Delay lines on samples: the newest value of line i stands at slot (count mod RING). */
static inline void push(double *v, int line, double value)
{
    double *ring = v + LINES + line * RING;
    if (v[COUNT] == 0) /* before the first sample the signal stood still */
        for (int i = 0; i < RING; i++) ring[i] = value;
    ring[(long)v[COUNT] % RING] = value;
}

/* (1 - f) s[k - n] + f s[k - n - 1] with delay = (n + f) SAMPLE; s[k] is not in the line yet: it is now. */
static inline double late(const double *v, int line, double delay, double now)
{
    const double *ring = v + LINES + line * RING, steps = delay > 0 ? delay / SAMPLE : 0;
    const long n = (long)steps, k = (long)v[COUNT];
    double s[2];
    for (int i = 0; i < 2; i++) {
        const long back = n + i;
        if (back == 0 || k == 0) s[i] = now;
        else s[i] = ring[((k - back) % RING + RING) % RING];
    }
    return (1 - (steps - n)) * s[0] + (steps - n) * s[1];
}
"""

_WITHIN = """
/* The mean over a substep of a held input that is late: substeps count from the last sample that was pushed. */
static inline double within(const double *v, int line, double delay)
{
    const double *ring = v + LINES + line * RING, steps = delay > 0 ? delay / SAMPLE * SUBSTEPS : 0;
    const long n = (long)steps, k = (long)v[COUNT] - 1, j = (long)v[SUBSTEP];
    double s[2];
    for (int i = 0; i < 2; i++) {
        const long ago = n + i - j, back = ago > 0 ? (ago + SUBSTEPS - 1) / SUBSTEPS : 0;
        s[i] = ring[((k - back) % RING + RING) % RING];
    }
    return (1 - (steps - n)) * s[0] + (steps - n) * s[1];
}
"""
