"""The closed loop as a user calls it: data and a nominal model in; a report, a page and the repaired model out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, cast

from harness.data.oddities import examined, lines, odd_pictures, oddities_data
from harness.diagnosis.algorithm import diagnose
from harness.diagnosis.diagnosis import Diagnosis
from harness.diagnosis.kinds import EquationsKind, ModelKind
from harness.diagnosis.records.inputs_check import FOUND, inputs_checked
from harness.diagnosis.records.stretches import counted, cut_alike, parted, told_of_whole
from harness.diagnosis.steps import Progress
from harness.diagnosis.systems import AnySystem, by_equations
from harness.diagnosis.wanted import Wanted
from harness.effects.effect import Effect
from harness.errors import InputError
from harness.jobs.alone import alone_in
from harness.physics.arms.arm import ArmModel, is_arm, load_arm
from harness.signals import Dataset, FloatArray
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.blackbox.system import FmuSystem
    from harness.data import LoadedDataset

JSON, HTML, MODEL, NOMINAL, EQUATIONS = "report.json", "report.html", "model.json", "nominal.fmu", "nominal.eqs"


class Definition(Protocol):
    """What makes a system: the symbolic definition of a mechanism, or equations in a file."""

    def system(self) -> AnySystem:
        """Return the system."""
        ...


@dataclass(frozen=True, eq=False)
class Report:
    """What :func:`close_loop` returns.

    Attributes
    ----------
    data : dict
        The content of ``report.json``; see :mod:`harness.diagnosis.report.evidence_json`.
    folder : Path or None
        Where ``report.json`` and ``report.html`` lie.
    model : System
        The model with the accepted effects, its parameters at their fitted values.
    """

    data: dict[str, Any]
    folder: Path | None
    model: AnySystem | ArmModel | None = None
    figures: Callable[[], Mapping[str, str]] | None = field(default=None, repr=False)
    """Draws the pictures as SVG texts by name, when they are asked for."""

    @property
    def verdict(self) -> str:
        """``effects_found``, ``nothing_missing`` or ``unexplained``."""
        return str(self.data["verdict"])

    @property
    def html(self) -> Path | None:
        """The page to read."""
        return None if self.folder is None else self.folder / HTML

    def __str__(self) -> str:
        return str(self.data["summary"])

    def __repr__(self) -> str:
        return f"<Report {self.verdict}: {self}>"

    def _repr_html_(self) -> str:
        from harness.diagnosis.report.notebook import notebook

        where = "" if self.html is None or not self.html.is_file() else str(self.html)
        return notebook(self.data, {} if self.figures is None else self.figures(), where)


class Figures:
    """The pictures of a diagnosis, drawn when they are first asked for; what leaves the process are the pictures.

    A loop around an FMU runs in a process of its own, and its report comes back from there.
    """

    def __init__(self, draw: Callable[[], dict[str, str]]) -> None:
        self._draw, self._drawn = draw, cast("dict[str, str] | None", None)

    def __call__(self) -> dict[str, str]:
        """Return the pictures as SVG texts by name."""
        if self._drawn is None:
            self._drawn = self._draw()
        return self._drawn

    def __reduce__(self) -> tuple[Any, ...]:
        return _as_drawn, (self(),)


def _as_drawn(pictures: dict[str, str]) -> Figures:
    """Return pictures that are drawn already."""
    return Figures(pictures.copy)


def close_loop(
    dataset: Dataset,
    model: AnySystem | ArmModel | Definition | str | Path,
    *,
    parameters: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
    resume: bool = False,
    force: bool = False,
    dictionary: Sequence[Effect] | None = None,
    wanted: str = "",
    name: str | None = None,
    options: Mapping[str, Any] | None = None,
    references: Sequence[Mapping[str, FloatArray]] = (),
) -> Report:
    """Find the effect that a model lacks, add it, report the error before and after.

    Parameters
    ----------
    dataset : Dataset
        Estimation and validation runs, test runs if there are any.
    model : System, ArmModel, str or path
        The nominal model, the name of a built-in one, an FMU (``FILE.fmu``), or an arm (``iiwa``, ``FILE.urdf``).
    parameters : mapping, optional
        What is known of its parameters: a start value, or a :class:`harness.physics.Parameter` (bounds, fixed). Of an
        FMU the parameters named here are calibrated; without any, all tunable ones that are not 0.
    out : path, optional
        Folder for ``report.json`` and ``report.html``; made if it is not there.
    progress : callable, optional
        Called as ``progress(fraction_done, what)``.
    resume : bool
        Continue what an interrupted call left in ``out``.
    force : bool
        Overwrite a finished report in ``out``.
    dictionary : sequence of Effect, optional
        See :func:`diagnose`.
    wanted : str
        Which of these are given, tried and left out, such as ``"coulomb_friction(theta); *delay*?"``; see
        :class:`harness.diagnosis.wanted.Wanted`.
    name : str, optional
        What the nominal model is loaded by (``NAME`` or ``FILE.py:NAME``), for ``model.json``; by default the name of
        the model.
    options : mapping, optional
        What the nominal model was loaded with beside its name, for ``model.json``.
    references : sequence of mapping, optional
        For each run of the data set the recorded signals from outside a control loop (reference, added excitation) by
        name, arrays (N,): the instruments of the test for the bias of closed-loop data.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        If the data do not fit the model, or ``out`` holds a report and neither ``resume`` nor ``force`` is given.
    """
    from harness.diagnosis.report.evidence_json import evidence_data
    from harness.diagnosis.report.evidence_page import drawn, write_evidence
    from harness.diagnosis.store import write_atomic
    from harness.supervision.workers import one_thread

    chosen = Wanted.read(wanted)
    folder = _folder(out, resume=resume, force=force)
    with alone_in(folder):
        if folder is not None and force and not resume:
            shutil.rmtree(folder / "candidates", ignore_errors=True)
        whole_runs = _looked_at(dataset)
        dataset = parted(whole_runs)
        if (arm := _arm(model)) is not None:
            from harness.diagnosis.arm.close import close_arm

            if chosen.items:
                raise InputError(
                    "the dictionary of a run on an arm",
                    expected="all of it: every joint and the whole arm have dictionaries of their own",
                    got=repr(wanted),
                    remedy="leave it out",
                )
            data, figures = close_arm(dataset, arm, folder=folder, progress=progress, dictionary=dictionary)
            return Report(data, folder, arm, figures)
        dataset = cut = counted(dataset)
        system = _system(model, parameters, dataset)
        box = is_fmu(system)
        if by_equations(system):
            dataset = replace(dataset, warnings=(*system.remarks, *dataset.warnings))
            with one_thread():
                dataset = inputs_checked(system, dataset)
        kind = _black_box() if box else EquationsKind()
        how: dict[str, Any] = {"kind": kind, "progress": progress, "dictionary": dictionary, "wanted": chosen}
        diagnosis = diagnose(dataset, system, folder=folder, **how)
        whole = diagnosis.final.model
        if by_equations(whole) and diagnosis.outcome.accepted:
            # what the model lacked may have hidden that the input is late: its equations are whole now
            final = whole.with_parameters(diagnosis.final.values)
            with one_thread():
                again = inputs_checked(final, dataset)
            if (again.runs, again.intersample) != (dataset.runs, dataset.intersample):
                dataset = again
                diagnosis = diagnose(dataset, system, **how)
        if progress is not None:
            progress(0.9, "report")
        with one_thread():
            data = evidence_data(diagnosis, cut_alike(references, whole_runs, diagnosis.dataset))
            data["oddities"] = oddities_data(told_of_whole(whole_runs, replace(dataset, runs=cut.runs), FOUND))
            figures = Figures(partial(drawn, diagnosis))
            if folder is not None:
                write_evidence(data, figures(), folder / HTML, odd_pictures(whole_runs))
        if folder is not None:
            if box:
                repaired = _repaired_fmu(diagnosis, folder)
            else:
                repaired = _repaired(diagnosis, _kept(name or system.name, folder), options or {})
            write_atomic(folder / MODEL, json.dumps(repaired, indent=1, allow_nan=False) + "\n")
            write_atomic(folder / JSON, json.dumps(data, indent=1, allow_nan=False) + "\n")
        if progress is not None:
            progress(1.0, data["summary"])
        last = diagnosis.nominal if diagnosis.misfit else diagnosis.final
        return Report(data, folder, last.model.with_parameters(last.values), figures)


def close_loop_file(
    dataset: str | Path,
    *,
    out: str | Path | None = None,
    model: str | None = None,
    validation: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
    dictionary: Sequence[Effect] | None = None,
    wanted: str = "",
) -> Report:
    """Do the same for a data set file, a bare CSV or Parquet file, or the name of a recording.

    Parameters are those of :func:`close_loop`; see :func:`harness.api.close_loop`.
    """
    from harness import registry
    from harness.data import load_dataset

    _folder(out, resume=resume, force=force)
    loaded = load_dataset(registry.dataset_path(dataset), model=model, validation=validation)
    if loaded.nominal is not None and is_arm(loaded.nominal.model):
        from harness.diagnosis.arm.close import recorded_arm

        arm: Any = recorded_arm(loaded)  # of a model the data set asks for its channels only
        return close_loop(
            loaded.for_system(arm), arm, out=out, resume=resume, force=force, progress=progress,
            dictionary=dictionary, wanted=wanted,
        )  # fmt: skip
    box = loaded.nominal is not None and names_fmu(loaded.nominal.model)
    system = loaded.system() if not box else None
    return close_loop(
        loaded.dataset if system is None else loaded.for_system(system),
        _recorded_fmu(loaded) if system is None else system,
        out=out,
        resume=resume,
        force=force,
        progress=progress,
        dictionary=dictionary,
        wanted=wanted,
        name="" if loaded.nominal is None else loaded.nominal.model,
        options=None if box else _options(loaded),
        references=loaded.references,
    )


def _looked_at(dataset: Dataset) -> Dataset:
    """Return a data set that was examined, what was found among its warnings."""
    if not isinstance(dataset, Dataset):
        raise InputError(
            "the data of a diagnosis",
            expected="a Dataset",
            got=f"a {type(dataset).__name__}",
            remedy="harness.close_loop reads files, tables and arrays",
        )
    if dataset.oddities is not None:
        return dataset
    found = examined(dataset)
    return replace(found, warnings=(*found.warnings, *lines(found.oddities or ())))


def _options(loaded: LoadedDataset) -> dict[str, Any]:
    """Return the options that a data set loads its model with."""
    from harness.data.recipe.ports import model_options

    if loaded.nominal is None:
        return {}
    spec = loaded.dataset.spec
    ports = [[channel.name for channel in side] for side in (spec.inputs, spec.outputs)]
    return model_options(loaded.nominal.model, loaded.nominal.options, *ports)


def _kept(name: str, folder: Path) -> str:
    """Return the name of a model; equations of a file are copied beside the report, which can then go anywhere."""
    from harness.diagnosis.store import write_atomic

    if Path(name).suffix != ".eqs":
        return name
    if Path(name).resolve() != (folder / EQUATIONS).resolve():
        write_atomic(folder / EQUATIONS, Path(name).read_text(encoding="utf-8-sig"))
    return EQUATIONS


def _repaired(diagnosis: Diagnosis, name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the repaired model as a grey box that ``sysid export`` reads."""
    from harness.specs import spec_to_dict

    last = diagnosis.nominal if diagnosis.misfit else diagnosis.final
    return {
        "kind": "grey-box",
        "spec": spec_to_dict(diagnosis.dataset.spec),
        "model": name,
        "options": dict(options),
        "parameters": {key: float(value) for key, value in last.model.values(last.values).items()},
        "effects": [[placed.effect.name, placed.at] for placed in last.model.effects],
        "intersample": diagnosis.dataset.intersample,
        "notes": {"verdict": diagnosis.verdict},
    }


def _arm(model: object) -> ArmModel | None:
    """Return the arm that is meant, None for any other model."""
    if isinstance(model, ArmModel):
        return model
    return load_arm(model) if isinstance(model, str | Path) and is_arm(str(model)) else None


def is_fmu(system: object) -> TypeGuard[FmuSystem]:
    """Return True for an FMU as the nominal model."""
    from harness.blackbox.system import FmuSystem

    return isinstance(system, FmuSystem)


def _black_box() -> ModelKind:
    """Return what a diagnosis does in its own way for an FMU."""
    from harness.diagnosis.fmu.kind import BlackBox

    return BlackBox()


def _repaired_fmu(diagnosis: Diagnosis, folder: Path) -> dict[str, Any]:
    """Return the repaired model as ``sysid export`` reads it, a copy of the FMU beside it."""
    from harness.specs import spec_to_dict

    last = diagnosis.nominal if diagnosis.misfit else diagnosis.final
    final = last.model
    assert is_fmu(final)
    (folder / NOMINAL).write_bytes(final.path.read_bytes())
    return {
        "kind": "fmu",
        "spec": spec_to_dict(diagnosis.dataset.spec),
        "model": NOMINAL,
        "sha256": final.digest,
        "exchanges": final.exchanges,
        "parameters": {key: float(value) for key, value in final.values(last.values).items()},
        "effects": [[placed.effect.name, placed.at] for placed in final.effects],
        "intersample": diagnosis.dataset.intersample,
        "notes": {"verdict": diagnosis.verdict},
    }


def _recorded_fmu(loaded: LoadedDataset) -> FmuSystem:
    """Return the FMU that a data set names, with what it says of the parameters."""
    from harness.diagnosis.fmu.prepare import nominal_fmu

    for port, derivative in loaded.measured:
        if derivative:
            raise InputError(
                f"derivative of {port} as an output of an FMU",
                expected="the FMU's own variable",
                got=f"derivative = {derivative}",
                remedy="name the variable with port = ... (sysid list FILE.fmu shows all)",
                file=loaded.path,
            )
    assert loaded.nominal is not None
    given = {
        name: {"value": parameter.start if parameter.value is None else parameter.value, "minimum": parameter.minimum,
               "maximum": parameter.maximum, "fixed": parameter.fixed}
        for name, parameter in loaded.nominal.parameters.items()
    }  # fmt: skip
    return nominal_fmu(loaded.nominal.model, loaded.dataset, given)


def _system(
    model: AnySystem | ArmModel | Definition | str | Path, parameters: Mapping[str, Any] | None, dataset: Dataset
) -> AnySystem:
    """Return the nominal system from a name, a file, a definition or a system."""
    if isinstance(model, str | Path) and names_fmu(model):
        from harness.diagnosis.fmu.prepare import nominal_fmu

        return nominal_fmu(model, dataset, parameters)
    made: AnySystem
    if isinstance(model, str):
        from harness.physics import load_model

        made = load_model(model)
    elif hasattr(model, "system") and not hasattr(model, "generalized_forces"):
        made = model.system()
    else:
        made = cast(AnySystem, model)
    return made.with_parameters(parameters) if parameters else made


def _folder(out: str | Path | None, *, resume: bool, force: bool) -> Path | None:
    """Return the folder for the report; refuse to overwrite a report."""
    if out is None:
        return None
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise InputError("output folder", expected="a folder", got="a file", remedy="choose another --out", file=folder)
    if (folder / JSON).exists() and not (force or resume):
        raise InputError(
            "the folder holds a report",
            expected="an empty or new folder",
            got=JSON,
            remedy="choose another --out, or --force to overwrite it",
            file=folder,
        )
    held = folder / "candidates"
    if held.is_dir() and any(held.iterdir()) and not (resume or force):
        raise InputError(
            "the folder holds an interrupted diagnosis",
            expected="an empty or new folder",
            got="finished refits without a report",
            remedy="--resume to continue it, or --force to start anew",
            file=folder,
        )
    return folder
