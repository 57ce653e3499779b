"""Models beside each other, and what records show before one is chosen: spectra, orders, modes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from harness.api.records import is_table, noted
from harness.api.written import PICTURES, draw, refuse_overwrite, write_page
from harness.data.whole_files import write_json, write_text
from harness.errors import InputError

if TYPE_CHECKING:
    from harness.comparison import Comparison, OrderSelection, Spectrum
    from harness.data.recipe.chosen import Noted
    from harness.fitted import Usable
    from harness.modal import Criteria, Modes
    from harness.models.arx_orders import ArxGrid
    from harness.protocols import Model


def compare(
    models: Sequence[str | Path | Model | Usable] | Mapping[str, str | Path | Model | Usable],
    dataset: Any,
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> Comparison:
    """Compare models on one data set: fit, residuals, frequency responses.

    Parameters
    ----------
    models : sequence, or mapping by name
        What ``identify`` or :func:`load_model` returned, files that ``identify`` wrote, or folders that ``close_loop``
        wrote, which are called by the ends of their paths.
    dataset : path or table
        As for ``identify``.
    model : str, optional
        As for :func:`identify`.
    out : path, optional
        HTML page to write.
    force : bool
        Overwrite ``out`` if it exists.
    **records : Noted
        As for :func:`identify`; ``note``, a callable, gets what is odd about the records (:func:`check_data`).

    Raises
    ------
    InputError
        If a file is no model, or a model does not speak the language of the data.
    """
    from harness import comparison as room
    from harness.parts.stored import read_model

    if not models:
        raise InputError("what to compare", expected="one model or more", got="none", remedy="give a model")
    refuse_overwrite(out, force=force)
    models = [models] if isinstance(models, str | Path) else models
    given = models if isinstance(models, Mapping) else dict(zip(_names(models), models, strict=True))
    found = {name: read_model(one) if isinstance(one, str | Path) else _bare(one) for name, one in given.items()}
    spec = next(iter(found.values())).spec
    ports = (spec.inputs, spec.outputs) if is_table(dataset) and model is None else None
    data = noted(dataset, model=model, ports=ports, **records)
    result = room.compare(found, data)
    write_page(out, result)
    return result


def _names(models: Sequence[Any]) -> list[str]:
    """Return a name for each model: of files the shortest ends of their paths that tell them apart."""
    parts = [
        Path(one).absolute().with_suffix("").parts if isinstance(one, str | Path) else (f"model {k}",)
        for k, one in enumerate(models, start=1)
    ]
    if len(set(parts)) < len(parts):  # one.json beside one.toml, or one file twice
        return [str(one) if isinstance(one, str | Path) else own[-1] for one, own in zip(models, parts, strict=True)]
    while len(parts) > 1 and min(map(len, parts)) > 1 and len({own[-1] for own in parts}) == 1:
        parts = [own[:-1] for own in parts]
    names = []
    for own in parts:
        alike = [sum(other[-size:] == own[-size:] for other in parts) for size in range(1, len(own) + 1)]
        names.append("/".join(own[-1 - alike.index(1) :]))
    return names


def _bare(model: Any) -> Model:
    """Return the model inside what ``identify`` or ``load_model`` returned.

    Raises InputError if it is none.
    """
    inside: Model = getattr(model, "model", model)
    if not hasattr(inside, "spec") or not hasattr(inside, "burn_in"):
        raise InputError(
            "what to compare", expected="a path, or what identify or load_model returned", got=type(model).__name__,
            remedy="give models, and then the data set",
        )  # fmt: skip
    return inside


def spectrum(
    dataset: Any,
    *,
    model: str | None = None,
    segment: int | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> Spectrum:
    """Return the frequency response that the estimation records of a data set show.

    Parameters
    ----------
    segment : int, optional
        Samples of a segment of Welch's method.
    out : path, optional
        Picture to write: ``.svg``, ``.png`` or ``.pdf``.
    dataset, model, force, **records
        As for :func:`compare`.

    Raises
    ------
    InputError
        If the records have no input, or are too short.

    Notes
    -----
    ``response`` is in the units of ``spec`` (SI), as those of models; ``rows()`` and pictures are in the units of the
    log.
    """
    from harness import comparison as room

    refuse_overwrite(out, force=force, endings=PICTURES)
    data = noted(dataset, model=model, **records)
    found = replace(room.spectrum([one.measured() for one in data.estimation], segment=segment), recorded=data.recorded)
    draw(found.plot, out)
    return found


def order(
    dataset: Any,
    *,
    identifiers: Sequence[str] = (),
    orders: Sequence[int] = (),
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    **records: Unpack[Noted],
) -> OrderSelection:
    """Fit models of every order, score them on held-out data, and show from which order on more is no gain.

    Parameters
    ----------
    dataset : path or table
    identifiers : sequence of str
        Ids of identifiers with the option ``order``; by default ``arx``, ``n4sid`` and ``ho-kalman``.
    orders : sequence of int
        By default 1 to 12.
    options : mapping, optional
        Further options of the identifiers.
    seed : int
        For identifiers that draw random numbers.
    model, out, force, **records
        As for :func:`spectrum`.

    Raises
    ------
    InputError
        If the data or the options cannot be used, or no model of any order is found.
    """
    from harness import comparison as room

    refuse_overwrite(out, force=force, endings=PICTURES)
    data = noted(dataset, model=model, **records)
    asked: dict[str, Any] = {"identifiers": identifiers} if identifiers else {}
    if orders:
        asked["orders"] = orders
    found = room.order_selection(data, options=options, seed=seed, **asked)
    draw(found.plot, out)
    return found


def arx_orders(
    dataset: Any,
    na: Sequence[int],
    nb: Sequence[int],
    nk: Sequence[int] = (1,),
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Noted],
) -> ArxGrid:
    """Score the ARX models of a whole grid of orders, from one QR factorisation of the data.

    Parameters
    ----------
    dataset : path or table
    na, nb, nk : sequence of int
        Past outputs, coefficients of each input, delays that are tried, each with each.
    model, out, force, **records
        As for :func:`spectrum`.

    Returns
    -------
    ArxGrid
        ``best("bic")``, ``best("aic")`` and ``best("held-out")`` say what each prefers.

    Raises
    ------
    InputError
        If the data or the orders cannot be used.
    """
    from harness import comparison as room

    refuse_overwrite(out, force=force, endings=PICTURES)
    data = noted(dataset, model=model, **records)
    found = room.arx_orders(data, na, nb, nk)
    draw(found.plot, out)
    return found


def modes(
    dataset: Any,
    *,
    identifier: str | None = None,
    orders: Sequence[int] | None = None,
    criteria: Criteria | None = None,
    window: int | None = None,
    options: Mapping[str, Any] | None = None,
    model: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **records: Unpack[Noted],
) -> Modes:
    """Return the modes of vibration that a data set determines; see :func:`harness.modal.identify_modes`.

    Parameters
    ----------
    dataset : path or table
        As for ``identify``; estimation and validation records are used alike, as nothing is judged. A table whose
        ``input`` is ``["none"]`` is the answer to unknown excitation.
    identifier, orders, criteria, window, options, seed, progress
        As for :func:`harness.modal.identify_modes`.
    out : path, optional
        Folder to write: the page ``modes.html``, ``modes.json``, and the pictures as SVG.
    model, force, **records
        As for :func:`compare`.

    Raises
    ------
    InputError
        If the data or the options cannot be used.
    """
    from harness.modal import identify_modes

    folder = None if out is None else Path(out)
    if folder is not None and folder.exists() and not force:
        raise InputError(
            "the output exists", expected="a new folder", got="an existing one", remedy="--force", file=folder
        )
    data = noted(dataset, model=model, **records)
    found = identify_modes(
        (*data.estimation, *data.validation),
        name=data.name,
        identifier=identifier,
        orders=orders,
        criteria=criteria,
        window=window,
        options=options,
        seed=seed,
        progress=progress,
    )
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "modes.json", found.to_dict())
        write_text(folder / "modes.html", found.html())
        for name, plot in (("stabilisation", found.plot), ("shapes", found.plot_shapes), ("motion", found.plot_motion)):
            draw(plot, folder / f"{name}.svg")
    return found
