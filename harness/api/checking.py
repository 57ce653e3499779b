"""Plug-ins and FMUs held to what they promise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from harness.api.written import refuse_overwrite, write_page

if TYPE_CHECKING:
    from harness.conformance import CheckResult
    from harness.vetting import Agreement, Vetting


def check(name: str | Path, *, limit: float | None = None) -> list[CheckResult]:
    """Check a plug-in against its contract, in a process of its own; see :func:`harness.conformance.check`.

    Parameters
    ----------
    name : str or path
    limit : float, optional
        Longest time for one check [s]; by default :data:`harness.supervision.guarded.SILENCE`.

    Raises
    ------
    InputError
        If there is no such part, or it needs options to be made.
    HarnessError
        If the part ends its process (``crashed``) or hangs (``timeout``).
    """
    from harness.supervision.guarded import guarded

    return cast("list[CheckResult]", guarded(_checked, str(name), what=str(name), silence=limit))


def vet(
    path: str | Path,
    *,
    options: Mapping[str, Any] | None = None,
    limit: float = 10.0,
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Vetting:
    """Vet an FMU before you hand it on (``sysid check X.fmu``).

    Parameters
    ----------
    path, options, limit, progress
        See :func:`harness.vetting.vet`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.

    Raises
    ------
    InputError
        If there is no such file, or an option does not fit it.
    """
    from harness import vetting

    refuse_overwrite(out, force=force)
    found = vetting.vet(path, options=options, limit=limit, progress=progress)
    write_page(out, found)
    return found


def agreement(
    run: str | Path, reference: str | Path, *, out: str | Path | None = None, force: bool = False, **asked: Any
) -> Agreement:
    """Compare the run of an FMU, or a table of a run, with a reference (``sysid check X.fmu --reference ref.csv``).

    Parameters
    ----------
    run, reference
        See :func:`harness.vetting.agreement`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.
    **asked
        ``tubes``, ``inputs``, ``options``, ``start``, ``stop``, ``step``, ``limit`` of
        :func:`harness.vetting.agreement`.

    Raises
    ------
    InputError
        If a file cannot be read, or a tube names no channel.
    PlantError
        If the FMU breaks at its start.
    """
    from harness import vetting

    refuse_overwrite(out, force=force)
    found = vetting.agreement(run, reference, **asked)
    write_page(out, found)
    return found


def _checked(name: str, *, progress: Callable[..., None]) -> list[CheckResult]:
    """Return the results of all checks, from the process that is theirs."""
    from harness import conformance

    return conformance.check(name)
