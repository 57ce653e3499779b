"""Effects around a black box as functions and as one C source, the same for the loop and for the exported FMU.

The force of the coming sample is the mean over it, along a motion that is predicted from the last samples (constant
acceleration): a force that is taken at the sample's beginning would lag by half a sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

from harness.diagnosis.fmu_system import FmuSystem, fits_fmu
from harness.effects.effect import Placed, port_units, unit_of
from harness.effects.places import port_of
from harness.errors import InputError
from harness.physics.parameters import Parameter
from harness.physics.ports import SampledBlock
from harness.signals import Channel

if TYPE_CHECKING:
    from harness.physics.ports import Port

__all__ = ["Around", "surround"]


@dataclass(frozen=True, eq=False)
class Around:
    """Effects around a black box, in symbols (CasADi).

    Attributes
    ----------
    u, q, v, t, z, p, y : SX
        Inputs, positions, rates, time, hidden states, parameters of the effects, outputs of the black box.
    command : SX (nu,)
        What the black box gets as its input.
    reading : SX (ny,)
        What the sensors tell.
    slopes : SX (nz,)
        Derivatives of the hidden states.
    starts : SX (nz,)
        Where they start.
    rates : tuple of bool
        By coordinate, whether the black box tells its rate.
    reads : bool
        Whether the sensors tell anything else than the black box.
    """

    u: Any
    q: Any
    v: Any
    t: Any
    z: Any
    p: Any
    y: Any
    command: Any
    reading: Any
    slopes: Any
    starts: Any
    rates: tuple[bool, ...]
    reads: bool

    @property
    def points(self) -> int:
        """How often the effects are evaluated in a sample: a reversal must move the mean force without jumps."""
        return 4 if self.z.shape[0] else 16

    @cached_property
    def functions(self) -> dict[str, Any]:
        """CasADi functions ``command``, ``slopes`` (u, q, v, t, z, p), ``reading`` (y, q, v, t, p), ``starts``."""
        from harness.physics.ccode import dense

        inside = [self.u, self.q, self.v, self.t, self.z, self.p]
        return {
            "command": dense("command", inside, [self.command]),
            "slopes": dense("slopes", inside, [self.slopes]),
            "reading": dense("reading", [self.y, self.q, self.v, self.t, self.p], [self.reading]),
            "starts": dense("starts", [self.u, self.q, self.v, self.p], [self.starts]),
        }

    @cached_property
    def source(self) -> str:
        """C source of the functions, and of the prediction over a sample."""
        from harness.physics.ccode import c_function

        sizes = {
            "NU": self.u.shape[0],
            "NC": self.q.shape[0],
            "NZ": self.z.shape[0],
            "NP": self.p.shape[0],
            "NY": self.y.shape[0],
            "NE": self.points,
        }
        told = ", ".join([*("01"[one] for one in self.rates), "0"])
        return "\n".join(
            [
                "#include <math.h>",
                *(f"#define {name} {size}" for name, size in sizes.items()),
                f"static const char RATE[] = {{ {told} }};",
                *(c_function(name, function) for name, function in self.functions.items()),
                _PREDICTION,
            ]
        )


def surround(system: FmuSystem, placed: Sequence[Placed], sizes: Mapping[str, Mapping[str, float]]) -> FmuSystem:
    """Return an FMU with effects around it; see :meth:`FmuSystem.with_effects`."""
    import casadi as ca

    nominal = system if system.nominal is None else system.nominal
    wanted = [*system.effects, *placed]
    names = [str(one) for one in wanted]
    for one in wanted:
        if names.count(str(one)) > 1 or not fits_fmu(one.effect):
            raise InputError(
                f"effect {one} around an FMU",
                expected="an effect on inputs, outputs or forces that needs no acceleration, once at a port",
                got="the same twice" if names.count(str(one)) > 1 else f"an effect on: {', '.join(one.effect.kinds)}",
                remedy="remove it, or write the model as equations",
            )
    old = {one.name: one for one in system.parameters}
    parameters = [old[one.name] for one in nominal.parameters]
    q, v = (ca.SX.sym(name, len(nominal.coordinates)) for name in "qv")
    u, y, t = ca.SX.sym("u", nominal.nu), ca.SX.sym("y", nominal.ny), ca.SX.sym("t")
    place = _Placing(nominal, q, v, t, u, y)
    for one in _ordered(nominal, wanted):
        port = port_of(cast(Any, nominal), one)
        parameters += [
            old.get(made.name, made)
            for made in place.add(one, port, sizes.get(str(one), sizes.get(one.at, sizes.get("", {}))))
        ]
    around = Around(
        u=u,
        q=q,
        v=v,
        t=t,
        z=ca.vertcat(*place.states) if place.states else ca.SX(0, 1),
        p=ca.vertcat(*place.symbols) if place.symbols else ca.SX(0, 1),
        y=y,
        command=ca.vertcat(*place.command) if place.command else ca.SX(0, 1),
        reading=ca.vertcat(*place.reading),
        slopes=ca.vertcat(*place.slopes) if place.slopes else ca.SX(0, 1),
        starts=ca.vertcat(*place.starts) if place.starts else ca.SX(0, 1),
        rates=tuple(one.rate is not None for one in nominal.coordinates),
        reads=any(not ca.is_equal(one, y[row]) for row, one in enumerate(place.reading)),
    )
    return replace(
        nominal,
        parameters=tuple(parameters),
        hidden=tuple(place.hidden),
        sampled=tuple(place.sampled),
        effects=tuple(wanted),
        around=around,
        nominal=nominal,
    )


def _ordered(system: FmuSystem, placed: Sequence[Placed]) -> list[Placed]:
    """Return inputs first, then forces (transmissions last), then outputs."""
    kinds = {str(one): port_of(cast(Any, system), one).kind for one in placed}
    forces = [one for one in placed if kinds[str(one)] == "coordinate"]
    return [
        *(one for one in placed if kinds[str(one)] == "input"),
        *sorted(forces, key=lambda one: one.effect.drives),
        *(one for one in placed if kinds[str(one)] == "output"),
    ]


class _Placing:
    """Effects put around one after the other."""

    def __init__(self, system: FmuSystem, q: Any, v: Any, t: Any, u: Any, y: Any) -> None:
        self.system, self.q, self.v, self.t, self.u = system, q, v, t, u
        self.command: list[Any] = [u[row] for row in range(system.nu)]
        self.reading: list[Any] = [y[row] for row in range(system.ny)]
        self.driven: list[Any] | None = None
        self.symbols: list[Any] = []
        self.states: list[Any] = []
        self.slopes: list[Any] = []
        self.starts: list[Any] = []
        self.hidden: list[Channel] = []
        self.sampled: list[SampledBlock] = []

    def add(self, placed: Placed, port: Port, sizes: Mapping[str, float]) -> list[Parameter]:
        """Add one effect; returns its parameters."""
        import casadi as ca

        system, effect = self.system, placed.effect
        row = None
        if port.kind == "coordinate":
            row = [one.name for one in system.coordinates].index(port.name)
            units = port_units("coordinate", port.unit, system.coordinates[row].force_unit)
        else:
            units = port_units(port.kind, port.unit)
        declared, named = [], {}
        for one, value in zip(effect.parameters, effect.complete(placed.values, sizes).values(), strict=True):
            fixed = one.fixed
            if one.angle_only and port.unit != "rad":
                fixed, value = True, one.neutral or 0.0
            symbol = ca.SX.sym(placed.name(one.name))
            unit, low = unit_of(one.unit, units), one.lowest(sizes, value)
            declared.append(Parameter(placed.name(one.name), unit, value, low, one.maximum, fixed))
            named[one.name] = symbol
            self.symbols.append(symbol)
        if effect.sampled:
            channels = system.inputs if port.kind == "input" else system.outputs
            index = [one.name for one in channels].index(port.name)
            self.sampled.append(SampledBlock(effect.sampled, index, declared[0].name))  # type: ignore[arg-type]
            return declared
        signal, q, v = self._arriving(port, row)
        states = [ca.SX.sym(placed.name(name)) for name in effect.states]
        value, slopes = effect.evaluate(signal, states, named, q, v, t=self.t, load=signal)
        if port.kind == "coordinate":
            assert row is not None
            self.command[system.coordinates[row].force] += value
        elif port.kind == "input":
            index = [one.name for one in system.inputs].index(port.name)
            self.command[index] = signal + value if "coordinate" in effect.kinds else value
        else:
            self.reading[[one.name for one in system.outputs].index(port.name)] = value
        context = {"signal": signal, "q": q, "v": v}
        for name, unit, symbol, slope in zip(effect.states, effect.state_units, states, slopes, strict=True):
            self.states.append(symbol)
            self.slopes.append(slope)
            self.starts.append(context[effect.initial[name]] if name in effect.initial else 0.0)
            self.hidden.append(Channel(placed.name(name), unit_of(unit, units)))
        return declared

    def _arriving(self, port: Port, row: int | None) -> tuple[Any, Any, Any]:
        """Return the signal that arrives at a port, and the position and rate there."""
        system = self.system
        if port.kind == "coordinate":
            assert row is not None
            if self.driven is None:  # a force does not see the forces added beside it
                self.driven = list(self.command)
            return self.driven[system.coordinates[row].force], self.q[row], self.v[row]
        if port.kind == "input":
            index = [one.name for one in system.inputs].index(port.name)
            moved = next((k for k, one in enumerate(system.coordinates) if one.force == index), None)
            signal = self.command[index]
            return (signal, 0.0, 0.0) if moved is None else (signal, self.q[moved], self.v[moved])
        signal = self.reading[[one.name for one in system.outputs].index(port.name)]
        moved = next((k for k, one in enumerate(system.coordinates) if one.name == port.name), None)
        return (signal, signal, 0.0) if moved is None else (signal, self.q[moved], self.v[moved])


_PREDICTION = """
/* Motion at this instant: rates and accelerations by coordinate. What is remembered: how many samples there were,
   then for each coordinate its last rate, or where the box tells none its last two positions. */
#define REMEMBERED (1 + 2 * NC)
static void motion(const double *past, const double *q, const double *v, double h, double *rate, double *slope)
{
  for (int i = 0; i < NC; i++) {
    const double a = past[1 + 2 * i], b = past[2 + 2 * i];
    if (RATE[i]) {
      rate[i] = v[i];
      slope[i] = past[0] > 0 ? (v[i] - a) / h : 0;
    } else {
      rate[i] = past[0] < 1 ? 0 : past[0] < 2 ? (q[i] - a) / h : (3 * q[i] - 4 * a + b) / (2 * h);
      slope[i] = past[0] < 2 ? 0 : (q[i] - 2 * a + b) / (h * h);
    }
  }
}

static void remember(double *past, const double *q, const double *v)
{
  for (int i = 0; i < NC; i++) {
    past[2 + 2 * i] = past[1 + 2 * i];
    past[1 + 2 * i] = RATE[i] ? v[i] : q[i];
  }
  past[0] += 1;
}

/* Mean of the command over the coming sample of length h; z goes on to its end (classical Runge-Kutta). */
static void ahead(const double *u, const double *q, const double *rate, const double *slope, double t, double h,
                  const double *p, double *z, double *mean)
{
  const double part = h / NE;
  double x[NC + 1], v[NC + 1], now[NU + 1], k1[NZ + 1], k2[NZ + 1], k3[NZ + 1], k4[NZ + 1];
  double w[NZ + 1], m[NZ + 1];
  for (int i = 0; i < NU; i++) mean[i] = 0;
  for (int s = 0; s < NE; s++) {
    const double passed = (s + 0.5) * part, time = t + passed;
    for (int i = 0; i < NC; i++) {
      x[i] = q[i] + passed * (rate[i] + 0.5 * passed * slope[i]);
      v[i] = rate[i] + passed * slope[i];
    }
    if (NZ) {
      slopes(u, x, v, &time, z, p, k1);
      for (int i = 0; i < NZ; i++) w[i] = z[i] + 0.5 * part * k1[i];
      slopes(u, x, v, &time, w, p, k2);
      for (int i = 0; i < NZ; i++) m[i] = z[i] + 0.5 * part * k2[i]; /* the middle: the command is taken there */
      slopes(u, x, v, &time, m, p, k3);
      for (int i = 0; i < NZ; i++) w[i] = z[i] + part * k3[i];
      slopes(u, x, v, &time, w, p, k4);
      command(u, x, v, &time, m, p, now);
      for (int i = 0; i < NZ; i++) z[i] += part / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    } else
      command(u, x, v, &time, z, p, now);
    for (int i = 0; i < NU; i++) mean[i] += now[i] / NE;
  }
}
"""
