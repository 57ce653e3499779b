"""Binary tables: Parquet, MAT (v5 and v7.3), numpy, HDF5."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from harness.data.tables.cells import numbers_of, say_truths, seconds_of, with_unit
from harness.data.tables.headers import TIME_UNITS, split_header, words_of
from harness.data.tables.packing import NUMBER, refuse_large
from harness.data.tables.selectors import called_inside, parse_selector, vector
from harness.data.tables.texts import suffix_by_content
from harness.data.times.stamps import clock
from harness.errors import InputError
from harness.extras import optional
from harness.signals import FloatArray


def no_numbers(path: Path, unread: Mapping[str, str], readable: Collection[str]) -> InputError:
    """Return the refusal of a log of messages without a number in it: what to do depends on why there is none.

    - ``unread``: topics that cannot be read, with what they hold
    - ``readable``: what could be read
    """
    if unread:
        got = "none whose definition is in the log and known: "
        got += ", ".join(f"{topic}: {kind}" for topic, kind in unread.items())
        remedy = "record it with its definitions (ros2 bag record -s mcap; JSON), or convert it to CSV"
    elif readable:
        got = f"only {', '.join(sorted(readable))}"
        remedy = "record the topics that hold numbers (joint states, commands, wrenches)"
    else:
        got, remedy = "no message at all", "record again, while the topics are being published"
    expected = "topics whose messages hold numbers"
    return InputError("a log without numbers", expected=expected, got=got, remedy=remedy, file=path)


def broken(path: Path, kind: str, error: Exception) -> InputError:
    """Return the refusal of a file that its reader cannot read."""
    return InputError(
        f"not {'an' if kind in ('Excel', 'HDF5', 'MCAP', 'MDF') else 'a'} {kind} file",
        expected=f"a readable {kind} file",
        got=f"{type(error).__name__}: {error}"[:200],
        remedy=(suffix_by_content(path) if path.is_file() else None) or "check that it was copied whole",
        file=path,
    )


class ParquetFile:
    """A Parquet file; nulls are NaN, time stamps seconds from the first."""

    kind = "Parquet"

    def __init__(self, path: Path) -> None:
        import pyarrow as pa

        try:
            self._table = self._read(path)
        except InputError:
            raise
        except Exception as error:
            raise broken(path, self.kind, error) from error
        while any(pa.types.is_struct(field.type) for field in self._table.schema):
            self._table = self._table.flatten()
        self._table = self._table.rename_columns(_indexed(self._table.schema))
        self.titles = list(self._table.column_names)
        self.notes: list[str] = []
        self._stated: dict[str, str] = {}
        self.metadata: dict[bytes, bytes] = dict(self._table.schema.metadata or {})
        self.times = {field.name for field in self._table.schema if pa.types.is_temporal(field.type)}

    def _read(self, path: Path) -> Any:
        """Return the table of the file."""
        import pyarrow.parquet as pq

        about = pq.read_metadata(path)
        stated = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
        refuse_large(path, max(stated, NUMBER * about.num_rows * about.num_columns))
        return pq.read_table(path)

    def values(self, title: str) -> FloatArray:
        """Return one column (N,)."""
        import pyarrow.types as kinds

        column = self._table.column(title)
        if kinds.is_time(column.type):
            whole = column.cast(_whole(column.type)).to_numpy(zero_copy_only=False)
            return np.asarray(whole, dtype=np.float64) * _TICKS[column.type.unit]
        if kinds.is_timestamp(column.type) or kinds.is_duration(column.type):
            return seconds_of(column.to_numpy(zero_copy_only=False))
        if kinds.is_date(column.type):
            return seconds_of(np.asarray(column.to_numpy(zero_copy_only=False), dtype="datetime64[ms]"))
        if kinds.is_string(column.type) or kinds.is_large_string(column.type):
            return self._texts(title, column.to_pylist())
        if kinds.is_boolean(column.type):
            say_truths(self.notes, title)
        try:
            return np.array(column.to_numpy(zero_copy_only=False), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise _no_numbers(str(column.type), title) from error

    def _texts(self, title: str, cells: list[str | None]) -> FloatArray:
        """Return a column of texts: dates and times, or numbers."""
        texts = ["" if cell is None else cell for cell in cells]

        def where(row: int) -> str:
            return f"row {row}, column {title!r}"

        if (found := with_unit(texts, title, where, self.notes, self._stated)) is not None:
            return found
        if not any(character.isdigit() for text in texts for character in text):
            raise _no_numbers("string", title)
        return numbers_of(texts, where, self.notes)

    def unit(self, title: str) -> str | None:
        """Return s for time stamps and spans; else what the column's own metadata state, or None."""
        if title in self.times:
            return "s"
        if title in self._stated:
            return self._stated[title]
        stated: dict[bytes, bytes] = dict(self._table.schema.field(title).metadata or {})
        text = stated.get(b"unit", stated.get(b"units"))
        return None if text is None or split_header(title)[1] is not None else text.decode("utf-8", "replace").strip()


def _no_numbers(kind: str, title: str) -> InputError:
    """Return the refusal of a column of something else."""
    return InputError(
        "a column that holds no numbers",
        expected="numbers",
        got=kind,
        remedy="choose another column, or convert it",
        place=f"column {title!r}",
    )


def _indexed(schema: Any) -> list[str]:
    """Return the names of columns, ``time`` for an index of times that pandas stored without a name."""
    import pyarrow.types as kinds

    names = list(schema.names)
    for k, name in enumerate(names):
        times = kinds.is_timestamp(schema.field(k).type) or kinds.is_duration(schema.field(k).type)
        if name == "__index_level_0__" and times and "time" not in names:
            names[k] = "time"
    return names


_TICKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # Seconds of the units of Arrow's times of day.


def _whole(kind: Any) -> Any:
    """Return the integers that a time of day of Arrow is made of."""
    import pyarrow as pa

    return pa.int32() if kind.bit_width == 32 else pa.int64()


class FeatherFile(ParquetFile):
    """A Feather file (Arrow on disk)."""

    kind = "Feather"

    def _read(self, path: Path) -> Any:
        import pyarrow as pa
        from pyarrow import feather

        with path.open("rb") as file:
            begin = file.read(4)
        if begin == b"\xff\xff\xff\xff":  # a stream of Arrow, which has no word at its head
            with pa.OSFile(str(path), "rb") as stream:
                return pa.ipc.open_stream(stream).read_all()
        return feather.read_table(path)


class _Variables:
    """Named variables, some of them matrices, cells or structs, behind selectors."""

    def __init__(self, variables: dict[str, Any]) -> None:
        self._variables = variables
        self.titles = list(variables)
        self.notes: list[str] = []
        self._dates: set[str] = set()
        self.times = {
            name for name, value in variables.items() if getattr(value, "dtype", np.dtype(float)).kind in "mM"
        }

    def resolve(self, value: Any) -> Any:
        """Return the content of a cell, references followed."""
        return value

    def values(self, title: str) -> FloatArray:
        """Return a variable that is one column of numbers (N,)."""
        texts = _texts_in(self._variables[title])
        if texts is not None and (stamps := clock(texts, self.notes)) is not None:
            self._dates.add(title)
            return stamps
        if title in self.times:
            return seconds_of(np.asarray(self._variables[title]).reshape(-1))
        selector = parse_selector(title) if not set("{[.") & set(title) else None
        if selector is None:
            return np.asarray(self._variables[title], dtype=np.float64).reshape(-1)
        return vector(self._variables[title], selector, resolve=self.resolve, notes=self.notes)

    def inside(self, title: str) -> list[str] | None:
        """Return the selectors of the columns that a variable holds; None where it is one column of numbers."""
        return _inside(title, np.asarray(self._variables[title]), self.resolve)

    def select(self, text: str) -> FloatArray | None:
        """Return the values that a selector picks; None if its variable is not there."""
        selector = parse_selector(text)
        if selector.variable not in self._variables:
            return None
        return vector(self._variables[selector.variable], selector, resolve=self.resolve, notes=self.notes)

    def unit(self, title: str) -> str | None:
        """Return s for dates and spans, also those in texts; these formats state no other units."""
        return "s" if title in self.times | self._dates else None


def _texts_in(value: Any) -> list[str] | None:
    """Return the texts of a column of texts; None for anything else."""
    array = np.asarray(value)
    if array.dtype.kind not in "SUO" or array.size < 2 or array.size != max(array.shape, default=1):
        return None
    cells = [cell.decode("utf-8", "replace") if isinstance(cell, bytes) else cell for cell in array.reshape(-1)]
    return [str(cell) for cell in cells] if all(isinstance(cell, str) for cell in cells) else None


MOST_INSIDE = 100  # Columns that are shown of one variable.


def _inside(so_far: str, array: Any, resolve: Any, depth: int = 0) -> list[str] | None:
    """Return the selectors of the columns of numbers in a value; None where it is one itself."""
    array = np.asarray(resolve(array))
    if array.dtype.names and depth < 4:
        inner: list[str] = []
        for name in array.dtype.names:
            value = array[name]
            value = value.reshape(-1)[0] if value.size == 1 and value.dtype == object else value
            inner += _inside(f"{so_far}.{name}", value, resolve, depth + 1) or [f"{so_far}.{name}"]
        return inner[:MOST_INSIDE]
    if array.dtype == object and depth < 4:
        cells = list(enumerate(array.reshape(-1, order="F")))[:MOST_INSIDE]
        nested = [_inside(f"{so_far}{{{k}}}", cell, resolve, depth + 1) or [f"{so_far}{{{k}}}"] for k, cell in cells]
        return [one for some in nested for one in some][:MOST_INSIDE]
    if array.ndim == 3 and array.shape[1] == 1 != array.shape[0] and array.dtype.kind in "biuf":  # Simulink's
        return [f"{so_far}[{k}]" for k in range(min(array.shape[0], MOST_INSIDE))]
    if array.ndim == 2 and 1 not in array.shape and array.dtype.kind in "biuf":
        rows, columns = array.shape
        if columns <= rows:
            return [f"{so_far}[:,{k}]" for k in range(min(columns, MOST_INSIDE))]
        return [f"{so_far}[{k}]" for k in range(min(rows, MOST_INSIDE))]
    return None


class MatFile(_Variables):
    """A MAT file of version 5 (what MATLAB writes without -v7.3)."""

    paths = True
    called: dict[str, tuple[str, str]]
    """Selector and unit by name of signals in rows of structs."""

    def __init__(self, path: Path) -> None:
        from scipy.io import loadmat, whosmat

        try:
            content = loadmat(path)
            logical = {name for name, _, kind in whosmat(path) if kind == "logical"}
        except Exception as error:
            raise broken(path, "MAT", error) from error
        dense = {name: _dense(value) for name, value in content.items() if not name.startswith("__")}
        super().__init__({name: value.astype(bool) if name in logical else value for name, value in dense.items()})
        self.called = called_inside(dense)


def _dense(value: Any) -> Any:
    """Return a sparse matrix with its zeros, where that is no larger than any packed table may be."""
    if not hasattr(value, "toarray"):
        return value
    refuse_large(Path("a sparse matrix"), NUMBER * int(np.prod(value.shape)))
    return value.toarray()


class NumpyFile(_Variables):
    """A ``.npz`` archive, or one ``.npy`` array called ``array``."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:  # given the path, numpy leaves the file open where it fails
                content = np.load(file, allow_pickle=False)
                variables = {"array": content} if isinstance(content, np.ndarray) else dict(content)
        except Exception as error:
            if "allow_pickle" in str(error):
                raise InputError(
                    "an array of Python objects",
                    expected="arrays of numbers",
                    got="one that is pickled, which may run what it holds",
                    remedy="save it as numbers: array.astype(float)",
                    file=path,
                ) from error
            raise broken(path, "numpy", error) from error
        super().__init__(variables)


class Hdf5File(_Variables):
    """An HDF5 file; data sets go by their path (``log/theta``), units by an attribute ``unit`` or ``units``.

    The name of the attribute may be in capitals.
    """

    transposed = False
    paths = True

    def __init__(self, path: Path) -> None:
        _refuse_classic(path)
        h5py = optional("h5py", "HDF5")
        variables: dict[str, Any] = {}
        self._units: dict[str, str] = {}
        self._unapplied: dict[str, str] = {}
        self.links: dict[str, str] = {}
        """Paths that lead to a data set of the file by a soft link, and its own."""
        try:
            with h5py.File(path, "r") as file:

                def visit(name: str, item: Any) -> None:
                    if not isinstance(item, h5py.Dataset) or name.startswith("#refs#"):
                        return
                    _refuse_elsewhere(name, item)
                    variables[name] = self._loaded(item, file, h5py)
                    stated = {key.lower(): key for key in item.attrs}
                    for key in ("unit", "units"):
                        if key in stated:
                            self._units[name] = _text_of(item.attrs[stated[key]])
                    if said := _unapplied(item.attrs):
                        self._unapplied[name] = said

                def follow(name: str, link: Any) -> None:
                    item = file.get(name) if isinstance(link, h5py.SoftLink) else None
                    if item is not None:
                        target = posixpath.join("/", posixpath.dirname(name), link.path).strip("/")
                        parts = [""] if isinstance(item, h5py.Dataset) else [f"/{part}" for part in item]
                        self.links.update({f"{name}{part}": f"{target}{part}" for part in parts})

                file.visititems(visit)
                file.visititems_links(follow)
        except InputError:
            raise
        except Exception as error:  # the library raises whatever its walk through a damaged file meets
            raise broken(path, "HDF5", error) from error
        super().__init__(variables)

    def _loaded(self, item: Any, file: Any, h5py: Any) -> Any:
        """Return a data set in memory, references followed."""
        if item.shape is None:  # a place without anything in it
            return np.zeros(0)
        content = item[()]
        if h5py.check_ref_dtype(item.dtype) is h5py.Reference and getattr(content, "dtype", None) == h5py.ref_dtype:
            cells = np.empty(content.shape, dtype=object)
            for index in np.ndindex(content.shape):
                cells[index] = self._loaded(file[content[index]], file, h5py)
            content = cells
        array = _unpacked(np.asarray(content), item.attrs)
        return array.T if self.transposed and array.ndim == 2 else array

    def values(self, title: str) -> FloatArray:
        """Return a data set that is one column of numbers (N,)."""
        found = super().values(title)
        if title in self._unapplied:
            text = (
                f"{title} has {self._unapplied[title]}, which no convention explains: the numbers are read as they are "
                "(scale and offset in a dataset.toml change them)"
            )
            self.notes += [] if text in self.notes else [text]
        return found

    def unit(self, title: str) -> str | None:
        """Return the unit attribute of a data set; of ``ms since 2024-01-01`` (netCDF) what stands before the date."""
        if title in self._dates:
            return "s"
        text = self._units.get(title)
        since = None if text is None else re.fullmatch(r"\s*(\w+)\s+since\s.*", text, re.DOTALL)
        return text if since is None else TIME_UNITS.get(since[1].lower(), text)


def _text_of(attribute: Any) -> str:
    """Return the text of an attribute, which some programs write as bytes or as an array of one."""
    inner = np.asarray(attribute).reshape(-1)
    text = inner[0] if inner.size == 1 else attribute
    return text.decode("utf-8", "replace").strip() if isinstance(text, bytes) else str(text).strip()


FACTORS = frozenset("gain factor scale scaling slope multiplier sensitivity calibration lsb".split())
"""Words for a factor that some program's numbers may still be without; of 1 it says nothing."""


def _unapplied(attributes: Any) -> str:
    """Return the attributes by which the numbers of a data set may be raw ones; empty where there are none."""
    said = []
    for key in attributes:
        if not set(words_of(key)) & FACTORS or key == "scale_factor":
            continue
        value = np.asarray(attributes[key]).reshape(-1)
        if value.size == 1 and value.dtype.kind in "iuf" and value[0] != 1:
            said.append(f"{key} = {float(value[0]):g}")
    return ", ".join(said)


def _unpacked(array: Any, attributes: Any) -> Any:
    """Return numbers as they were before netCDF packed them: ``scale_factor``, ``add_offset``, and what is missing.

    Reference: NetCDF Climate and Forecast Metadata Conventions 1.11, sections 2.5.1 and 8.1.
    """
    if array.dtype.kind not in "iuf":
        return array
    missing = np.zeros(array.shape, dtype=bool)
    for key in ("_FillValue", "missing_value"):
        if key in attributes:
            missing |= np.isin(array, np.asarray(attributes[key]).reshape(-1))
    packed = "scale_factor" in attributes or "add_offset" in attributes
    if packed or missing.any():
        factor, offset = (
            float(np.asarray(attributes.get(key, default)).reshape(-1)[0])
            for key, default in (("scale_factor", 1.0), ("add_offset", 0.0))
        )
        array = array.astype(np.float64) * factor + offset
        array[missing] = np.nan
    return array


def _refuse_classic(path: Path) -> None:
    """Refuse netCDF of the classic formats, which is no HDF5."""
    with path.open("rb") as file:
        if file.read(3) == b"CDF":
            raise InputError(
                "netCDF of the classic format",
                expected="netCDF-4",
                got="a file that begins with CDF",
                remedy="nccopy -k nc4 OLD.nc NEW.nc, or xarray.open_dataset(...).to_netcdf(...)",
                file=path,
            )


def _refuse_elsewhere(name: str, item: Any) -> None:
    """Refuse a data set whose numbers lie in other files, which the file may name as it likes."""
    others = [str(found[0]) for found in item.external or ()]
    if item.is_virtual:
        others += [source.file_name for source in item.virtual_sources() if source.file_name != "."]
    if others:
        raise InputError(
            "a data set with its numbers in another file",
            expected="numbers in the file itself",
            got=others[0],
            remedy="repack the file (h5repack), or give that file",
            place=name,
        )


class MatV73File(Hdf5File):
    """A MAT file of version 7.3: HDF5 with the axes turned; shapes are those that MATLAB shows."""

    transposed = True


class ModelicaFile:
    """A result that Dymola or OpenModelica wrote: the variables that move, by their names in the model.

    Reference: Modelica Association, *Modelica 3.4*, result files "Atrajectory"; the layout is that of Dymola's manual:
    ``dataInfo`` says of each name in which matrix and column (below 0: with the other sign) it stands.
    """

    def __init__(self, content: dict[str, Any], path: Path) -> None:
        head = [str(line).strip() for line in content["Aclass"]]
        across = head[-1] == "binTrans"
        names, said = (_lines_of(content[key], across=across) for key in ("name", "description"))
        info = np.asarray(content["dataInfo"]).T if across else np.asarray(content["dataInfo"])
        moving = content.get("data_2")
        if moving is None or len(names) != len(info):
            raise broken(path, "Modelica result", ValueError("no trajectories"))
        data = np.asarray(moving, dtype=np.float64)
        data = data.T if across else data
        self._columns: dict[str, FloatArray] = {}
        self._units: dict[str, str] = {}
        for name, text, (matrix, column, *_) in zip(names, said, info.astype(int), strict=True):
            if matrix == 1:
                continue  # a parameter, or what does not move
            self._columns[name] = np.copysign(1.0, column) * data[:, abs(column) - 1]
            found = re.search(r"\[([^\[\]|:#]+)[^\[\]]*\]$", text)
            if found is not None:
                self._units[name] = found[1].strip()
        still = len(names) - len(self._columns)
        self.titles = list(self._columns)
        self.notes = [f"{still} names of what does not move are left out"] if still else []

    def values(self, title: str) -> FloatArray:
        """Return the trajectory (N,) of a variable."""
        return self._columns[title].copy()

    def unit(self, title: str) -> str | None:
        """Return the unit at the end of a variable's description."""
        return self._units.get(title)


def _lines_of(value: Any, *, across: bool) -> list[str]:
    """Return the texts of a matrix of characters, one in each row, or down each column."""
    rows = [str(row) for row in np.asarray(value).reshape(-1)]
    if across:
        width = max(map(len, rows), default=0)
        rows = ["".join(column) for column in zip(*(row.ljust(width) for row in rows), strict=True)]
    return [row.strip() for row in rows]


def open_mat(path: Path) -> MatFile | MatV73File | ModelicaFile:
    """Return the reader for the version of a MAT file."""
    with path.open("rb") as file:
        head = file.read(128)
    if head.startswith(b"MATLAB 7.3"):
        return MatV73File(path)
    if b"Aclass" in head:
        from scipy.io import loadmat

        try:
            content = loadmat(path)
        except Exception as error:
            raise broken(path, "MAT", error) from error
        if str(content["Aclass"][0]).strip() == "Atrajectory":
            return ModelicaFile(content, path)
    return MatFile(path)
