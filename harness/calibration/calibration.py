"""What a calibration found: values with intervals, errors before and after, what the data do not tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.errors import printable
from harness.models.estimate import Estimate
from harness.physics.definition.parameters import FarOff, Parameter, far_off
from harness.signals import PlantSpec
from harness.units import own_unit, told

Errors = Mapping[str, tuple[float, float]]
"""By output: rms of a free run, and the same over the deviation of the record (NRMSE); NaN where it breaks."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of :func:`harness.calibration.calibrate`.

    Attributes
    ----------
    model : Path
    kind : str
        ``"fmu"`` or ``"system"``.
    parameters, before : dict
        Calibrated values, and the model's own, by name in SI.
    keys : dict
        How the plant calls the parameters.
    given : dict
        Start values that the caller set and that were not fitted.
    estimate : Estimate
        Covariance, 95 % intervals or why there are none, directions that nothing tells.
    starts : tuple of dict
        Start values of the states in each estimation record, where they were estimated.
    spec : PlantSpec
        Of the records.
    errors_before, errors_after : dict
        By use of the data and record.
    weak : tuple of str
        Directions that the data hardly tell.
    reached : (int, int)
        How many of how many searches ended in the same minimum.
    runs : int
        Simulations that it took.
    notes : tuple of str
    recorded : dict
        Unit by channel in which the data came; what is not there is in that of the channel.
    """

    model: Path
    kind: str
    parameters: dict[str, float]
    before: dict[str, float]
    keys: dict[str, str]
    given: dict[str, float]
    estimate: Estimate
    starts: tuple[dict[str, float], ...]
    spec: PlantSpec
    errors_before: dict[str, tuple[Errors, ...]]
    errors_after: dict[str, tuple[Errors, ...]]
    weak: tuple[str, ...] = ()
    reached: tuple[int, int] = (1, 1)
    runs: int = 0
    notes: tuple[str, ...] = field(default=())
    recorded: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)

    @property
    def units(self) -> dict[str, str]:
        """Units of the parameters."""
        return dict(zip(self.estimate.names, self.estimate.units, strict=True))

    @property
    def untold(self) -> tuple[str, ...]:
        """Directions of the parameters that the data do not tell, or hardly, in words."""
        rank = self.estimate.rank
        nothing = () if rank is None or rank.full else rank.null_directions
        return self.weak if len(self.weak) > len(nothing) else nothing  # the weak ones hold those that nothing tells

    def errors(self) -> dict[str, tuple[float, str]]:
        """Return the rms over all validation records (estimation records where none validates) with its unit."""
        use = "validation" if self.errors_after.get("validation") else "estimation"
        found = {}
        for channel in self.spec.outputs:
            every = [one[channel.name][0] ** 2 for one in self.errors_after[use]]
            found[channel.name] = (float(np.sqrt(np.mean(every))), channel.unit)
        return found

    @property
    def far_from_declared(self) -> tuple[FarOff, ...]:
        """Parameters a factor of 100 and more from the model's own values: check the units of the columns."""
        names = self.estimate.names
        intervals = {name: self.estimate.interval(name) or (0.0, 0.0) for name in names}
        own = [Parameter(name, self.units[name], value) for name, value in self.before.items()]
        return far_off(own, self.parameters, intervals)

    def parameter_rows(self) -> list[dict[str, str]]:
        """Return the parameters for a table."""
        rows = []
        loose = () if self.estimate.rank is None else self.estimate.rank.undetermined
        for name, value in self.parameters.items():
            interval = self.estimate.interval(name)
            said = [] if name not in loose else ["not determined alone"]
            said += ["on a bound"] if name in self.estimate.on_bound else []
            rows.append(
                {
                    "parameter": printable(name),
                    "unit": self.units[name],
                    "before": f"{self.before[name]:.6g}",
                    "after": f"{value:.6g}",
                    "95 % interval": f"[{interval[0]:.6g}, {interval[1]:.6g}]" if interval and not said else "",
                    "note": ", ".join(said),
                }
            )
        return rows

    def error_rows(self) -> list[dict[str, str]]:
        """Return the errors before and after for a table, in the units in which the signals were recorded."""
        units = {one.name: own_unit(one, self.recorded) for one in self.spec.outputs}
        return [
            {
                "use": use,
                "run": str(run),
                "output": printable(channel.name),
                "unit": units[channel.name],
                "rms before": f"{told(was[channel.name][0], channel.unit, units[channel.name])[0]:.4g}",
                "rms after": f"{told(now[channel.name][0], channel.unit, units[channel.name])[0]:.4g}",
                "NRMSE before": f"{was[channel.name][1]:.4g}",
                "NRMSE after": f"{now[channel.name][1]:.4g}",
            }
            for use in self.errors_after
            for run, (was, now) in enumerate(zip(self.errors_before[use], self.errors_after[use], strict=True))
            for channel in self.spec.outputs
        ]

    def remarks(self) -> list[str]:
        """Return what is to be said beside the tables."""
        estimate = self.estimate
        said = [f"95 % intervals: {estimate.method}" if estimate.intervals is not None else estimate.method]
        if not estimate.converged:
            said.append(f"not converged: {estimate.message}")
        said += [f"the data do not tell: {words}" for words in self.untold]
        said.append(f"{self.reached[0]} of {self.reached[1]} searches ended in this minimum; {self.runs} simulations")
        if self.starts:
            names = ", ".join(self.starts[0])
            said.append(f"start values estimated in every record: {names}")
        return [text for text in said if text]

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""

        def plain(errors: Mapping[str, tuple[Errors, ...]]) -> dict[str, Any]:
            return {
                use: [{n: {"rms": _finite(a), "nrmse": _finite(b)} for n, (a, b) in one.items()} for one in own]
                for use, own in errors.items()
            }

        return {
            "kind": "calibration",
            "far_from_declared": [one.to_dict() for one in self.far_from_declared],
            "model": str(self.model),
            "parameters": dict(self.parameters),
            "before": dict(self.before),
            "given": dict(self.given),
            "estimate": self.estimate.to_dict(),
            "starts": [dict(one) for one in self.starts],
            "errors_before": plain(self.errors_before),
            "errors_after": plain(self.errors_after),
            "untold": list(self.untold),
            "searches": {"same": self.reached[0], "all": self.reached[1]},
            "simulations": self.runs,
            "notes": list(self.notes),
        }

    @property
    def values(self) -> dict[str, float]:
        """Values by name, those that were given and those that were found [SI]."""
        return {**self.given, **self.parameters}

    def write_ssv(self, path: str | Path) -> Path:
        """Write the calibrated values (and those that were given) as an SSV file; see :mod:`.written`."""
        from harness.calibration.written import write_ssv

        return write_ssv(self.values, self.units, path)

    def write_model(self, path: str | Path) -> Path:
        """Write a copy of the FMU or the SSP that starts from the calibrated values; see :mod:`.written`."""
        from harness.calibration.written import write_model

        return write_model(self.model, self.kind, self.values, self.units, path)

    def __str__(self) -> str:
        return f"{self.estimate}; " + "; ".join(f"the data do not tell: {words}" for words in self.untold)

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        return f"<Calibration of {self.model.name}: {values}>"

    def _repr_html_(self) -> str:
        from harness.display import page, table

        parts = [
            table(list(rows[0]), [list(row.values()) for row in rows])
            for rows in (self.parameter_rows(), self.error_rows())
            if rows
        ]
        return page(f"calibration of {self.model.name}", *parts, table(["remarks"], [[one] for one in self.remarks()]))


def _finite(number: float) -> float | None:
    """Return a number as JSON holds it: None for what is not finite."""
    return number if np.isfinite(number) else None
