"""Truth by hand-written laws: a pendulum and a cart-pole in C, apart from the models and the dictionary.

The step is a twentieth of a sample, friction has a true standstill, corners are sharp; see ``truth.c``.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.errors import InputError, PlantError, refuse_unknown
from harness.signals import FloatArray

DT = 0.004  # Sample time of all records [s].
SUBSTEPS = 20
GRAVITY = 9.81
_LARGE = 1e30
_COMMON = {
    "dof": 1.0,
    "g": GRAVITY,
    "J": 1.0,
    "mgl": 0.0,
    "mc": 1.0,
    "mp": 1.0,
    "l": 1.0,
    "tilt": 0.0,
    "kt": 0.0,
    "gap": 0.0,
    "dt": 0.0,
    "Jm": 1.0,
    "delay": 0.0,
    "width": 0.0,
    "limit": _LARGE,
    "R": _LARGE,
    "tau": 0.0,
    "gain": 1.0,
    "ramp": 0.0,
    "hard": 0.0,
    "push": 0.0,
    "rod": 0.0,
    "hold": 0.0,
    "droop": 0.0,
    "sag": 0.0,
    "sagt": 0.0,
    "te": 0.0,
    "loop": 0.0,
    "volt": _LARGE,
    "emf": 0.0,
    "eta": 1.0,
    "rip": 0.0,
    "ripk": 0.0,
    "ripphi": 0.0,
    "sagc": 0.0,
    "sagtau": 0.0,
    "square": 0.0,
    "arm": 0.0,
    "anchor": 0.0,
    "kc": 0.0,
    "free": 0.0,
    "place": 0.0,
    "bm": 0.0,
    "bk": 0.0,
    "bc": 0.0,
}
_EACH = {
    "b": 0.0,
    "F0": 0.0,
    "c": 0.0,
    "k": 0.0,
    "k2": 0.0,
    "k3": 0.0,
    "A": 0.0,
    "cog": 0.0,
    "cogk": 0.0,
    "cogphi": 0.0,
    "per": 0.0,
    "perw": 0.0,
    "perphi": 0.0,
    "stop": _LARGE,
    "ks": 0.0,
    "ds": 0.0,
    "Fh": 0.0,
    "xs": 1.0,
    "km": 0.0,
    "taum": 1.0,
    "root": 0.0,
    "even": 0.0,
    "vdp": 0.0,
    "ripple": 0.0,
    "drag3": 0.0,
    "mag": 0.0,
    "magq": 0.0,
    "magw": 1.0,
    "warm": 0.0,
    "warmt": 1.0,
    "tire": 0.0,
    "stept": _LARGE,
    "stepe": _LARGE,
    "stepf": 0.0,
    "t0": _LARGE,
    "dJ": 0.0,
    "dG": 0.0,
    "Fp": 0.0,
    "Fm": 0.0,
    "Fss": 0.0,
    "Fst": 0.0,
    "vs": 1.0,
    "Fpos": 0.0,
    "pa": 0.0,
    "pphi": 0.0,
    "mu": 0.0,
    "sdelay": 0.0,
    "und": 0.0,
    "hunt": 0.0,
    "slip": 0.0,
    "bs": 0.0,
    "bd": 0.0,
    "rootv": 0.0,
}
_VALUES = {**_COMMON, **{f"{name}{i}": value for i in (0, 1) for name, value in _EACH.items()}}


@dataclass(frozen=True, eq=False)
class Motion:
    """What happened.

    Attributes
    ----------
    q, v : array (N, dof)
        Coordinates and rates at the samples.
    reading : array (N, dof)
        Coordinates as the sensors see them: late if ``sdelay`` is set.
    passed : array (N,)
        What left the actuator at each sample.
    """

    q: FloatArray
    v: FloatArray
    reading: FloatArray
    passed: FloatArray


def simulate(
    values: Mapping[str, float],
    u: FloatArray,
    *,
    start: FloatArray,
    disturbance: FloatArray | None = None,
    sample_time: float = DT,
    substeps: int = SUBSTEPS,
) -> Motion:
    """Simulate.

    Parameters
    ----------
    values : mapping
        Parameters of ``truth.c`` that differ from "no effect"; ``dof`` 1 is the pendulum, 2 the cart-pole.
    u : array (N,)
        Command, held over a sample.
    start : array (2 dof,)
        Coordinates, then rates.
    disturbance : array (N,), optional
        Added to the force behind the actuator.
    sample_time : float
        [s].
    substeps : int
        Fine steps for each sample.

    Raises
    ------
    InputError
        If a parameter is unknown, or there is no C compiler.
    PlantError
        If the motion leaves every bound.

    Examples
    --------
    >>> motion = simulate({"J": 1.0}, np.ones(3), start=np.zeros(2), sample_time=1.0)
    >>> motion.q[:, 0].round(6).tolist()
    [0.0, 0.5, 2.0]
    """
    refuse_unknown("parameter of a truth", values, _VALUES)
    p = np.array([float(values.get(name, value)) for name, value in _VALUES.items()])
    dof, n = int(p[0]), len(u)
    first = np.zeros(4)
    first[:dof], first[2 : 2 + dof] = start[:dof], start[dof:]
    states, readings, passed = np.empty((n, 4)), np.empty((n, 2)), np.empty(n)
    force = np.zeros(n) if disturbance is None else np.ascontiguousarray(disturbance, dtype=float)
    command = np.ascontiguousarray(u, dtype=float)
    step = sample_time / substeps
    failed = _library().simulate(
        *map(_pointer, (p, first, command, force)),
        ctypes.c_int(n),
        ctypes.c_int(substeps),
        ctypes.c_double(step),
        *map(_pointer, (states, readings, passed)),
    )
    if failed:
        raise PlantError("the truth leaves every bound", status="diverged")
    return Motion(states[:, :dof].copy(), states[:, 2 : 2 + dof].copy(), readings[:, :dof].copy(), passed)


def _pointer(array: FloatArray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


@functools.cache
def _library() -> ctypes.CDLL:
    """Return the compiled truth."""
    from harness.fmi.build import FLAGS, BuildError, compile_library
    from harness.fmi.compiled import build_once

    source = Path(__file__).with_name("truth.c").read_text(encoding="utf-8")
    text = f"enum {{ {', '.join(f'P_{name}' for name in _VALUES)} }};\n{source}"
    key = "study-" + hashlib.sha256(f"{text} {FLAGS}".encode()).hexdigest()[:24]

    def make(target: Path) -> None:
        written = target.with_suffix(".c")
        written.write_text(text, encoding="utf-8")
        try:
            compile_library([written], target)
        finally:
            written.unlink(missing_ok=True)

    try:
        path = build_once(key, "truth.so", make)
    except BuildError as error:
        raise InputError(
            "the truth cannot be built", expected="a C compiler", got=str(error), remedy="install gcc, or set CC"
        ) from error
    library = ctypes.CDLL(str(path))
    library.simulate.restype = ctypes.c_int
    return library
