"""What a model lacks: the closed loop on one record or many, planned before, its remainder learned after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

from harness import registry
from harness.api.records import load_dataset
from harness.api.written import refuse_overwrite
from harness.errors import InputError
from harness.options import as_options
from harness.protocols import Plant, Scenario
from harness.rng import stream
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.data.recipe.chosen import Records
    from harness.diagnosis import Report
    from harness.diagnosis.planned import Planned
    from harness.effects.effect import Effect
    from harness.learned import LearnedResidual


def close_loop(
    dataset: Any,
    *,
    out: str | Path | None = None,
    model: str | None = None,
    dictionary: str = "",
    effects: Sequence[str | Effect] = (),
    resume: bool = False,
    force: bool = False,
    step_limit: float | None = None,
    progress: Callable[[float, str], None] | None = None,
    **records: Unpack[Records],
) -> Report:
    """Find the effect that a model lacks, add it, and report the error before and after.

    Parameters
    ----------
    dataset : path, str, table or records
        ``dataset.toml``, a CSV or Parquet file, the name of a recording (``sysid list recordings``), or what
        :func:`identify` takes: a DataFrame, a mapping of arrays, a :class:`Trajectory`, a :class:`Dataset`.
    out : path, optional
        Folder for ``report.html``, ``report.json`` and ``model.json``; nothing is written without it.
    model : str, optional
        Nominal model: a built-in name, ``FILE.py:NAME``; overrides the one that the data set names.
    dictionary : str
        Which effects are given, tried and left out, such as ``"coulomb_friction(theta); *delay*?"`` or
        ``"!thermal_*"``; all are tried without it. See :class:`harness.diagnosis.wanted.Wanted`.
    effects : sequence of str or Effect
        Laws of your own beside the built-in ones, each ``FILE.py:NAME`` or made with
        :func:`harness.effects.effect.effect`.
    resume : bool
        Continue what an interrupted call left in ``out``.
    force : bool
        Overwrite a finished report in ``out``.
    step_limit : float, optional
        Longest time [s] for one step of an FMU, by default :data:`harness.supervision.patience.LONGEST`, or what its
        steps before tell.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    **records : Records
        As for :func:`identify`.

    Returns
    -------
    harness.diagnosis.Report
        Its ``data`` is the content of ``report.json``.

    Raises
    ------
    InputError
        If the data, the model or the folder cannot be used.
    PlantError
        If an FMU ends its process, which is one of its own, or a step of it does not end at the declared or fitted
        values; other values at which one does not are taken as impossible.
    """
    from harness import diagnosis
    from harness.diagnosis.dictionary import with_effects_of

    laws = with_effects_of(effects)
    loaded: Any = load_dataset(dataset, model=model, **records)
    how: dict[str, Any] = {"out": out, "resume": resume, "force": force, "progress": progress}
    how |= {"dictionary": laws, "wanted": dictionary}
    if loaded.nominal is not None and names_fmu(loaded.nominal.model):
        from harness.supervision.guarded import guarded

        what = f"the FMU {Path(loaded.nominal.model).name}"
        return cast("Report", guarded(_close_loop_patiently, loaded, step_limit, what=what, **how))
    if step_limit is not None:
        raise InputError(
            "step_limit", expected="an FMU as the nominal model", got="another model", remedy="leave it out",
            place="--step-limit",
        )  # fmt: skip
    return diagnosis.close_loop_file(loaded, **how)  # data that are read already pass through


def _close_loop_patiently(loaded: Any, step_limit: float | None, **how: Any) -> Report:
    """Close the loop around an FMU, from the process that is its own."""
    from harness import diagnosis
    from harness.supervision.patience import waiting

    with waiting(step_limit):
        return diagnosis.close_loop_file(loaded, **how)


def isolability(
    model: str,
    *,
    scenario: str,
    seed: int = 0,
    sample_time: float = 0.01,
    scenario_options: Mapping[str, Any] | None = None,
    parameters: Mapping[str, float] | None = None,
) -> Planned:
    """Show, before you measure, which effects a planned experiment can tell apart.

    Parameters
    ----------
    model : str
        Nominal model: a built-in name or ``FILE.py:NAME``; or the id of a plant that is made of equations.
    scenario : str
        Id of a registered scenario.
    seed : int
        Keys the random numbers of the scenario.
    sample_time : float
        Of the planned record [s].
    scenario_options, parameters : mapping, optional
        Options of the scenario; values of the model's parameters.

    Returns
    -------
    harness.diagnosis.planned.Planned
        The matrix, the pairs that look alike, and what the experiment cannot show.

    Raises
    ------
    InputError
        If there is no such model or scenario, or the model has no equations.
    """
    from harness.diagnosis.planned import isolability_of

    made = cast(Scenario, registry.create("scenarios", scenario, **as_options(scenario_options)))
    chosen: Any = model
    if any(entry.id == model for entry in registry.entries("plants")):
        with cast(Plant, registry.create("plants", model)) as plant:
            chosen = getattr(plant, "nominal", None)
        if chosen is None:
            raise InputError(
                f"plant {model!r} has no equations",
                expected="a model (sysid list models), FILE.py:NAME, or a plant made of equations",
                got="a simulation that shows its outputs only",
                remedy="give the nominal model that you believe in",
            )
    return isolability_of(chosen, made, parameters=parameters, sample_time=sample_time, seed=seed)


def learn_residual(
    loop: str | Path,
    dataset: Any,
    *,
    out: str | Path,
    validation: str | Path | None = None,
    undriven: Sequence[str] = (),
    coordinate: str | None = None,
    arguments: Sequence[str] | None = None,
    refit: bool = False,
    seed: int = 0,
    force: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> LearnedResidual:
    """Fit what a closed loop left unexplained by a force without a name; ``export`` takes the folder.

    Parameters
    ----------
    loop : path
        Folder that ``close_loop`` wrote.
    dataset, validation, undriven
        The data of that loop, as for ``close_loop``.
    out : path
        Folder for ``learned.html``, ``learned.json`` and, if the force helps, ``model.json``.
    coordinate, arguments, refit, progress
        See :func:`harness.physics.fitting.residual_learning.learn_residual_force`.
    seed : int
        Places the bumps.
    force : bool
        Overwrite an earlier result in ``out``.

    Raises
    ------
    InputError
        If the loop left nothing to learn, or its model takes no force.
    """
    from harness import learned as room
    from harness.parts.stored import read_model

    target = Path(out)
    refuse_overwrite(target / "learned.json" if target.is_dir() else target, force=force)
    if target.is_dir() and target.resolve() == Path(loop).resolve():
        raise InputError(
            "output folder", expected="a folder of its own", got="that of the loop", remedy="choose another --out"
        )
    model: Any = read_model(loop)
    path = registry.dataset_path(dataset)
    named = None if str(path).endswith(".toml") else getattr(getattr(model, "recipe", None), "model", None)
    loaded = load_dataset(path, model=named, validation=validation, undriven=undriven)
    return room.learn_residual(
        loop,
        model,
        loaded,
        out=out,
        coordinate=coordinate,
        arguments=arguments,
        refit=refit,
        rng=stream("learn-residual", seed),
        progress=progress,
    )
