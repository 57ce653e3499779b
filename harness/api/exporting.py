"""A model given away: as equations, as an FMU, as a package."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast

from harness.api.written import refuse_overwrite
from harness.data.whole_files import write_text
from harness.errors import refuse_unknown
from harness.fitted import load_model
from harness.trust import names_fmu


def equations(
    model: Any,
    *,
    form: Literal["text", "latex", "python", "c"] = "text",
    out: str | Path | None = None,
    force: bool = False,
    **options: Any,
) -> str:
    """Return the equations of a model: of motion, energies, lumped parameters and regressor, with units.

    Parameters
    ----------
    model : str, path, System, Mechanism, Ode or fitted model
        A name (``sysid list models``), a URDF or MJCF, ``FILE.py:NAME``; the ``model.json`` of ``identify``, or the
        folder of ``close_loop``: then with the effects that were found, and the values.
    form : {"text", "latex", "python", "c"}
        The last two are programs with the functions ``derivative``, ``output``, ``energy``, ``lumped``, ``regressor``
        and ``known``, as far as the model has them; ``regressor @ lumped = known``.
    out : path, optional
        File to write as well.
    force : bool
        Overwrite it.
    **options
        Of a model by name.

    Raises
    ------
    InputError
        If it is no model of equations, too large to be read in symbols (then Python and C are written), or the file
        exists.

    Examples
    --------
    >>> print(equations("pendulum").splitlines()[3])
      J*theta'' + b*theta' + mgl*sin(theta) = u
    """
    from harness.export.equations import written_model

    refuse_overwrite(out, force=force)
    text = written_model(load_model(model, **options) if isinstance(model, str | Path) else model).write(form)
    if out is not None:
        write_text(Path(out), text)
    return text


def export(source: str | Path, *, out: str | Path, fmi: str = "both", force: bool = False) -> list[Path]:
    """Write a model as co-simulation FMUs, a repaired FMU as an SSP package; see :func:`harness.export.export`."""
    from harness import export as room

    refuse_unknown("FMI version", fmi, ("2", "3", "both"), remedy="choose one", place="--fmi")
    target = Path(out)
    second = [target.with_name(f"{target.stem}-fmi3.fmu")] if fmi == "both" and names_fmu(target) else []
    refuse_overwrite(target, *second, force=force)
    return room.export(source, out=out, fmi=cast(Any, fmi))


export_fmu = export
"""As ``import harness`` shows it, where ``harness.export`` is the room."""
