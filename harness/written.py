"""The equations of any physical model, by name or fitted: what ``sysid equations`` prints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.data.whole_files import whole_file
from harness.errors import InputError
from harness.export.equations import Form, written_model
from harness.fitted import load_model

__all__ = ["equations"]


def equations(
    model: Any, *, form: Form = "text", out: str | Path | None = None, force: bool = False, **options: Any
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
        If it is no model of equations, or too large to be read in symbols (then Python and C are written).

    Examples
    --------
    >>> print(equations("pendulum").splitlines()[3])
      J*theta'' + b*theta' + mgl*sin(theta) = u
    """
    given = load_model(model, **options) if isinstance(model, str | Path) else model
    given = getattr(given, "model", given)  # what was fitted
    values = getattr(given, "parameters", None)
    made = given.system() if callable(getattr(given, "system", None)) else given
    if not hasattr(made, "generalized_forces"):
        raise InputError(
            "equations of a model",
            expected="a physical model: a name, a URDF, FILE.py:NAME, or a grey box of identify or close-loop",
            got=type(given).__name__,
            remedy="sysid list models shows names",
        )
    text = written_model(made, values if isinstance(values, Mapping) else None).write(form)
    if out is not None:
        target = Path(out)
        if target.exists() and not force:
            raise InputError("output", expected="a new file", got="it exists", remedy="give --force", file=target)
        with whole_file(target) as scratch:
            scratch.write_text(text, encoding="utf-8")
    return text
