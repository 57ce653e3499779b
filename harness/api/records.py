"""Records that a command works on: read, checked, drafted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

from harness import registry
from harness.api.written import refuse_overwrite, write_page
from harness.signals import Channel, Dataset
from harness.trust import names_fmu

if TYPE_CHECKING:
    from harness.data import LoadedDataset
    from harness.data.oddities import DataCheck
    from harness.data.recipe.chosen import ChosenSignals, Records


def load_dataset(
    dataset: Any,
    *,
    model: str | None = None,
    validation: Any = None,
    ports: tuple[Sequence[Channel], Sequence[Channel]] | None = None,
    undriven: Sequence[str] = (),
    **signals: Unpack[ChosenSignals],
) -> LoadedDataset:
    """Read a data set, or a recording by its name, check it, and convert it to SI units.

    Parameters
    ----------
    dataset : path, str, table or records
        The name of a recording (``sysid list recordings``), or what :func:`harness.data.load_dataset` reads.
    model : str, optional
        Nominal model that names the ports.
    validation : path or table, optional
        Validation data beside a bare file or table; without them the last third validates.
    undriven : sequence of str
        Inputs of the model that nothing drove; any other must be recorded.
    ports, **signals
        See there.

    Returns
    -------
    harness.data.LoadedDataset
        What was noticed stands in ``dataset.warnings``.

    Raises
    ------
    InputError
        If there is no such recording, or a file, column, unit, time axis or value cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(90) * 0.1
    >>> found = load_dataset({"t [s]": t, "u [N m]": np.sin(t), "theta [rad]": np.cos(t)}, model="pendulum")
    >>> found.dataset.spec.sample_time
    0.1
    """
    from harness import data

    path = registry.dataset_path(dataset)
    return data.load_dataset(path, model=model, validation=validation, ports=ports, undriven=undriven, **signals)


def check_data(
    dataset: Any,
    *,
    model: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    **records: Unpack[Records],
) -> DataCheck:
    """Find faults in the records of a data set; see :mod:`harness.data.oddities`.

    Every command that reads records does the same, and keeps out of its fits what is no reading.

    Parameters
    ----------
    dataset, model
        As for ``identify``. With a nominal model given by equations, these are asked about the inputs too.
    out : path, optional
        HTML page to write, the odd rows marked in pictures.
    force : bool
        Overwrite ``out`` if it exists.
    **records : Records
        As for :func:`identify`.

    Raises
    ------
    InputError
        If the data cannot be used at all.
    """
    from harness.data.oddities import DataCheck
    from harness.diagnosis.records.inputs_check import inputs_checked
    from harness.physics.arms.arm import is_arm

    refuse_overwrite(out, force=force)
    path = registry.dataset_path(dataset)
    loaded = load_dataset(path, model=model, **records)
    data, nominal = loaded.dataset, loaded.nominal
    if nominal is not None and not names_fmu(nominal.model) and not is_arm(nominal.model):
        system = loaded.system()
        data = inputs_checked(system, loaded.for_system(system))
    found = DataCheck(data)
    write_page(out, found)
    return found


def new_dataset(
    files: Sequence[str | Path],
    *,
    model: str | None = None,
    out: str | Path = "dataset.toml",
    sheet: str | None = None,
    input: str | Sequence[str] = (),
    output: str | Sequence[str] = (),
    force: bool = False,
) -> Path:
    """Write a dataset.toml drafted from files of data (``sysid new dataset FILE...``).

    Parameters
    ----------
    files : sequence of path
        One for each run; the first is for estimation, the others validate.
    model : str, optional
        Nominal model, whose ports name the columns.
    out : path
    sheet : str, optional
        Of Excel workbooks.
    input, output : str or sequence of str
        Channels that are inputs and outputs, where their titles are no ports of the model.
    force : bool
        Overwrite it.

    Raises
    ------
    InputError
        If a file cannot be read or holds no such channel, or ``out`` exists.
    """
    from harness.data.recipe.draft import draft_dataset

    out = Path(out)
    refuse_overwrite(out, force=force)
    inputs, outputs = ([names] if isinstance(names, str) else list(names) for names in (input, output))
    text = draft_dataset(files, model=model, folder=out.parent, sheet=sheet, inputs=inputs, outputs=outputs)
    out.write_text(text, encoding="utf-8")
    return out


def noted(dataset: Any, note: Callable[[str], None] | None = None, **how: Any) -> Dataset:
    """Return the records of a data set, and tell what is odd about them."""
    from harness.data.oddities import lines

    data = load_dataset(dataset, **how).dataset
    for text in lines(data.oddities or ()) if note is not None else ():
        cast(Any, note)(text)
    return data


def is_table(dataset: Any) -> bool:
    """Return True for a table whose columns someone has to name, False where a file or a record says it itself."""
    if isinstance(dataset, str | Path):
        return Path(registry.dataset_path(dataset)).suffix != ".toml"
    return isinstance(dataset, Mapping) or hasattr(dataset, "columns") or hasattr(dataset, "data_vars")


def named_columns(part: Any, subject: Any) -> ChosenSignals:
    """Return the columns of a bare table that an analysis or an identifier names: what it needs, and what is there."""
    from harness.data.tables.table import FORMATS, open_table, suffix_of

    path = registry.dataset_path(subject)
    if not isinstance(path, str | Path) or suffix_of(Path(path)) not in FORMATS:
        return {}
    needed, useful = part.channels()
    table = open_table(Path(path), {})
    there = [table.split(title)[0] for title in table.titles]
    driven = part.inputs() if hasattr(part, "inputs") else "none"
    return {"input": driven, "output": [*needed, *(name for name in useful if name in there)]}
