"""Text files of users, in any encoding, and the cells of their tables.

Windows programs write Windows-1252 (Motive, Nexus) or UTF-16 (Excel's "Unicode text"); German and other versions of
Excel separate cells by semicolons or tabs and write decimal commas.
"""

import codecs
import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from .errors import DataFileError, warn

Rows = list[list[str]]

_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_START: Final = 4096  # bytes that show UTF-16 without a mark: every second one is zero in Western text
_NO_TEXT: Final = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f]")
_LAST: Final = 50  # lines at the end, which hold numbers, and show what separates cells
_SEPARATOR: Final = re.compile(r'\A"?sep=.*', re.IGNORECASE)  # Excel's first line
_DECIMAL_COMMA: Final = re.compile(r"[-+]?(?:\d{1,3}(?:\.\d{3})+|\d*),\d+(?:[eE][-+]?\d+)?")
_DECIMAL_POINT: Final = re.compile(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?")


def read_text(path: str | Path) -> str:
    r"""Returns the text of a file, with lines that end in \n; see `decoded`.

    Raises:
        DataFileError: The file cannot be read, or is not text.
    """
    try:
        text = decoded(Path(path).read_bytes())
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check its path.") from error
    if text is None or _NO_TEXT.search(text):
        raise DataFileError(f"{path} is not a text file: export it as text again, a table as CSV or TSV.")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decoded(content: bytes) -> str | None:
    """Returns bytes as text, None if they are none.

    The byte-order mark determines the encoding. Without one it is UTF-16 if every second byte is zero, else UTF-8, and
    Windows-1252 for what is not valid UTF-8, with a warning.
    """
    for encoding in _encodings(content):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if encoding in ("cp1252", "latin-1") and not _NO_TEXT.search(text):
            warn(
                "A text is not in UTF-8 and was read as Windows-1252: check names with accents or umlauts, or save "
                "the file as UTF-8."
            )
        return text
    return None


def _encodings(content: bytes) -> Sequence[str]:
    """Returns the possible encodings of a text, the first valid one of which applies."""
    for mark, encoding in _MARKS:
        if content.startswith(mark):
            return (encoding,)
    start = content[:_START]
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        if start[first::2].count(0) > len(start) // 4:
            return (encoding,)
    return ("utf-8", "cp1252", "latin-1")  # Some bytes are undefined in cp1252.


def read_rows(path: str | Path) -> Rows:
    """Returns the cells of each line of a table, without blanks around them and with decimal points.

    Tabs, semicolons, commas or blanks separate cells, whichever comes first in half of the last lines.

    Raises:
        DataFileError: The file cannot be read, is not text, or is damaged.
    """
    text = _SEPARATOR.sub("", read_text(path))
    lines = text.split("\n")
    last = [line for line in lines if line.strip()][-_LAST:]
    common = (mark for mark in "\t;," if 2 * sum(mark in line for line in last) > len(last))
    delimiter = next(common, None)
    if delimiter is None:
        return [line.lstrip("#").split() for line in lines]
    try:
        rows = [*csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)]
    except csv.Error as error:
        raise DataFileError(f"{path} is no table ({error}): export it as CSV or TSV again.") from error
    rows = [[cell.strip() for cell in row] for row in rows]
    # A comma in a cell between commas groups thousands if other numbers have a decimal point.
    if delimiter == "," and any(_DECIMAL_POINT.fullmatch(cell) for row in rows for cell in row):
        return rows
    return [[_with_point(cell) if "," in cell else cell for cell in row] for row in rows]


def _with_point(cell: str) -> str:
    return cell.replace(".", "").replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell


def number(cell: str) -> float | None:
    """Returns the number in a cell, or None."""
    try:
        return float(cell)
    except ValueError:
        return None
