"""Files of recorded data behind one face: what columns are there, and one of them as numbers."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from harness.data.tables.named import NamedColumns, Source
from harness.data.tables.packing import unzipped
from harness.errors import InputError, no_file

_TEXT = (".csv", ".tsv", ".txt", ".lvm", ".log", ".asc", ".prn", ".tab", ".jsonl", ".ndjson", ".lp")
_PACKED = (".csv.gz", ".tsv.gz", ".txt.gz", ".dat.gz")
BARE = (*_TEXT, ".dat", *_PACKED, ".parquet", ".pq", ".feather", ".arrow", ".xlsx", ".xlsm", ".json", ".zip")
"""Suffixes of files that can stand for a whole data set, with a model that names the ports."""


def _reader(file: str, name: str) -> Callable[[Path], Source]:
    """Return what opens a file by a reader of this folder, which is imported then."""

    def opened(path: Path) -> Source:
        source: Source = getattr(import_module(f"harness.data.tables.{file}"), name)(path)
        return source

    return opened


def _dat(path: Path) -> Source:
    """Return the reader of a table in text, or of an MDF log, which INCA and CANape call so too."""
    with path.open("rb") as file:
        return _mdf(path) if file.read(8).startswith((b"MDF ", b"UnFinMF ")) else _csv(path)


def _mcap(path: Path) -> Source:
    from harness.data.tables.bags import BagFile, holds_json
    from harness.data.tables.log_files import McapFile

    return McapFile(path) if holds_json(path) else BagFile(path)


def _json(path: Path) -> Source:
    """Return the reader of a table in JSON; a model is none."""
    from harness.data.tables.labelled import JsonFile

    if path.name == "model.json":
        raise unknown_format(path)
    return JsonFile(path)


def _zipped(path: Path) -> Source:
    """Return the reader of the one log in an archive; all of it is in memory."""
    with unzipped(path, lambda file: suffix_of(file) in FORMATS and suffix_of(file) != ".zip") as log:
        return FORMATS[suffix_of(log)](log)


_csv = _reader("text_files", "TextFile")
_parquet = _reader("binary_files", "ParquetFile")
_mat = _reader("binary_files", "open_mat")
_feather = _reader("binary_files", "FeatherFile")
_excel = _reader("excel", "ExcelFile")
_npz = _reader("binary_files", "NumpyFile")
_hdf5 = _reader("binary_files", "Hdf5File")
_mdf = _reader("log_files", "MdfFile")
_bag = _reader("bags", "BagFile")

FORMATS: dict[str, Callable[[Path], Source]] = {
    **{suffix: _csv for suffix in _TEXT[:3]},
    ".dat": _dat,
    **{suffix: _csv for suffix in (*_TEXT[3:], *_PACKED)},
    ".feather": _feather,
    ".arrow": _feather,
    ".xlsx": _excel,
    ".xlsm": _excel,
    ".parquet": _parquet,
    ".pq": _parquet,
    ".mat": _mat,
    ".npz": _npz,
    ".npy": _npz,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".nc": _hdf5,
    ".mf4": _mdf,
    ".mdf": _mdf,
    ".tdms": _reader("log_files", "open_tdms"),
    ".mcap": _mcap,
    ".bag": _bag,
    ".db3": _bag,
    ".json": _json,
    ".zip": _zipped,
}
"""Readers by suffix."""


def suffix_of(path: Path) -> str:
    """Return the suffix that decides the format, in small letters.

    Examples
    --------
    >>> suffix_of(Path("a.CSV")), suffix_of(Path("run.1.csv.gz"))
    ('.csv', '.csv.gz')
    """
    last = path.suffix.lower()
    return "".join(path.suffixes[-2:]).lower() if last == ".gz" else last


ELSEWHERE = {
    ".ulg": "ulog2csv of pyulog, which writes a CSV for each topic",
    ".bin": "mavlogdump.py --format csv of pymavlink, where it is a log of ArduPilot",
    ".blf": "CANalyzer, CANoe, or asammdf with the DBC file: messages of a bus hold signals only by it",
    ".trc": "PCAN, or asammdf with the DBC file",
    ".xls": "Excel or LibreOffice (.xlsx too)",
    ".ods": "LibreOffice (.xlsx too)",
    ".pkl": "pandas: a pickle runs what it holds",
    ".wav": "scipy.io.wavfile (NPZ too)",
}
"""What writes a table from a format that is not read."""
UNPACKED = {
    ".bz2": "bunzip2",
    ".xz": "unxz",
    ".zst": "unzstd",
    ".gz": "tar xf or gunzip",
    ".7z": "7z x",
}
"""What takes a table out of what it is packed in."""


WORKBOOKS = (".xlsx", ".xlsm")  # Suffixes of files that may have several sheets.

MODELS = (".urdf", ".xml", ".mjcf", ".fmu", ".ssp", ".eqs", ".py")
"""Suffixes of what may be a model, which holds no data."""


def unknown_format(path: Path) -> InputError:
    """Return the refusal of a file whose suffix says no format that is read.

    Examples
    --------
    >>> print(unknown_format(Path("a.xls")).remedy)
    save it as CSV or Parquet by Excel or LibreOffice (.xlsx too)
    """
    by, out = ELSEWHERE.get(path.suffix.lower()), UNPACKED.get(path.suffix.lower())
    if path.suffix.lower() in MODELS or path.name == "model.json":
        return InputError(
            "a model where data are expected", expected="a table, a log or a dataset.toml", got=path.name,
            remedy="give the data, and the model beside it (--model; a model.json to sysid compare)", file=path,
        )  # fmt: skip
    return InputError(
        "unknown format",
        expected=f"a dataset.toml, or a file that ends in {', '.join(FORMATS)}",
        got=repr(path.suffix),
        remedy=f"unpack it ({out}), and give the table that comes out"
        if out is not None
        else "convert it, for example to CSV; rename a table in text to .csv"
        if by is None
        else f"save it as CSV or Parquet by {by}",
        file=path,
    )


class Table(NamedColumns):
    """One file of data, or a table in memory.

    Raises InputError if there is no file, its format is unknown, or it cannot be read.

    - ``path``: its suffix decides the format; see :data:`FORMATS`
    - ``source``: what is in memory already; the path is then a name for messages
    """

    def __init__(self, path: Path, source: Source | None = None) -> None:
        super().__init__(path, self._opened(path) if source is None else source)

    def _opened(self, path: Path) -> Source:
        """Return the reader of a file, opened."""
        if path.is_dir() and (path / "metadata.yaml").is_file():  # a bag of ROS 2
            return _bag(path)
        if not path.is_file():
            raise InputError(
                "no such file", expected="a file of data", got=no_file(path), remedy="check the path", file=path
            )
        opener = FORMATS.get(suffix_of(path))
        if opener is None:
            raise unknown_format(path)
        try:
            source = opener(path)
            if suffix_of(path) in (*_TEXT, *_PACKED, ".dat", ".xlsx", ".xlsm", ".json", ".zip"):
                from harness.data.tables.long_form import in_long_form

                source = in_long_form(source) or source
        except InputError as error:
            raise error.located(file=path) from error
        return source


def open_table(path: Path, cache: dict[Path, Table], sheet: str | None = None) -> Table:
    """Return the table of a file (or of one sheet of a workbook), opened once."""
    key = path if sheet is None else path / sheet
    if key not in cache:
        cache[key] = Table(path, None if sheet is None else _sheet(path, sheet))
    return cache[key]


def _sheet(path: Path, sheet: str) -> Source | None:
    """Return a sheet of a workbook; None where there is no file, which is refused as any other."""
    if not path.is_file():
        return None
    if suffix_of(path) not in WORKBOOKS:
        raise InputError(
            "sheet",
            expected=f"an Excel workbook ({', '.join(WORKBOOKS)})",
            got=path.name,
            remedy="leave it out",
            file=path,
        )
    from harness.data.tables.excel import ExcelFile

    return ExcelFile(path, sheet)
