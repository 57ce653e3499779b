"""What the inertial parameters of an arm are multiplied by, for whole records: generated C, four samples at once."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from harness.physics.arms.joints import MOVING, Joint
from harness.physics.compiled.ccode import c_function, dense
from harness.physics.compiled.compilation import Compilation
from harness.signals import FloatArray

Form = Literal["torque", "momentum", "energy", "pull"]

LANES = 4  # Doubles in a register of AVX2; on other processors the compiler divides them.
ROUND = 1e-15  # Entries of rotations of a URDF that are 0 or 1 but for the cosine of pi/2 in floating point.


class ArmRegressor:
    """``W(q, v, a)`` of an arm, compiled; where there is no C compiler by array operations.

    Energy, momentum and torque are linear in the ten inertial parameters of every body; W is the factor of one of them.

    Parameters
    ----------
    joints : sequence of Joint
        Parents before children, fixed ones included.
    form : {"torque", "momentum", "energy", "pull"}
        Joint torques; generalized momenta dL/dv; kinetic plus potential energy (one row); or dL/dq, what drives the
        momenta beside the torques. Only the torques use the acceleration.
    floating : bool
        The frame that carries the first joints moves freely: six rows more, before the joints', of the force and the
        moment on it, in its own axes and about its origin (torques only).

    Attributes
    ----------
    rows, columns : int
        Joints that move (1 for the energy, 6 more of a floating base), and 10 for every body.

    Examples
    --------
    >>> from harness.physics.arms.rigid_tree import pendulum_for_the_example
    >>> hinge = pendulum_for_the_example()
    >>> W = ArmRegressor(hinge.joints)(np.zeros((2, 1)), np.zeros((2, 1)), np.ones((2, 1)))
    >>> W.shape, bool(np.allclose(W @ hinge.parameters, [4.905 + 0.25, 4.905 + 0.25]))
    ((2, 10), True)
    """

    def __init__(self, joints: Sequence[Joint], form: Form = "torque", *, floating: bool = False) -> None:
        self.joints, self.form, self.floating = tuple(joints), form, floating
        moving = [joint for joint in self.joints if joint.kind in MOVING]
        arguments, matrix = symbolic_regressor(self.joints, floating=floating)
        if form != "torque":
            matrix = _other_form(self.joints, form, arguments, matrix)
        self._n, (self.rows, self.columns) = len(moving), matrix.shape
        import casadi as ca

        self._sparsity = matrix.sparsity()
        entries = ca.vertcat(*matrix.nonzeros()) if matrix.nnz() else ca.SX(0, 1)
        self._entries = dense("entries", [ca.vertcat(*arguments)], [entries])
        rows, columns = (np.asarray(indices, dtype=np.int64) for indices in self._sparsity.get_triplet())
        self._places = np.ascontiguousarray(rows * self.columns + columns, dtype=np.int32)
        self._turning = np.array([joint.kind != "prismatic" for joint in moving])

    def __call__(
        self,
        q: FloatArray,
        v: FloatArray,
        a: FloatArray,
        gravity: tuple[float, float, float] | FloatArray = (0.0, 0.0, -9.81),
        spin: FloatArray | None = None,
        turning: FloatArray | None = None,
    ) -> FloatArray:
        """Return W (N * rows, columns), the rows of a sample together; of joint motions (N, n).

        Of a floating base ``gravity`` (N, 3) is gravity minus the acceleration of its origin, and ``spin`` and
        ``turning`` (N, 3) are its angular velocity and acceleration, all in its own axes.
        """
        q, v, a = (np.asarray(values, dtype=float).reshape(len(values), self._n) for values in (q, v, a))
        count = len(q)
        # calloc: entries that are always 0 are never touched
        found = np.zeros((count * self.rows, self.columns))
        inputs = self._inputs(q, v, a, gravity, spin, turning)
        if (library := self._library) is None:
            self._by_arrays(inputs, found, count)
            return found
        pointer = ctypes.c_void_p
        library.regressor(
            pointer(inputs.ctypes.data),
            ctypes.c_long(inputs.shape[1]),
            ctypes.c_long(count),
            pointer(self._places.ctypes.data),
            pointer(found.ctypes.data),
        )
        return found

    def normal_equations(
        self, q: FloatArray, v: FloatArray, a: FloatArray, torque: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return ``W' L'L W``, ``W' L'L tau`` and ``tau' L'L tau`` block by block, so that memory stays bounded.

        - ``q, v, a, torque`` (N, n)
        - ``weights`` (n, n): L: the torques of an instant are multiplied by it (1 / standard deviations, or a
          whitening)
        """
        gram, side, power = np.zeros((self.columns, self.columns)), np.zeros(self.columns), 0.0
        for first in range(0, len(q), 2000):
            part = slice(first, first + 2000)
            rows = (weights @ self(q[part], v[part], a[part]).reshape(-1, self.rows, self.columns)).reshape(
                -1, self.columns
            )
            known = (torque[part] @ weights.T).ravel()
            gram += rows.T @ rows
            side += rows.T @ known
            power += float(known @ known)
        return gram, side, power

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(ArmRegressor, floating=self.floating), (self.joints, self.form)

    # ---- inside --------------------------------------------------------------------------------------------------

    def _inputs(
        self,
        q: FloatArray,
        v: FloatArray,
        a: FloatArray,
        gravity: tuple[float, ...] | FloatArray,
        spin: FloatArray | None,
        turning: FloatArray | None,
    ) -> FloatArray:
        """Return the inputs (4 n + 3, N), 6 more of a floating base, of the generated code, in whole registers."""
        count = len(q)
        padded = -(-max(count, 1) // LANES) * LANES
        n = self._n
        inputs = np.zeros((self._entries.size1_in(0), padded))
        inputs[:n, :count] = np.where(self._turning, np.sin(q), q).T
        inputs[n : 2 * n, :count] = np.where(self._turning, np.cos(q), 1.0).T
        inputs[2 * n : 3 * n, :count], inputs[3 * n : 4 * n, :count] = v.T, a.T
        inputs[4 * n : 4 * n + 3, :count] = np.broadcast_to(np.asarray(gravity, dtype=float), (count, 3)).T
        for place, moved in enumerate((spin, turning)):
            if self.floating and moved is not None:
                inputs[4 * n + 3 + 3 * place : 4 * n + 6 + 3 * place, :count] = np.asarray(moved, dtype=float).T
        return inputs

    @cached_property
    def _library(self) -> Any:
        if len(self._places) == 0:
            return None
        text = c_function("entries", self._entries).replace("double", "lanes")
        spread = ", ".join([r"\2"] * LANES)
        text = re.sub(r"^(\s*w\d+ = )(-?[\d.]+(?:e[+-]?\d+)?);$", rf"\1(lanes){{{spread}}};", text, flags=re.MULTILINE)
        source = _FRAME.format(
            bytes=8 * LANES, lanes=LANES, function=text, inputs=self._entries.size1_in(0), entries=len(self._places),
            size=self.rows * self.columns,
        )  # fmt: skip
        return Compilation(source).library()

    def _by_arrays(self, inputs: FloatArray, found: FloatArray, count: int) -> None:
        from harness.physics.arms.vectorised import OnRecords

        function = OnRecords(self._entries)
        flat = found.reshape(count, -1)
        for first in range(0, count, 4096):
            part = slice(first, min(first + 4096, count))
            flat[part, self._places] = function(np.ascontiguousarray(inputs[:, part].T))[0]


def symbolic_regressor(joints: Sequence[Joint], *, floating: bool = False) -> tuple[list[Any], Any]:
    """Return the symbols (sin q or q, cos q, v, a, gravity) and the regressor (n, 10 * bodies), a sparse CasADi SX.

    Of a floating base the symbols go on with its angular velocity and acceleration, and six rows come first.

    Newton-Euler in the bodies' own frames, projected on the motion that each joint gives to each body behind it
    (Atkeson, An & Hollerbach 1986, Int. J. Robotics Res. 5(3):101, eq. 10-20).

    - ``joints``: parents before children
    - ``floating``: see :class:`ArmRegressor`
    """
    import casadi as ca

    n = sum(joint.kind in MOVING for joint in joints)
    sine, cosine, v, a = (ca.SX.sym(name, n) for name in ("s", "c", "v", "a"))
    gravity = ca.SX.sym("g", 3)
    zero = ca.SX.zeros(3)
    base: tuple[Any, Any, Any, dict[int, tuple[Any, Any]]] = (zero, zero, -gravity, {})
    arguments, first = [sine, cosine, v, a, gravity], 0
    if floating:
        turns, first = (ca.SX.sym("w", 3), ca.SX.sym("dw", 3)), 6
        units = [ca.SX(unit) for unit in np.eye(3)]
        moved = {k: (zero, unit) for k, unit in enumerate(units)} | {
            3 + k: (unit, zero) for k, unit in enumerate(units)
        }
        base, arguments = (*turns, -gravity, moved), [*arguments, *turns]
    bodies: list[tuple[Any, Any, Any, dict[int, tuple[Any, Any]]]] = []
    matrix = ca.SX(first + n, 10 * len(joints))
    index = 0
    for number, joint in enumerate(joints):
        spin, turning, pull, motions = base if joint.parent < 0 else bodies[joint.parent]
        pose, axis, place = _snapped(joint.rotation), _snapped(joint.axis), ca.SX(joint.offset)
        moves = joint.kind in MOVING
        if joint.kind == "prismatic":
            place = place + ca.mtimes(pose, axis) * sine[index]
        elif moves:
            pose = ca.mtimes(pose, _turned(joint, sine[index], cosine[index]))
        pull = pull + ca.cross(turning, place) + ca.cross(spin, ca.cross(spin, place))
        own = {
            j: (ca.mtimes(pose.T, angular), ca.mtimes(pose.T, linear + ca.cross(angular, place)))
            for j, (angular, linear) in motions.items()
        }
        spin, turning, pull = (ca.mtimes(pose.T, vector) for vector in (spin, turning, pull))
        if joint.kind == "prismatic":
            pull = pull + axis * a[index] + 2 * ca.cross(spin, axis * v[index])
            own[first + index] = (zero, axis)
        elif moves:
            turning = turning + axis * a[index] + ca.cross(spin, axis * v[index])
            spin = spin + axis * v[index]
            own[first + index] = (axis, zero)
        index += moves
        bodies.append((spin, turning, pull, own))
        for j, (angular, linear) in own.items():
            matrix[j, 10 * number : 10 * number + 10] = _ten(angular, linear, spin, turning, pull).T
    return arguments, ca.sparsify(ca.simplify(matrix))


def _other_form(joints: Sequence[Joint], form: Form, arguments: list[Any], torque: Any) -> Any:
    """Return momentum, energy or dL/dq as (rows, 10 * bodies), from the torques and the heights of the bodies.

    dL/dv is the torque of the acceleration v at rest without gravity; kinetic energy is half of v times that; dL/dq is
    the rate of dL/dv at the motion minus the torques (Lagrange's equations).
    """
    import casadi as ca

    sine, cosine, v, a, gravity = arguments
    n = v.shape[0]
    still, none = ca.DM.zeros(n), ca.DM.zeros(3)
    momentum = ca.substitute(torque, ca.vertcat(v, a, gravity), ca.vertcat(still, v, none))
    if form == "momentum":
        return ca.sparsify(ca.simplify(momentum))
    if form == "energy":
        return ca.sparsify(ca.simplify(ca.mtimes(v.T, momentum) / 2 + _heights(joints, sine, cosine, gravity)))
    moving = [joint for joint in joints if joint.kind in MOVING]
    turning = ca.DM([joint.kind != "prismatic" for joint in moving])
    moved = ca.vertcat(v * (turning * cosine + 1 - turning), -v * turning * sine)
    rate = ca.reshape(ca.jtimes(ca.vec(ca.densify(momentum)), ca.vertcat(sine, cosine), moved), momentum.shape)
    return ca.sparsify(ca.simplify(rate - ca.substitute(torque, a, still)))


def _heights(joints: Sequence[Joint], sine: Any, cosine: Any, gravity: Any) -> Any:
    """Return what the ten parameters of each body add to the potential energy, (1, 10 * bodies)."""
    import casadi as ca

    frames: list[tuple[Any, Any]] = []
    row, index = [], 0
    for joint in joints:
        turn, place = (ca.SX.eye(3), ca.SX.zeros(3)) if joint.parent < 0 else frames[joint.parent]
        place = place + ca.mtimes(turn, ca.SX(joint.offset))
        turn = ca.mtimes(turn, _snapped(joint.rotation))
        if joint.kind == "prismatic":
            place = place + ca.mtimes(turn, _snapped(joint.axis)) * sine[index]
        elif joint.kind in MOVING:
            turn = ca.mtimes(turn, _turned(joint, sine[index], cosine[index]))
        index += joint.kind in MOVING
        frames.append((turn, place))
        row.append(ca.horzcat(-ca.dot(gravity, place), -ca.mtimes(gravity.T, turn), ca.SX(1, 6)))
    return ca.horzcat(*row)


def _turned(joint: Joint, sine: Any, cosine: Any) -> Any:
    """Return the rotation about the axis of a joint (Rodrigues)."""
    import casadi as ca

    x, y, z = joint.axis
    cross = _snapped(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    return ca.SX.eye(3) + sine * cross + (1 - cosine) * ca.mtimes(cross, cross)


def _ten(angular: Any, linear: Any, spin: Any, turning: Any, pull: Any) -> Any:
    """Return what the ten parameters of a body add to the torque of a joint that moves it so."""
    import casadi as ca

    first = ca.cross(linear, turning) + ca.cross(ca.cross(linear, spin), spin) + ca.cross(pull, angular)
    twist = ca.cross(angular, spin)
    second = []
    for i in range(3):
        for j in range(i, 3):
            term = angular[i] * turning[j] + twist[i] * spin[j]
            second.append(term if i == j else term + angular[j] * turning[i] + twist[j] * spin[i])
    return ca.vertcat(ca.dot(linear, pull), first, *second)


def _snapped(numbers: FloatArray) -> Any:
    """Return constants as a sparse SX, those that are 0 or +-1 but for rounding made so."""
    import casadi as ca

    near = np.round(numbers)
    return ca.sparsify(ca.SX(np.where(np.abs(numbers - near) < ROUND, near, numbers)))


_FRAME = """
typedef double lanes __attribute__((vector_size({bytes}), aligned(8)));
{function}
void regressor(const double *inputs, long stride, long count, const int *places, double *result) {{
  lanes in[{inputs}], out[{entries}];
  for (long first = 0; first < count; first += {lanes}) {{
    for (int k = 0; k < {inputs}; ++k) in[k] = *(const lanes *)(inputs + k * stride + first);
    entries(in, out);
    long left = count - first < {lanes} ? count - first : {lanes};
    for (long lane = 0; lane < left; ++lane) {{
      double *to = result + (first + lane) * {size};
      for (int k = 0; k < {entries}; ++k) to[places[k]] = out[k][lane];
    }}
  }}
}}
"""
