"""Models that are linear in lumped parameters: torque, energy and momentum form, and least squares on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
import sympy as sp

from harness.errors import FitError, InputError
from harness.physics.arms.mechanism import ArmMechanism
from harness.physics.lumps.arm_lumps import ArmLumps
from harness.physics.lumps.identifiability import Identifiability, identifiability
from harness.physics.lumps.lumped_functions import jumping_mean, motion_functions, test_function_on
from harness.physics.symbolic.lumping import Split, split
from harness.physics.symbolic.mechanism import Mechanism
from harness.signals import FloatArray

ForceColumns = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""``columns(q, v, u, t) -> (N, n, k)``: forces on the n coordinates, each to be multiplied by a new parameter."""


@dataclass(frozen=True, eq=False)
class LumpedFit:
    """Lumped parameters from least squares.

    Attributes
    ----------
    values : dict
        By name. A combination that the data do not determine has the value it takes when those left out are 0.
    covariance : array (k, k)
        Of all, from the residual; rows of those left out are 0.
    identifiability : Identifiability
        Rank, kept and dependent combinations.
    rms : float
        Of the residual, in the unit of the rows.
    """

    values: dict[str, float]
    covariance: FloatArray
    identifiability: Identifiability
    rms: float


def lumped(mechanism: Mechanism, *, known: Mapping[str, float] | None = None) -> LumpedModel:
    """Return the model of a mechanism that is linear in lumped parameters.

    Parameters
    ----------
    mechanism : Mechanism
    known : mapping, optional
        Parameters whose value is known.

    Raises
    ------
    InputError
        If a term does not separate into parameters and motion.

    Examples
    --------
    >>> from harness.physics.models import cart_pole
    >>> lumped(cart_pole()).names
    ('mc + mp', 'l**2*mp', 'l*mp', 'bx', 'btheta')
    """
    if isinstance(mechanism, ArmMechanism) and not mechanism.symbolic:
        generated = ArmLumps(mechanism, known or {})
        return LumpedModel(mechanism, generated.split, dict(known or {}), generated=generated)
    return LumpedModel(mechanism, split(mechanism, known), dict(known or {}))


class LumpedModel:
    r"""A mechanism as ``W(q, v, a, u) pi = target``.

    Made by :func:`lumped`; the functions of an arm too large to be written out are generated and compiled. From
    ``L = L_0 + sum pi_k L_k`` and ``Q = Q_0 + sum pi_k Q_k``:

    - torque form, for every coordinate: ``d/dt dL_k/dv - dL_k/dq - Q_k``, against ``Q_0 - d/dt dL_0/dv + dL_0/dq``
      (Atkeson, An & Hollerbach 1986);
    - energy form, one row for an interval: ``Delta(v dL_k/dv - L_k) - int Q_k v dt`` against the work of ``Q_0``
      (Gautier & Khalil 1988): no acceleration is needed;
    - momentum form, for every coordinate, averaged with a test function phi: ``-int phi' dL_k/dv dt - int phi (dL_k/dq
      + Q_k) dt`` against ``int phi Q_0 dt``: the weak form, no acceleration either.

    Attributes
    ----------
    mechanism : Mechanism
    names : tuple of str
        The lumped parameters as text, ``"m*l**2"``; then those of force columns.
    combinations : tuple of sympy expression
        The same as expressions.
    k, n : int
        Number of lumped parameters and of coordinates.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        parts: Split,
        known: Mapping[str, float],
        extra: tuple[tuple[tuple[str, ...], ForceColumns], ...] = (),
        generated: ArmLumps | None = None,
    ) -> None:
        self._generated = generated
        self.mechanism, self.parts, self.known, self._extra = mechanism, parts, dict(known), extra
        self.combinations = parts.combinations
        self.n = len(mechanism.q)
        own = tuple(str(combination) for combination in parts.combinations) if generated is None else generated.names
        self.names = own + tuple(name for names, _ in extra for name in names)
        self.k = len(self.names)
        self._functions: dict[str, Callable[..., list[FloatArray]]] = {}

    # ---- values --------------------------------------------------------------------------------------------------

    def values(self, parameters: Mapping[str, float]) -> FloatArray:
        """Return the lumped parameters (k,) of given parameters; those of force columns are 0.

        Raises
        ------
        InputError
            If a parameter is missing.

        Examples
        --------
        >>> from harness.physics.models import cart_pole
        >>> lumped(cart_pole()).values({"mc": 10, "mp": 1, "l": 0.5, "bx": 0, "btheta": 0.1}).tolist()
        [11.0, 0.25, 0.5, 0.0, 0.1]
        """
        needed, function = self._values
        missing = sorted(set(needed) - set(parameters))
        if missing:
            raise InputError(
                f"parameters of {self.mechanism.name}",
                expected=", ".join(sorted(needed)),
                got=", ".join(sorted(parameters)) or "none",
                remedy=f"give {', '.join(missing)}",
            )
        found = [float(value) for value in function(*(float(parameters[name]) for name in needed))]
        return np.array(found + [0.0] * (self.k - len(found)))

    def to_parameters(
        self, values: Mapping[str, float], *, start: Mapping[str, float] | None = None
    ) -> dict[str, float]:
        """Return physical parameters whose lumped values come closest to given ones (relative least squares).

        Parameters
        ----------
        values : mapping
            Lumped parameters by name; those that are not given are free.
        start : mapping, optional
            Where to start; the mechanism's values otherwise. What the lumped values leave open stays near it.

        Examples
        --------
        >>> from harness.physics.models import cart_pole
        >>> model = lumped(cart_pole(), known={"bx": 0.0, "btheta": 0.1})
        >>> found = model.to_parameters({"mc + mp": 11.0, "l**2*mp": 0.25, "l*mp": 0.5})
        >>> [round(found[name], 6) for name in ("mc", "mp", "l")]
        [10.0, 1.0, 0.5]
        """
        from scipy.optimize import least_squares

        parameters = {parameter.name: parameter for parameter in self.mechanism.parameter_list()}
        result = {name: parameter.value for name, parameter in parameters.items()}
        result.update(self.known)
        result.update(start or {})
        symbols = {str(symbol): symbol for symbol in self.mechanism.p}
        used = {str(symbol) for combination in self.combinations for symbol in combination.free_symbols}
        free = [n for n in symbols if n in used and not parameters[n].fixed and n not in self.known]
        rows = [
            (combination, values[name])
            for combination, name in zip(self.combinations, self.names, strict=False)
            if name in values
        ]
        if not free or not rows:
            return result
        held = {symbols[name]: result[name] for name in symbols if name not in free}
        function = _evaluated(
            tuple(symbols[name] for name in free), tuple(combination.subs(held) for combination, _ in rows)
        )
        wanted = np.array([value for _, value in rows])
        size = np.maximum(np.abs(wanted), 1e-9 * np.abs(wanted).max(initial=1e-300))
        # A lumped value of the wrong sign cannot be reached by positive parameters: then none is forced to be.
        positive = [parameters[name].positive and result[name] > 0 for name in free]
        logarithmic = np.array(positive, dtype=bool)

        def unpacked(z: FloatArray) -> FloatArray:
            return np.where(logarithmic, np.exp(np.clip(z, -60, 60)), z)

        first = np.array([np.log(result[n]) if lg else result[n] for n, lg in zip(free, logarithmic, strict=True)])

        def miss(z: FloatArray) -> FloatArray:
            near = 1e-9 * (z - first)
            return np.concatenate([(np.array(function(*unpacked(z)), dtype=float) - wanted) / size, near])

        best = least_squares(miss, first, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000)
        result.update(zip(free, unpacked(best.x).tolist(), strict=True))
        return result

    def with_force_columns(self, names: Sequence[str], columns: ForceColumns) -> LumpedModel:
        """Return the model with more forces, each linear in a parameter of its own (a candidate effect).

        Parameters
        ----------
        names : sequence of str
            One for each new parameter.
        columns : callable
            ``columns(q, v, u, t) -> (N, n, len(names))``, forces *on* the coordinates.
        """
        extra = (*self._extra, (tuple(names), columns))
        return LumpedModel(self.mechanism, self.parts, self.known, extra, self._generated)

    # ---- the functions of the motion -----------------------------------------------------------------------------

    def regressor(
        self, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray | None = None, t: FloatArray | None = None
    ) -> FloatArray:
        """Return W (N n, k), samples in order and in each the coordinates; of arrays (N, n), u (N, nu), t (N,)."""
        q, v, u, t, a = self._arrays(q, v, u, t, a)
        (rows,) = self._function("torque")(q, v, u, t[:, None], a)
        own = rows.reshape(q.shape[0], self.n, -1)
        return self._widened(own, -1.0, q, v, u, t).reshape(-1, self.k)

    def target(
        self, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray | None = None, t: FloatArray | None = None
    ) -> FloatArray:
        """Return the known side of the torque form (N n,)."""
        q, v, u, t, a = self._arrays(q, v, u, t, a)
        (rows,) = self._function("torque_known")(q, v, u, t[:, None], a)
        return np.asarray(rows.reshape(-1))

    def energy(self, q: FloatArray, v: FloatArray, t: FloatArray | None = None) -> FloatArray:
        """Return the energies E_k (N, k) that the lumped parameters multiply (0 for force columns)."""
        q, v, u, t, _ = self._arrays(q, v, None, t, None)
        own = self._function("energy")(q, v, u, t[:, None])[0]
        return np.hstack([own, np.zeros((q.shape[0], self.k - own.shape[1]))])

    def momentum(self, q: FloatArray, v: FloatArray, t: FloatArray | None = None) -> FloatArray:
        """Return the momenta dL_k/dv (N, n, k)."""
        q, v, u, t, _ = self._arrays(q, v, None, t, None)
        own = self._function("momentum")(q, v, u, t[:, None])[0].reshape(q.shape[0], self.n, -1)
        return np.concatenate([own, np.zeros((*own.shape[:2], self.k - own.shape[2]))], axis=2)

    def force(
        self, q: FloatArray, v: FloatArray, u: FloatArray | None = None, t: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the rates of the momenta: dL_k/dq + Q_k (N, n, k), and the known dL_0/dq + Q_0 (N, n)."""
        q, v, u, t, _ = self._arrays(q, v, u, t, None)
        own, known = self._function("force")(q, v, u, t[:, None])
        return self._widened(own.reshape(q.shape[0], self.n, -1), 1.0, q, v, u, t), known

    # ---- equations of a record -----------------------------------------------------------------------------------

    def torque_rows(
        self, t: FloatArray, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return W (N n, k) and the target (N n,) of a record."""
        return self.regressor(q, v, a, u, t), self.target(q, v, a, u, t)

    def energy_rows(
        self,
        t: FloatArray,
        q: FloatArray,
        v: FloatArray,
        u: FloatArray | None = None,
        *,
        samples: int = 1,
        intersample: Literal["zoh", "smooth"] = "zoh",
    ) -> tuple[FloatArray, FloatArray]:
        """Return one equation for every interval of so many samples: (M, k) and (M,).

        Parameters
        ----------
        t : array (N,)
            Need not be uniform.
        q, v : array (N, n)
        u : array (N, nu), optional
        samples : int
            Length of an interval.
        intersample : {"zoh", "smooth"}
            Input held over the sample, or moving smoothly through the samples (then integrals use cubic splines).
        """
        own, known = self._power(t, q, v, u)
        energy = self.energy(q, v, t)
        lagrangian = self._known_energy(q, v, t)
        gain = energy[samples:] - energy[:-samples]
        work, given = self._integrated(t, own, known, samples, intersample, lambda s: self._power(t, q, v, s), u)
        return gain - work, given - (lagrangian[samples:] - lagrangian[:-samples])

    def momentum_rows(
        self,
        t: FloatArray,
        q: FloatArray,
        v: FloatArray,
        u: FloatArray | None = None,
        *,
        samples: int = 51,
        hop: int | None = None,
        intersample: Literal["zoh", "smooth"] = "zoh",
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weak form: for every coordinate one equation for each test function, (M n, k) and (M n,).

        Parameters
        ----------
        t, q, v, u, intersample
            As in :meth:`energy_rows`.
        samples : int
            Width of a test function. With 1 the plain momentum equation from sample to sample is returned.
        hop : int, optional
            Samples from a test function to the next; by default they overlap by three quarters.
        """
        momentum = self.momentum(q, v, t)
        known_momentum = self._known_momentum(q, v, t)
        if samples <= 1:
            own, known = self._forces_flat(q, v, u, t)
            work, given = self._integrated(t, own, known, 1, intersample, lambda s: self._forces_flat(q, v, s, t), u)
            gain = np.diff(momentum, axis=0) - work.reshape(-1, self.n, self.k)
            return gain.reshape(-1, self.k), (given - np.diff(known_momentum, axis=0)).reshape(-1)
        rows, targets = [], []
        pushes, pushed_known = self._force_means(q, v, u, t, intersample)
        hop = hop or max(1, samples // 4)
        for first in range(0, t.shape[0] - samples + 1, hop):
            part = slice(first, first + samples)
            test_function, derivative, weight = test_function_on(t[part])
            rows.append(
                -np.einsum("s,sik->ik", derivative * weight, momentum[part])
                - jumping_mean(test_function, pushes, part, t)
            )
            pushed = jumping_mean(test_function, pushed_known, part, t) + np.einsum(
                "s,si->i", derivative * weight, known_momentum[part]
            )
            targets.append(pushed)
        if not rows:
            raise FitError(
                "record too short for the weak form",
                expected=f"at least {samples} samples",
                got=str(t.shape[0]),
                remedy="shorten the test functions (samples=...) or record longer",
            )
        return np.concatenate(rows), np.concatenate(targets)

    def solve(
        self, rows: FloatArray, target: FloatArray, *, weights: FloatArray | None = None, tolerance: float = 1e-8
    ) -> LumpedFit:
        """Return the lumped parameters by least squares, those that the rows do not determine left out.

        Parameters
        ----------
        rows : array (M, k)
        target : array (M,)
        weights : array (M,), optional
            1 / standard deviation of each row.
        tolerance : float
            Relative size below which a direction counts as missing; see
            :func:`harness.physics.lumps.identifiability.identifiability`.

        Raises
        ------
        FitError
            If nothing is determined, or a number is not finite.
        """
        return _least_squares(rows, target, self.names, self.mechanism.name, weights=weights, tolerance=tolerance)

    # ---- inside --------------------------------------------------------------------------------------------------

    @cached_property
    def _values(self) -> tuple[tuple[str, ...], Callable[..., list[Any]]]:
        """Return the names that the combinations need, and the function from their values to the combinations'."""
        symbols = sorted({symbol for combination in self.combinations for symbol in combination.free_symbols}, key=str)
        return tuple(map(str, symbols)), sp.lambdify(symbols, list(self.combinations), "math")

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_values"}

    def _arrays(
        self, q: Any, v: Any, u: Any, t: Any, a: Any
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return float arrays of the right shapes, or refuse them."""
        q = np.asarray(q, dtype=float)
        nu = len(self.mechanism.u)
        n = q.shape[0] if q.ndim else 0
        given = {
            "q": (q, (n, self.n)),
            "v": (np.asarray(v, dtype=float), (n, self.n)),
            "u": (np.zeros((n, nu)) if u is None else np.asarray(u, dtype=float), (n, nu)),
            "t": (np.zeros(n) if t is None else np.asarray(t, dtype=float), (n,)),
            "a": (np.zeros((n, self.n)) if a is None else np.asarray(a, dtype=float), (n, self.n)),
        }
        for name, (array, shape) in given.items():
            if array.shape != shape:
                raise InputError(
                    f"{name} of {self.mechanism.name}",
                    expected=f"shape {shape}",
                    got=str(array.shape),
                    remedy="put time on the first axis and one coordinate or input in each column",
                )
        q, v, u, t, a = (array for array, _ in given.values())
        return q, v, u, t, a

    def _widened(self, own: FloatArray, sign: float, q: Any, v: Any, u: Any, t: Any) -> FloatArray:
        """Return (N, n, k): the columns of the mechanism and those of added forces."""
        parts = [own]
        for names, columns in self._extra:
            added = np.asarray(columns(q, v, u, t), dtype=float)
            if added.shape != (q.shape[0], self.n, len(names)):
                raise InputError(
                    f"force columns {', '.join(names)}",
                    expected=f"shape {(q.shape[0], self.n, len(names))}",
                    got=str(added.shape),
                    remedy="return one force for each sample, coordinate and parameter",
                )
            parts.append(sign * added)
        return np.concatenate(parts, axis=2)

    def _function(self, name: str) -> Callable[..., list[FloatArray]]:
        """Return one of the functions of the motion; all are built at once when the first is needed."""
        if not self._functions:
            known = (
                motion_functions(self.mechanism, self.parts) if self._generated is None else self._generated.functions
            )
            self._functions = dict(known)
        return self._functions[name]

    def _known_momentum(self, q: FloatArray, v: FloatArray, t: FloatArray) -> FloatArray:
        q, v, u, t, _ = self._arrays(q, v, None, t, None)
        return self._function("known")(q, v, u, t[:, None])[1]

    def _known_energy(self, q: FloatArray, v: FloatArray, t: FloatArray) -> FloatArray:
        q, v, u, t, _ = self._arrays(q, v, None, t, None)
        return self._function("known")(q, v, u, t[:, None])[0][:, 0]

    def _power(self, t: Any, q: Any, v: Any, u: Any) -> tuple[FloatArray, FloatArray]:
        """Return the power of the forces that are not in L: of each parameter (N, k), and known (N, 1)."""
        q, v, u, t, _ = self._arrays(q, v, u, t, None)
        own, known = self._function("generalized")(q, v, u, t[:, None])
        wide = self._widened(own.reshape(q.shape[0], self.n, -1), 1.0, q, v, u, t)
        return np.einsum("sik,si->sk", wide, v), np.einsum("si,si->s", known, v)[:, None]

    def _forces_flat(self, q: Any, v: Any, u: Any, t: Any) -> tuple[FloatArray, FloatArray]:
        own, known = self.force(q, v, u, t)
        return own.reshape(own.shape[0], -1), known

    def _force_means(
        self, q: Any, v: Any, u: Any, t: Any, intersample: str
    ) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Return forces just after and just before every sample: they differ where a held input jumps."""
        after = self.force(q, v, u, t)
        if u is None or intersample == "smooth" or np.asarray(u).shape[1] == 0:
            return (after[0], after[0]), (after[1], after[1])
        late = np.vstack([u[:1], u[:-1]])
        before = self.force(q, v, late, t)
        return (after[0], before[0]), (after[1], before[1])

    def _integrated(
        self, t: FloatArray, own: FloatArray, known: FloatArray, samples: int, intersample: str, at: Any, u: Any
    ) -> tuple[FloatArray, FloatArray]:
        """Return the integrals of (N, k) and (N, j) over intervals of so many samples."""
        if intersample == "smooth" or u is None or np.asarray(u).shape[1] == 0:
            from scipy.interpolate import CubicSpline

            both = np.hstack([own, known])
            area = CubicSpline(t, both).antiderivative()(t)
        else:
            # The input jumps at the samples: each interval sees its own input at both ends.
            u = np.asarray(u, dtype=float)
            end_own, end_known = at(np.vstack([u[:1], u[:-1]]))
            start, end = np.hstack([own, known]), np.hstack([end_own, end_known])
            step = np.diff(t)[:, None]
            area = np.vstack([np.zeros(start.shape[1]), np.cumsum(0.5 * step * (start[:-1] + end[1:]), axis=0)])
        gained = area[samples:] - area[:-samples]
        split_at = own.shape[1]
        found = gained[:, split_at:]
        return gained[:, :split_at], found[:, 0] if found.shape[1] == 1 and own.shape[1] == self.k else found


@lru_cache(maxsize=64)
def _evaluated(symbols: tuple[sp.Symbol, ...], expressions: tuple[sp.Expr, ...]) -> Any:
    """Return expressions as a function of numbers: a search asks for the same ones again and again."""
    return sp.lambdify(symbols, expressions, "numpy")


def _least_squares(
    rows: FloatArray,
    target: FloatArray,
    names: Sequence[str],
    model: str,
    *,
    weights: FloatArray | None = None,
    tolerance: float = 1e-8,
) -> LumpedFit:
    """Return the lumped parameters; see :meth:`harness.physics.LumpedModel.solve`."""
    if weights is not None:
        rows, target = rows * weights[:, None], target * weights
    if not (np.isfinite(rows).all() and np.isfinite(target).all()):
        raise FitError(
            "regression", expected="finite numbers", got="NaN or infinity", remedy="cut the record before it breaks"
        )
    found = identifiability(rows, names, tolerance=tolerance)
    if found.rank == 0:
        raise FitError(
            f"lumped parameters of {model}",
            expected="a motion that shows at least one",
            got="rows that are all zero",
            remedy="excite the plant",
        )
    kept = list(found.kept)
    part = rows[:, kept]
    size = np.linalg.norm(part, axis=0)
    solution, *_ = np.linalg.lstsq(part / size, target, rcond=None)
    residual = target - part / size @ solution
    freedom = max(len(target) - len(kept), 1)
    _, r = np.linalg.qr(part / size)
    inverse = np.linalg.inv(r) / size[:, None]
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(kept, kept)] = inverse @ inverse.T * float(residual @ residual) / freedom
    values = np.zeros(len(names))
    values[kept] = solution / size
    rms = float(np.sqrt(np.mean(residual**2)))
    return LumpedFit(dict(zip(names, values.tolist(), strict=True)), covariance, found, rms)
