"""A repaired FMU as one co-simulation: an SSP package of the FMU and of its effects, which are an FMU of their own.

The effects' FMU gets the command, the positions and rates and the raw outputs; it drives the inputs of the nominal FMU
and tells what the sensors would. At its own step, the sample time of the data or the part of it in which dry friction
is told, the package repeats the roll-outs of the report.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.errors import InputError
from harness.export.c_model import DELAY
from harness.export.describe import FmuVariable, describe, xml_text
from harness.export.packed import packed
from harness.export.system_structure import (
    Outer,
    WrittenComponent,
    WrittenConnection,
    WrittenPort,
    WrittenSystem,
    ports_of,
    write_structure,
)
from harness.parts.files import describe_fmu

if TYPE_CHECKING:
    from harness.blackbox.system import FmuSystem

NOMINAL, EFFECTS = "nominal", "effects"


def write_package(content: Mapping[str, Any], folder: Path, target: Path, *, version: int = 2) -> Path:
    """Write the repaired FMU of a closed loop as an SSP package.

    Raises InputError if the FMU is missing or another one, or there is no C compiler.

    - ``content``: what ``model.json`` of kind ``fmu`` holds
    - ``folder``: where the nominal FMU lies
    - ``target``: the ``.ssp``
    - ``version`` {2, 3}: FMI version of the effects' FMU
    """
    system, sample_time = _stored(content, folder)
    with tempfile.TemporaryDirectory(prefix="sysid-package-") as scratch:
        made = Path(scratch) / "effects.fmu" if system.effects else None
        if made is not None:
            packed(effects_source(system, sample_time), effects_description(system, sample_time), made, version)
        return write_structure(_structure(system, sample_time, made), target)


def effects_source(system: FmuSystem, sample_time: float) -> str:
    """Return model.c of the effects' FMU; its variables stand in the order of :func:`effects_description`."""
    around = system.around
    assert around is not None
    names = list(system.parameter_names)[system.inner_count :]
    delays = [
        (element.index, names.index(element.parameter)) for element in system.sampled if element.kind == "input_delay"
    ]
    late = [
        (element.index, names.index(element.parameter)) for element in system.sampled if element.kind == "output_delay"
    ]
    rounded = [
        (element.index, names.index(element.parameter)) for element in system.sampled if element.kind == "quantise"
    ]
    values = [parameter.value for parameter in system.parameters[system.inner_count :]]
    longest = max([values[place] for _, place in (*delays, *late)], default=0.0)
    ring = max(64, 4 * int(np.ceil(longest / sample_time)) + 4)
    before = [f"v[LU + {i}] = late(v, {n}, v[P + {place}], v[IU + {i}]);" for n, (i, place) in enumerate(delays)]
    pushes = [f"push(v, {n}, v[IU_LAST + {i}]);" for n, (i, _) in enumerate(delays)]
    after = [f"if (v[P + {k}] > 0) v[OY + {i}] = rint(v[OY + {i}] / v[P + {k}]) * v[P + {k}];" for i, k in rounded]
    for n, (i, place) in enumerate(late, start=len(delays)):
        after.append(f"v[LY + {i}] = v[OY + {i}]; v[OY + {i}] = late(v, {n}, v[P + {place}], v[OY + {i}]);")
        pushes.append(f"push(v, {n}, v[LY + {i}]);")
    lines = [f"/* {system}: its effects, written by sysid-harness. */", around.source]
    lines += [
        f"enum {{ NR = {sum(around.rates)}, IU = 1, IQ = IU + NU, IV = IQ + NC, IY = IV + NR, OU = IY + NY,",
        "  OY = OU + NU, Z = OY + NY, P = Z + NZ, COUNT = VARIABLES, FRESH, READY, PAST, LU = PAST + REMEMBERED,",
        "  LQ = LU + NU, LR = LQ + NC, LS = LR + NC, LV = LS + NC, LY = LV + NC, IU_LAST = LY + NY,",
        f"  OWN = IU_LAST + NU, LINES = OWN + NZ, RING = {ring},",
        f"  MEMORY = 3 + REMEMBERED + 2 * NU + 4 * NC + NY + NZ + {len(delays) + len(late)} * RING }};",
        f"static const double SAMPLE = {sample_time!r};",
        DELAY,
        _GLUE.replace("BEFORE", "\n    ".join(before))
        .replace("AFTER", "\n    ".join(after))
        .replace("PUSHES", "\n    ".join(pushes)),
    ]
    return "\n".join(lines)


def effects_description(system: FmuSystem, sample_time: float) -> str:
    """Return modelDescription.xml of the effects' FMU (FMI 2.0)."""
    variables = _ports(system)
    count = sum(variable.role == "input" for variable in variables)
    variables += [FmuVariable(f"state.{state.name}", "state", state.unit) for state in system.hidden]
    variables += [
        FmuVariable(parameter.name, "parameter", parameter.unit, parameter.value, parameter.minimum, parameter.maximum)
        for parameter in system.parameters[system.inner_count :]
    ]
    token = hashlib.sha256(f"{effects_source(system, sample_time)}{system.values()}".encode()).hexdigest()[:32]
    name = f"{system.name}-effects"
    root = describe(name, str(system), token, variables, sample_time=sample_time, direct=range(count))
    return xml_text(root)


def _ports(system: FmuSystem) -> list[FmuVariable]:
    """Return inputs and outputs of the effects' FMU."""
    variables = [FmuVariable(channel.name, "input", channel.unit) for channel in system.inputs]
    variables += [
        FmuVariable(f"position.{coordinate.name}", "input", coordinate.unit) for coordinate in system.coordinates
    ]
    variables += [
        FmuVariable(f"rate.{coordinate.name}", "input", f"{coordinate.unit}/s")
        for coordinate in system.coordinates
        if coordinate.rate is not None
    ]
    variables += [FmuVariable(f"raw.{channel.name}", "input", channel.unit) for channel in system.outputs]
    variables += [FmuVariable(f"driven.{channel.name}", "output", channel.unit) for channel in system.inputs]
    return variables + [FmuVariable(f"reading.{channel.name}", "output", channel.unit) for channel in system.outputs]


def _stored(content: Mapping[str, Any], folder: Path) -> tuple[FmuSystem, float]:
    """Return the repaired system of a ``model.json``, its parameters at their fitted values, and the step [s]."""
    from harness import registry
    from harness.blackbox.effects import surround
    from harness.blackbox.reader import fmu_system
    from harness.effects import builtin
    from harness.effects.effect import Placed
    from harness.specs import spec_from_dict

    spec = spec_from_dict(content["spec"])
    path = folder / str(content["model"])
    values = {name: float(value) for name, value in content["parameters"].items()}
    inner = {name: {"value": value, "fixed": True} for name, value in values.items() if "@" not in name}
    system = fmu_system(path, spec, inner)
    if system.digest != content["sha256"]:
        raise InputError(
            "the nominal FMU beside the model",
            expected=f"the one of the closed loop (SHA-256 {content['sha256']}...)",
            got=system.digest,
            remedy="run sysid close-loop again",
            file=path,
        )
    known = builtin()
    effects = [Placed(known[name] if name in known else registry.load("effects", name), at)
               for name, at in content["effects"]]  # fmt: skip
    step = spec.sample_time / int(content.get("exchanges", 1))
    return (surround(system, effects) if effects else system).with_parameters(values), step


def _structure(system: FmuSystem, sample_time: float, effects: Path | None) -> WrittenSystem:
    """Return the nominal FMU and its effects as a system; without effects the FMU alone."""
    described = describe_fmu(system.path)
    moved = [name for one in system.coordinates for name in (one.position, one.rate) if name is not None]
    measured, driven = [[one.name for one in channels] for channels in (system.outputs, system.inputs)]
    inner = {one.name: (one.value, one.unit) for one in system.parameters[: system.inner_count]}
    ports = ports_of(described, list(dict.fromkeys([*driven, *measured, *moved, *inner])))
    for name, port in ports.items():  # what is only looked at leaves the FMU, whatever it is inside
        kind = "input" if name in driven else "parameter" if name in inner else "output"
        ports[name] = replace(port, kind=kind)
    components = [WrittenComponent(NOMINAL, Path(system.path), ports, inner)]
    outer = [
        Outer(channel.name, kind, channel.unit)
        for kind, channels in (("input", system.inputs), ("output", system.outputs))
        for channel in channels
    ]
    if effects is None:
        wires = [WrittenConnection(("", name), (NOMINAL, name)) for name in driven]
        wires += [WrittenConnection((NOMINAL, name), ("", name)) for name in measured]
        return WrittenSystem(system.name, components, wires, outer, sample_time)
    components.append(
        WrittenComponent(
            EFFECTS,
            effects,
            {port.name: WrittenPort(port.name, port.role, "Real", port.unit) for port in _ports(system)},
        )
    )
    wires = []
    for name in driven:
        wires.append(WrittenConnection(("", name), (EFFECTS, name)))
        wires.append(WrittenConnection((EFFECTS, f"driven.{name}"), (NOMINAL, name)))
    for one in system.coordinates:
        wires.append(WrittenConnection((NOMINAL, one.position), (EFFECTS, f"position.{one.name}")))
        if one.rate is not None:
            wires.append(WrittenConnection((NOMINAL, one.rate), (EFFECTS, f"rate.{one.name}")))
    for name in measured:
        wires.append(WrittenConnection((NOMINAL, name), (EFFECTS, f"raw.{name}")))
        wires.append(WrittenConnection((EFFECTS, f"reading.{name}"), ("", name)))
    return WrittenSystem(system.name, components, wires, outer, sample_time)


_GLUE = """
static const char *check(const double *v) { (void)v; return NULL; }

static void prepare(double *v)
{
    for (int i = 0; i < NZ; i++) v[OWN + i] = v[Z + i] != START[Z + i];
    for (int i = 0; i < REMEMBERED; i++) v[PAST + i] = 0;
    v[COUNT] = v[FRESH] = 0;
    v[READY] = 1;
}

static double internal_step(const double *v) { (void)v; return SAMPLE; }

/* What the box gets over the coming sample, and what the sensors tell now; all that a step needs is kept. */
static void evaluate(double *v)
{
    double rate[NC + 1], z[NZ + 1];
    for (int i = 0, k = 0; i < NC; i++) {
        v[LQ + i] = v[IQ + i];
        v[LV + i] = RATE[i] ? v[IV + k++] : 0;
    }
    for (int i = 0; i < NU; i++) v[LU + i] = v[IU_LAST + i] = v[IU + i];
    BEFORE
    motion(v + PAST, v + LQ, v + LV, SAMPLE, v + LR, v + LS);
    for (int i = 0; i < NC; i++) rate[i] = v[LR + i];
    if (NZ && v[READY] && v[COUNT] == 0) {
        starts(v + LU, v + LQ, rate, v + P, z);
        for (int i = 0; i < NZ; i++)
            if (!v[OWN + i]) v[Z + i] = z[i];
    }
    for (int i = 0; i < NZ; i++) z[i] = v[Z + i];
    ahead(v + LU, v + LQ, v + LR, v + LS, v[V_time], SAMPLE, v + P, z, v + OU);
    reading(v + IY, v + LQ, v + LR, v + V_time, v + P, v + OY);
    AFTER
    v[FRESH] = 1;
}

/* A master may have set the inputs of the step's end already: the step uses what was evaluated at its beginning. */
static void advance(double *v, double h)
{
    double mean[NU + 1];
    if (!v[FRESH]) evaluate(v);
    ahead(v + LU, v + LQ, v + LR, v + LS, v[V_time], h, v + P, v + Z, mean);
    remember(v + PAST, v + LQ, v + LV);
    PUSHES
    v[COUNT] += 1;
    v[FRESH] = 0;
}
"""
