"""An analysis and the thing that it looks at: a process, a plant, a model's equations, or records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

from harness import registry
from harness.api.records import load_dataset, named_columns
from harness.api.written import PICTURES, draw, refuse_overwrite
from harness.errors import InputError
from harness.fitted import load_model
from harness.options import as_options
from harness.parts.files import make_plant
from harness.rng import stream

if TYPE_CHECKING:
    from harness.data.recipe.chosen import ChosenSignals
    from harness.models.analysis import Findings, Takes


def analyse(
    name: str,
    subject: Any,
    *,
    options: Mapping[str, Any] | None = None,
    subject_options: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    force: bool = False,
    **signals: Unpack[ChosenSignals],
) -> Findings:
    """Analyse a process, a plant, a model's equations or records.

    Parameters
    ----------
    name : str
        Id of an analysis (``sysid list analyses``), which says what it looks at.
    subject : str, path, table or object
        A plant's id or file, a ``model.json``, a model's name or URDF, or a data set; or the thing itself.
    options : mapping, optional
        Of the analysis.
    subject_options : mapping, optional
        Of the plant or the model that is looked at.
    out : path, optional
        Picture to write, of an analysis that has one: ``.svg``, ``.png`` or ``.pdf``.
    seed : int
        For analyses that draw random numbers.
    force : bool
        Overwrite ``out`` if it exists.
    **signals : Signals
        As for :func:`identify`, where records are looked at.

    Raises
    ------
    InputError
        If there is no such analysis, or the subject is none that it can look at.

    Examples
    --------
    >>> analyse("bisimulation", "corridors-mdp", subject_options={"length": 4}).words[0]
    '9 states in 5 classes that no experiment tells apart within 1e-09'
    """
    from harness.models.analysis import Analysis

    refuse_overwrite(out, force=force, endings=PICTURES)
    made = cast(Analysis, registry.create("analyses", name, **as_options(options)))
    if made.takes == "data" and hasattr(made, "channels") and signals.get("output") is None:
        signals = {**signals, **named_columns(made, subject)}
    seen = _subject(made.takes, subject, as_options(subject_options), signals)
    try:
        found = made.of(seen, rng=stream("analysis", name, seed))
    finally:
        if seen is not subject and hasattr(seen, "close"):
            seen.close()
    if out is not None:
        draw(found.plot, out)
    return found


def _subject(takes: Takes, subject: Any, more: dict[str, Any], signals: ChosenSignals) -> Any:
    """Return the thing that an analysis looks at."""
    if takes == "data":
        return load_dataset(subject, **signals).dataset
    if takes == "records" and not _planned_for(subject):
        return _subject("data", subject, more, signals)
    if not isinstance(subject, str | Path):
        if takes == "maker" and not callable(subject):
            raise InputError(
                "subject of the analysis",
                expected="the name of a plant, or what makes one: a function of its options",
                got=type(subject).__name__,
                remedy="give a name from sysid list plants",
            )
        return getattr(subject, "model", subject) if takes == "records" else subject
    if takes == "records":
        found = load_model(subject, **more)
        return getattr(found, "model", found)
    if takes == "maker":
        return lambda **other: make_plant(str(subject), {**more, **other})
    if takes == "definition":
        return load_model(str(subject), **more)
    return load_model(subject).model if str(subject).endswith(".json") else make_plant(str(subject), more)


def _planned_for(subject: Any) -> bool:
    """Return True of a model whose records are planned: a fitted one, its file, or a physical one by its name."""
    if isinstance(subject, str | Path):
        known = {entry.id for entry in registry.entries("models")}
        return str(subject).endswith(".json") or str(subject) in known or ".py:" in str(subject)
    return (hasattr(subject, "spec") and hasattr(subject, "step")) or hasattr(subject, "parameter_names")
