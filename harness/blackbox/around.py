"""Effects around a black box as functions and as one C source, the same for the loop and for the exported FMU.

The force of the coming sample is the mean over it, along a motion that is predicted from the last samples (constant
acceleration): a force that is taken at the sample's beginning would lag by half a sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any


@dataclass(frozen=True, eq=False)
class Around:
    """Effects around a black box, in symbols (CasADi)."""

    # Inputs, positions, rates, time, hidden states, parameters of the effects, outputs of the black box
    u: Any
    q: Any
    v: Any
    t: Any
    z: Any
    p: Any
    y: Any
    command: Any  # SX (nu,): What the black box gets as its input
    reading: Any  # SX (ny,): What the sensors tell
    derivatives: Any  # SX (nz,): Derivatives of the hidden states
    starts: Any  # SX (nz,): Where they start
    rates: tuple[bool, ...]  # By coordinate, whether the black box tells its rate
    reads: bool  # Whether the sensors tell anything else than the black box

    def __getstate__(self) -> dict[str, Any]:
        """Return the blocks as a function: symbols belong to one process."""
        import casadi as ca

        given = [self.u, self.q, self.v, self.t, self.z, self.p, self.y]
        made = [ca.SX(part) for part in (self.command, self.reading, self.derivatives, self.starts)]
        function = ca.Function("around", given, made)
        return {"function": function.serialize(), "rates": self.rates, "reads": self.reads}

    def __setstate__(self, state: dict[str, Any]) -> None:
        import casadi as ca

        function = ca.Function.deserialize(state["function"])
        given = function.sx_in()
        names = ("u", "q", "v", "t", "z", "p", "y", "command", "reading", "derivatives", "starts")
        self.__dict__.update(zip(names, [*given, *function.call(given)], strict=True))
        self.__dict__.update(rates=state["rates"], reads=state["reads"])

    @property
    def points(self) -> int:
        """How often the effects are evaluated in a sample: a reversal must move the mean force without jumps."""
        return 16 if self.derivatives.is_zero() else 4

    @cached_property
    def driving(self) -> list[int]:
        """Rows of p that change what goes into the black box: without them its run stays the same."""
        import casadi as ca

        inside = ca.vertcat(self.command, self.derivatives, self.starts)
        return [row for row, enters in enumerate(ca.which_depends(inside, self.p)) if enters] if self.p.numel() else []

    @cached_property
    def functions(self) -> dict[str, Any]:
        """CasADi functions ``command``, ``derivatives`` (u, q, v, t, z, p), ``reading`` (y, q, v, t, p), ``starts``."""
        from harness.physics.compiled.ccode import dense

        inside = [self.u, self.q, self.v, self.t, self.z, self.p]
        return {
            "command": dense("command", inside, [self.command]),
            "derivatives": dense("derivatives", inside, [self.derivatives]),
            "reading": dense("reading", [self.y, self.q, self.v, self.t, self.p], [self.reading]),
            "starts": dense("starts", [self.u, self.q, self.v, self.p], [self.starts]),
        }

    @cached_property
    def source(self) -> str:
        """C source of the functions, and of the prediction over a sample."""
        from harness.physics.compiled.ccode import c_function

        sizes = {
            "NU": self.u.shape[0],
            "NC": self.q.shape[0],
            "NZ": self.z.shape[0],
            "NP": self.p.shape[0],
            "NY": self.y.shape[0],
            "NE": self.points,
        }
        told = ", ".join([*("01"[measured] for measured in self.rates), "0"])
        return "\n".join(
            [
                "#include <math.h>",
                *(f"#define {name} {size}" for name, size in sizes.items()),
                f"static const char RATE[] = {{ {told} }};",
                *(c_function(name, function) for name, function in self.functions.items()),
                _PREDICTION,
            ]
        )


_PREDICTION = """
/* Motion at this instant: rates and accelerations by coordinate. What is remembered: how many samples there were,
   then for each coordinate its last rate, or where the box tells none its last two positions. */
#define REMEMBERED (1 + 2 * NC)
static void motion(const double *past, const double *q, const double *v, double h, double *rate, double *acceleration)
{
  for (int i = 0; i < NC; i++) {
    const double a = past[1 + 2 * i], b = past[2 + 2 * i];
    if (RATE[i]) {
      rate[i] = v[i];
      acceleration[i] = past[0] > 0 ? (v[i] - a) / h : 0;
    } else {
      rate[i] = past[0] < 1 ? 0 : past[0] < 2 ? (q[i] - a) / h : (3 * q[i] - 4 * a + b) / (2 * h);
      acceleration[i] = past[0] < 2 ? 0 : (q[i] - 2 * a + b) / (h * h);
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
static void ahead(const double *u, const double *q, const double *rate, const double *acceleration, double t, double h,
                  const double *p, double *z, double *mean)
{
  const double part = h / NE;
  double x[NC + 1], v[NC + 1], now[NU + 1], k1[NZ + 1], k2[NZ + 1], k3[NZ + 1], k4[NZ + 1];
  double w[NZ + 1], m[NZ + 1];
  for (int i = 0; i < NU; i++) mean[i] = 0;
  for (int s = 0; s < NE; s++) {
    const double passed = (s + 0.5) * part, time = t + passed;
    for (int i = 0; i < NC; i++) {
      x[i] = q[i] + passed * (rate[i] + 0.5 * passed * acceleration[i]);
      v[i] = rate[i] + passed * acceleration[i];
    }
    if (NZ) {
      derivatives(u, x, v, &time, z, p, k1);
      for (int i = 0; i < NZ; i++) w[i] = z[i] + 0.5 * part * k1[i];
      derivatives(u, x, v, &time, w, p, k2);
      for (int i = 0; i < NZ; i++) m[i] = z[i] + 0.5 * part * k2[i]; /* the middle: the command is taken there */
      derivatives(u, x, v, &time, m, p, k3);
      for (int i = 0; i < NZ; i++) w[i] = z[i] + part * k3[i];
      derivatives(u, x, v, &time, w, p, k4);
      command(u, x, v, &time, m, p, now);
      for (int i = 0; i < NZ; i++) z[i] += part / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    } else
      command(u, x, v, &time, z, p, now);
    for (int i = 0; i < NU; i++) mean[i] += now[i] / NE;
  }
}
"""
