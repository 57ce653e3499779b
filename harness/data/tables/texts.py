"""The text of a file: unpacked, in its coding, and in lines; files of other formats are refused by name."""

from __future__ import annotations

import gzip
import io
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from harness.data.tables.headers import TIME_WORDS, words_of
from harness.data.tables.packing import most_unpacked
from harness.errors import InputError
from harness.trust import UNZIPPING

CODINGS = {
    "cp1252": "Windows, Western Europe",
    "cp1251": "Windows, Cyrillic",
    "gb18030": "Chinese",
    "cp932": "Windows, Japanese",
    "cp949": "Windows, Korean",
    "big5": "Traditional Chinese",
    "cp1250": "Windows, Central Europe",
    "koi8-r": "Russian",
    "iso8859-2": "Central Europe",
}
"""Codings of one and two bytes that are tried, and whose they are."""
_SPELT = ("cp1252", "cp1250", "iso8859-2")  # Those of Latin letters, the most frequent first.
_NO_LETTER = re.compile(
    r"(?<=[^\W\d_])[^\w\s\x00-\x7f\u00b7\u2018\u2019](?=[^\W\d_])|(?<=[^\W\d_])[\u00b2\u00b3\u00b9](?=[^\W\d_])"
)
"""A sign in the middle of a word, where none stands but for the dot of a product and an apostrophe."""
_MAGIC = {
    b"MDF ": ".mf4",
    b"UnFinMF": ".mf4",
    b"PAR1": ".parquet",
    b"ARROW1": ".feather",
    b"\x89HDF": ".h5",
    b"MATLAB ": ".mat",
    b"\x93NUMPY": ".npy",
    b"#ROSBAG": ".bag",
    b"\x89MCAP": ".mcap",
    b"SQLite format 3": ".db3",
    b"\x1f\x8b": ".csv.gz",
}
"""How files of other formats begin, and their suffixes."""
_HEAD = 4096  # Bytes in which a header stands.
_OPENED = re.compile(r'(?:^|[,;\t])\s*"[^"]*$')  # A quoted cell that goes on behind the end of its line.
_APOSTROPHES = re.compile(r"""(?:(?<=[,;\t|])|^) *'(?P<cell>[^"\n]*?)'(?= *(?:[,;\t|\r]|$))""", re.MULTILINE)
"""A cell between apostrophes."""
_CLOSED = re.compile(r'[^"]*"\s*(?:[,;\t]|$)')
"""The line in which it ends: a sign for a quotation that stands elsewhere closes none, and no row is lost to it."""
MOST_BROKEN = 30  # Lines over which the cells of one row may go on: ten cells of three lines.


def _refuse_other_text(text: str) -> None:
    """Refuse texts of another kind that would pass for one strange title.

    Raises InputError if it is JSON, XML or HTML.
    """
    begin = text[:200].lstrip().lower()
    if begin.startswith(('{"', '[{"', "[[")):
        if text.count("\n{") > 1:  # an object in each line
            return
        kind, remedy = "JSON", "rename it to end in .json"
    elif re.match(r"<(?:\?xml|html|!doctype|table|svg)\b", begin):
        kind, remedy = "XML or HTML", "save it as CSV from the program that wrote it, or from a spreadsheet"
    else:
        return
    raise InputError("a file of another format", expected="a table in text", got=kind, remedy=remedy)


def plainly_quoted(text: str) -> str:
    r"""Return a text with quotation marks about cells that stand between apostrophes.

    Examples
    --------
    >>> plainly_quoted("'t, s','u', 1'234"), plainly_quoted("d'x,'0', 5")
    ('"t, s","u", 1\'234', 'd\'x,"0", 5')
    """
    return _APOSTROPHES.sub(lambda found: f'"{found["cell"]}"', text)


def closed_lines(lines: Sequence[str]) -> list[tuple[int, str]]:
    """Return numbered lines, those together between which a quoted cell goes on (RFC 4180): Excel breaks titles so."""
    found: list[tuple[int, str]] = []
    row = 0
    while row < len(lines):
        line, end = lines[row], row + 1
        if line.count('"') % 2 and _OPENED.search(line):
            parts = [line]
            while end < len(lines) and end - row < MOST_BROKEN and sum(part.count('"') for part in parts) % 2:
                parts.append(lines[end])
                end += 1
            whole = sum(part.count('"') for part in parts) % 2 == 0 and _CLOSED.match(parts[-1]) is not None
            line, end = (" ".join(part.strip() for part in parts), end) if whole else (line, row + 1)
        found.append((row + 1, line))
        row = end
    return found


def _coding(raw: bytes) -> str:
    """Return the coding of a text that is no UTF-8: the first in which its beginning holds a word for time.

    Where it holds none, that of Latin letters in which the fewest words have a sign among their letters.
    """
    for coding in CODINGS:
        words = words_of(raw[:_HEAD].decode(coding, "ignore"))
        if any(not word.isascii() and word in TIME_WORDS for word in words):
            return coding
    return min(_SPELT, key=lambda coding: len(_NO_LETTER.findall(raw[:_HEAD].decode(coding, "ignore"))))


def suffix_by_content(path: Path) -> str | None:
    """Return what to do with a file whose first bytes show another format than its suffix; None where they show none.

    A text that is no gzip file, and what only begins as another format does, goes by its suffix.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(b"PK\x03\x04"):
        try:
            with zipfile.ZipFile(path) as archive:
                inside = archive.namelist()
        except UNZIPPING:
            return "rename it to end in .xlsx or .npz"
        if any(name.startswith("xl/") for name in inside):
            return "rename it to end in .xlsx"
        if inside and all(name.endswith(".npy") for name in inside):
            return "rename it to end in .npz"
        return "rename it to end in .zip"
    for begin, suffix in _MAGIC.items():
        if head.startswith(begin):
            return None if suffix == ".csv.gz" and path.suffix.lower() == ".gz" else f"rename it to end in {suffix}"
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None
    return "it is text: rename it to end in .csv" if text and all(map(_is_text, text)) else None


def _is_text(sign: str) -> bool:
    """Return True for what stands in texts."""
    return sign.isprintable() or sign in "\t\r\n\f"


def text_of(path: Path, *, json: bool = False) -> tuple[str, str]:
    """Return the text of a file, unpacked where it is packed, and its coding; other texts than tables are refused.

    JSON is none of them where it is asked for.
    """
    raw = path.read_bytes()
    remedy = suffix_by_content(path)
    if path.suffix.lower() != ".gz" and remedy and not remedy.endswith(".csv"):
        raise InputError(
            "a file of another format",
            expected=f"a table in text, as {path.suffix} says",
            got=f"a file that begins with {raw[:4]!r}",
            remedy=remedy,
        )
    if path.suffix.lower() == ".gz":
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(raw)) as packed:
                most = most_unpacked(len(raw))
                raw = packed.read(most + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(
                "not a gzip file",
                expected="a table packed by gzip",
                got=str(error),
                remedy=remedy or "check that it was copied whole",
            ) from error
        if len(raw) > most:
            raise InputError(
                "a packed table",
                expected=f"at most {most >> 20} MiB unpacked",
                got="more",
                remedy="unpack it yourself, or cut or thin it",
            )
    if path.suffix.lower() == ".gz" and raw.startswith(b"\x1f\x8b"):
        raise InputError(
            "a file that was packed twice",
            expected="a table packed once by gzip",
            got="another packed file in it",
            remedy="unpack it (gunzip), and rename what comes out to end in .csv.gz",
        )
    if raw[:4] in (b"\xff\xfe\0\0", b"\0\0\xfe\xff"):
        coding = "utf-32"
    elif raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        coding = "utf-16"
    elif raw[1:2] == b"\0" or raw[:1] == b"\0":  # a title begins with a letter of ASCII in every table that we read
        coding = "utf-16-le" if raw[1:2] == b"\0" else "utf-16-be"
    else:
        coding = "utf-8-sig"
    others = dict.fromkeys((_coding(raw), "cp1252")) if coding == "utf-8-sig" and b"\0" not in raw[:4096] else ()
    for tried in (coding, *others):
        try:
            text = raw.decode(tried)
        except UnicodeDecodeError as error:
            last = error
            continue
        if not json:
            _refuse_other_text(text)
        return text, tried
    raise InputError(
        "not a text file",
        expected="text in UTF-8, UTF-16 or cp1252",
        got=str(last)[:120],
        remedy="save it as UTF-8 CSV",
    ) from last
