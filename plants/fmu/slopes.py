"""Directional derivatives of an FMU, by the names of its variables and in SI."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from harness.errors import InputError
from harness.signals import FloatArray
from plants.fmu.archive import FmuFile, Kind
from plants.fmu.instance import Instance
from plants.fmu.variables import Port, port, unknown


def slopes(instance: Instance, unknowns: Sequence[str], knowns: Sequence[str], seed: FloatArray | None) -> FloatArray:
    """Return ``d unknowns / d knowns`` times the seed, or the whole matrix without one.

    Raises
    ------
    InputError
        If the FMU does not offer it, a name is unknown or no real scalar, or the seed does not fit.
    PlantError
        If the FMU fails to.
    """
    file = instance.file
    if not _offers(file, instance.kind):
        raise InputError(
            "directional derivatives",
            expected="an FMU with providesDirectionalDerivative",
            got="one without",
            remedy="differentiate by finite differences from snapshots",
            file=file.path,
        )
    above, below = _reals(file, tuple(unknowns)), _reals(file, tuple(knowns))
    if seed is None:
        columns = [_product(instance, above, below, row) for row in np.eye(len(below))]
        return np.column_stack(columns) if columns else np.zeros((len(above), 0))
    direction = np.asarray(seed, dtype=float)
    if direction.shape != (len(below),) or not np.isfinite(direction).all():
        raise InputError(
            "seed of a directional derivative",
            expected=f"{len(below)} finite numbers, one for each of {', '.join(knowns)}",
            got=f"shape {direction.shape}",
            remedy="correct it",
        )
    return _product(instance, above, below, direction)


@functools.lru_cache(maxsize=64)
def _offers(file: FmuFile, kind: Kind) -> bool:
    """Return whether the FMU offers them: for FMI 3.0 the archive is read for it."""
    return file.offers_slopes(kind)


@functools.lru_cache(maxsize=64)
def _reals(file: FmuFile, names: tuple[str, ...]) -> list[Port]:
    """Return the variables of these names, which must be real scalars; asked again at every sample of a run."""
    variables = {v.name: v for v in file.description.modelVariables if v.type in ("Real", "Float64")}
    found = []
    for name in names:
        if name not in variables:
            raise unknown(file, "directional derivatives", name, list(variables))
        found.append(port(file, variables[name]))
        if found[-1].size != 1:
            raise InputError(
                "directional derivatives", expected="scalars", got=f"the array {name!r}", remedy="choose others"
            )
    return found


def _product(instance: Instance, above: Sequence[Port], below: Sequence[Port], seed: FloatArray) -> FloatArray:
    """Return the derivative in one direction, in SI."""
    try:
        raw = instance.fmu.getDirectionalDerivative(
            [one.variable.valueReference for one in above],
            [one.variable.valueReference for one in below],
            [value / one.scale for value, one in zip(seed.tolist(), below, strict=True)],
        )
    except Exception as error:
        raise instance.failure("the directional derivative cannot be had", error) from error
    return np.array([one.scale * value for one, value in zip(above, raw, strict=True)])
