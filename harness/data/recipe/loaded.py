"""What a data set file says, read and checked: the records, and the model that the user believes in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.data.recipe.ports import ANY_PORTS, model_options
from harness.data.sections import NominalParameter, SourceSection
from harness.errors import InputError
from harness.signals import Dataset, FloatArray, Run
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.physics import System


@dataclass(frozen=True)
class Nominal:
    """The nominal model that a data set names.

    Parameters
    ----------
    model : str
        Built-in name, ``FILE.py:NAME`` or ``FILE.fmu``.
    options : dict
        Options of its definition, such as ``order`` of ``linear``.
    parameters : dict
        By name: known values, start values, bounds.
    analogy : bool
        True where the model's equations are meant and the units are those of the data.
    """

    model: str
    options: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, NominalParameter] = field(default_factory=dict)
    analogy: bool = False


@dataclass(frozen=True, eq=False)
class LoadedDataset:
    """A data set as its file describes it.

    Parameters
    ----------
    dataset : Dataset
        The records in SI units; inputs and outputs that were recorded, outputs in the order of ``measured``.
    nominal : Nominal or None
        The model that the file (or the caller) names.
    measured : tuple of (port, derivative)
        What each output column is: a port of the model, or its rate (1) or acceleration (2).
    references : tuple of dict
        For each run the recorded references by signal name, arrays (N,), in SI units.
    path : Path
        The file that was read.
    source : SourceSection or None
        Where a public recording comes from.
    """

    dataset: Dataset
    nominal: Nominal | None
    measured: tuple[tuple[str, int], ...]
    references: tuple[dict[str, FloatArray], ...]
    path: Path
    source: SourceSection | None = None

    def __str__(self) -> str:
        uses = [f"{len(self.dataset.using(use))} {use}" for use in ("estimation", "validation", "test")]
        model = "no nominal model" if self.nominal is None else f"nominal model {self.nominal.model}"
        return f"{self.dataset.name}: {self.dataset.spec}; {', '.join(uses)} runs; {model}"

    def __repr__(self) -> str:
        return f"<LoadedDataset {self}>"

    def _repr_html_(self) -> str:
        return self.dataset._repr_html_()

    def system(self) -> System:
        """Return the nominal model, measured as these data are, with what is known of its parameters.

        Raises
        ------
        InputError
            If the data set names no model, an FMU, or a parameter that the model does not have.
        """
        if self.nominal is None:
            raise InputError(
                "no nominal model",
                expected="a model",
                got="none",
                remedy="add [nominal] model = ..., or --model NAME",
                file=self.path,
            )
        if names_fmu(self.nominal.model):
            raise InputError(
                "an FMU has no equations",
                expected="a built-in model or FILE.py:NAME",
                got=self.nominal.model,
                remedy="close the loop with it (sysid close-loop), or write the model as equations",
                file=self.path,
            )
        from harness.physics import load_model

        spec = self.dataset.spec
        inputs = [channel.name for channel in spec.inputs]
        outputs = [channel.name for channel in spec.outputs]
        options = model_options(self.nominal.model, self.nominal.options, inputs, outputs)
        system = load_model(self.nominal.model, **options)
        plain = [channel.name for channel in system.outputs]
        if [(name, 0) for name in plain] != list(self.measured) and self.nominal.model != ANY_PORTS:
            system = system.with_outputs(list(self.measured))
        known = {channel.name: channel for channel in spec.inputs}
        system = replace(system, inputs=tuple(known.get(c.name, c) for c in system.inputs), outputs=tuple(spec.outputs))
        return system.with_parameters(self._parameters(system))

    def for_system(self, system: System) -> Dataset:
        """Return the data set with every input of a model, in its order; 0 where it is declared as undriven.

        A free swing has no recorded input: ``undriven = ["u"]`` says so.
        """
        spec = self.dataset.spec
        names = [channel.name for channel in spec.inputs]
        wanted = [channel.name for channel in system.inputs]
        if names == wanted:
            return self.dataset
        full = replace(spec, inputs=tuple(system.inputs))
        runs = []
        for run in self.dataset.runs:
            record = run.trajectory
            u = np.zeros((len(record), len(wanted)))
            for column, name in enumerate(wanted):
                if name in names:
                    u[:, column] = record.u[:, names.index(name)]
            runs.append(Run(replace(record, u=u, spec=full), run.use, run.label))
        return replace(self.dataset, runs=tuple(runs))

    def _parameters(self, system: System) -> Mapping[str, Any]:
        """Return the parameters of which something is known, as the physics room writes them."""
        from harness.physics import Parameter

        assert self.nominal is not None
        result = {}
        for name, given in self.nominal.parameters.items():
            try:
                old = system.parameter(name)
                low = old.minimum if given.minimum is None else given.minimum
                high = old.maximum if given.maximum is None else given.maximum
                value = given.value if given.value is not None else given.start
                start = float(np.clip(old.value, low, high)) if value is None else value
                result[name] = Parameter(name, old.unit, start, low, high, fixed=given.fixed or old.fixed)
            except InputError as error:
                raise error.located(file=self.path, place=f"nominal.parameters.{name}") from error
        return result
