"""What the loop needs of a way to compare model and data: fit, residuals, Jacobian, columns of an effect.

Two ways implement it: :class:`harness.diagnosis.output_form.OutputForm` simulates and compares outputs (any model);
:class:`harness.diagnosis.equation_form.EquationForm` compares forces on measured motion (inverse dynamics).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from harness.diagnosis.descent import Bar
from harness.diagnosis.intervals import Interval, block_interval
from harness.effects.effect import Placed
from harness.signals import FloatArray

__all__ = ["Fitted", "Form", "fit_here", "placed_name", "rms", "stacked", "vanished", "weighted_rms"]


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model fitted to the estimation runs and tried on the validation runs.

    Attributes
    ----------
    effects : tuple of Placed
        What was added to the nominal model.
    system : System
        Nominal model with the effects.
    values : dict
        All parameters by full name.
    free : tuple of str
        The fitted ones, in the order of the Jacobian.
    converged : bool
    message : str
        How the fit ended.
    estimation, validation : tuple of array (N_i, ny)
        Weighted residuals (each column over its weight).
    jacobian : tuple of array (N_i, ny, len(free))
        Weighted derivative of the estimation outputs, what the initial states can do taken out.
    refitted : dict
        Parameters of the validation records themselves (phase, instant of a change).
    record : dict
        What :meth:`Form.solve` returned.
    unaided : tuple of array (N_i, ny)
        The validation residual with hidden states of effects starting where the effects say, not where they fit best: a
        slow hidden state that is fitted anew in every window is a free force. Empty without hidden states.
    starts : tuple of array (L_w * ny, k_w)
        For each estimation window an orthonormal basis of what its initial state can do. Empty where nothing is fitted.
    """

    effects: tuple[Placed, ...]
    system: Any
    values: dict[str, float]
    free: tuple[str, ...]
    converged: bool
    message: str
    estimation: tuple[FloatArray, ...]
    validation: tuple[FloatArray, ...]
    jacobian: tuple[FloatArray, ...]
    refitted: dict[str, float] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict, repr=False)
    unaided: tuple[FloatArray, ...] = ()
    starts: tuple[FloatArray, ...] = ()

    @property
    def finite(self) -> bool:
        """True if both residuals are finite."""
        return all(np.isfinite(one).all() for one in (*self.estimation, *self.validation))

    def intervals(self, *, adapt: bool = True) -> dict[str, Interval]:
        """Return the 95 % interval of every free parameter; see :func:`harness.diagnosis.intervals.block_interval`.

        A parameter of the nominal model that the fit has driven to 0, its lower bound, does not move any more: the
        intervals of the others are those of a fit without it.
        """
        if not self.free:
            return {}
        lost = vanished(self.system, self.values)
        gone = [name in lost for name in self.free]
        found: dict[str, Interval] = {}
        for chosen in ([not one for one in gone], [True] * len(gone)):
            names = [name for name, use in zip(self.free, chosen, strict=True) if use]
            if names and not found.keys() >= set(names):
                columns = [one[:, :, np.array(chosen)] for one in self.jacobian]
                values = np.array([self.values[name] for name in names])
                intervals = block_interval(values, columns, self.estimation, starts=self.starts, adapt=adapt)
                for name, one in zip(names, intervals, strict=True):
                    found.setdefault(name, one)
        return {name: found[name] for name in self.free}


class Form(Protocol):
    """A way to compare a model with the data."""

    @property
    def nominal(self) -> Any:
        """The nominal system."""
        ...

    @property
    def sample_time(self) -> float:
        """Of the records [s]."""
        ...

    @property
    def weights(self) -> FloatArray:
        """What residual columns are divided by (ny,)."""
        ...

    @property
    def floors(self) -> tuple[float | None, ...]:
        """Noise floor of each column over its weight; None where unknown."""
        ...

    @property
    def columns(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each residual column."""
        ...

    def judges(self, placed: Placed) -> bool:
        """Return True if this form can judge the effect at all."""
        ...

    def solve(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        *,
        seed: int,
        bar: Bar | None = None,
    ) -> dict[str, Any]:
        """Fit the nominal model with effects from one or more starts (full parameter names); the best end counts.

        A form whose fits take long may give up one that does not come up to the bar.

        Returns a record of plain numbers that :meth:`evaluate` understands and that JSON can hold, with at least
        ``values``, ``converged``, ``message``, ``cost``.
        """
        ...

    def evaluate(self, effects: Sequence[Placed], record: Mapping[str, Any]) -> Fitted:
        """Return the residuals and the Jacobian of a record."""
        ...

    def responses(self, base: Fitted, placed: Placed, values: Mapping[str, float]) -> tuple[FloatArray, ...] | None:
        """Return what adding the effect at these values does to the estimation outputs.

        Arrays (N_i, ny, 1 + k), weighted, initial states taken out: the difference, then the derivatives with respect
        to the effect's free parameters. None where the model with the effect cannot be simulated.
        """
        ...

    def clean(self, base: Fitted, parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Take out of columns (N_i, ny, k) of the estimation runs what the initial states can do."""
        ...


def vanished(system: Any, values: Mapping[str, float]) -> list[str]:
    """Return the free parameters of a nominal model that cannot be negative and have gone to 0."""
    return [
        one.name
        for one in system.parameters
        if one.name in values
        and "." not in one.name and not one.fixed and one.minimum == 0.0
        and 0.0 <= values[one.name] < 1e-3 * abs(one.value)
    ]  # fmt: skip


def fit_here(form: Form, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], *, seed: int = 0) -> Fitted:
    """Solve and evaluate in this process."""
    return form.evaluate(effects, form.solve(effects, starts, seed=seed))


def placed_name(effects: Sequence[Placed]) -> str:
    """Return effects as a key such as ``"coulomb_friction@q + force_bias@q"``; ``"nominal"`` for none."""
    return " + ".join(sorted(str(one) for one in effects)) or "nominal"


def stacked(parts: Sequence[FloatArray]) -> FloatArray:
    """Return columns (N_i, ny, k) as one matrix (sum N_i * ny, k)."""
    return np.concatenate([one.reshape(-1, one.shape[2]) for one in parts])


def weighted_rms(parts: Sequence[FloatArray]) -> float:
    """Return the root mean square over all samples and columns; infinite if anything is not finite."""
    value = float(np.sqrt(np.mean(np.concatenate([one.reshape(-1) for one in parts]) ** 2)))
    return value if np.isfinite(value) else float("inf")


def rms(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the root mean square of each column (ny,)."""
    return np.asarray(np.sqrt(np.mean(np.concatenate(list(parts)) ** 2, axis=0)))
