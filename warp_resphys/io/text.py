"""Text files of users, in any encoding, and the cells of their tables.

Windows programs write Windows-1252 (Motive, Nexus) or UTF-16 (Excel's "Unicode text"); German and
other versions of Excel separate cells by semicolons or tabs and write decimal commas.

Thousands may be grouped: 1,012.5 or 1.012,5 or 1'012.5 or 1 012.5. A number such as 1,012 is 1012
or 1.012. Other numbers decide: those of its column, such as 0,5, else those of the whole table;
where none does, it is refused.
"""

import codecs
import csv
import io
import re
from collections import defaultdict
from collections.abc import Sequence
from itertools import chain
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
_START: Final = (
    4096  # bytes that show UTF-16 without a mark: every second one is zero in Western text
)
_NO_TEXT: Final = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f]")
_LAST: Final = 50  # lines at the end, which hold numbers, and show what separates cells
_SEPARATOR: Final = re.compile(r'\A"?sep=.*', re.IGNORECASE)  # Excel's first line
# Marks between thousands.
_GROUPED: Final = re.compile(r"(?<=\d)['\u2019\u00a0\u2007\u2009\u202f ](?=\d{3}(?!\d))")
_BLANK_GROUPS: Final = re.compile(rf"[-+]?\d{{1,3}}(?:{_GROUPED.pattern}\d{{3}})+(?:[.,]\d*)?")
_DOUBTFUL: Final = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")  # thousands, or three decimals
_DECIMALS: Final = {  # numbers whose decimal mark is certain
    ".": re.compile(
        r"[-+]?(?:\d*|\d{1,3}(?:,\d{3})+)\.\d+(?:[eE][-+]?\d+)?|[-+]?\d{1,3}(?:,\d{3}){2,}"
    ),
    ",": re.compile(
        r"[-+]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][-+]?\d+)?|[-+]?\d{1,3}(?:\.\d{3}){2,}"
    ),
}
_OTHER: Final = {".": ",", ",": "."}
# As below a thousand in a column without decimals.
_HUNDREDS: Final = re.compile(r"[-+]?[1-9]\d{2}")


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
        raise DataFileError(
            f"{path} is not a text file: export it as text again, a table as CSV or TSV."
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decoded(content: bytes) -> str | None:
    """Returns bytes as text, None if they are none.

    The byte-order mark determines the encoding. Without one it is UTF-16 if every second byte is
    zero, else UTF-8, and Windows-1252 for what is not valid UTF-8, with a warning.
    """
    for encoding in _encodings(content):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if encoding in ("cp1252", "latin-1") and not _NO_TEXT.search(text):
            warn(
                "A text is not in UTF-8 and was read as Windows-1252: check names with accents "
                "or umlauts, or save the file as UTF-8."
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
    """Returns the cells of each line of a table, without blanks around them,
    decimal commas and grouped thousands.

    Tabs, semicolons, commas or blanks separate cells, whichever comes first in half of the last
    lines.

    Raises:
        DataFileError: The file cannot be read, is not text, is damaged, or has a number such as
            1,012 that may be 1012 or 1.012.
    """
    text = _SEPARATOR.sub("", read_text(path))
    lines = text.split("\n")
    last = [line for line in lines if line.strip()][-_LAST:]
    present = {mark: sum(mark in line for line in last) for mark in "\t;,"}
    common = (mark for mark, count in present.items() if 2 * count > len(last))
    delimiter = next(common, None)
    if delimiter is None:
        return _with_points([re.findall(r"[^ \t\f\v]+", line.lstrip("#")) for line in lines], path)
    try:
        rows = [*csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)]
    except csv.Error as error:
        raise DataFileError(
            f"{path} is no table ({error}): export it as CSV or TSV again."
        ) from error
    rows = [list(map(str.strip, row)) for row in rows]
    if _GROUPED.search(text):
        rows = [list(map(_without_blanks, row)) for row in rows]
    return _with_points(rows, path)


def _without_blanks(cell: str) -> str:
    """Returns a cell without blanks and apostrophes between groups of three digits."""
    return _GROUPED.sub("", cell) if _BLANK_GROUPS.fullmatch(cell) else cell


def _with_points(rows: Rows, path: str | Path) -> Rows:
    """Returns cells whose numbers have a decimal point and no marks between thousands."""
    marks = defaultdict[int, set[str]](set)  # certain decimal marks by column
    for row in rows:
        for column, cell in enumerate(row):
            seen = marks[column]
            if ("." in cell and "." not in seen) or ("," in cell and "," not in seen):
                mark = _certain(cell)
                if mark is not None and _has_numbers(row):
                    seen.add(mark)
    everywhere = set[str]().union(*marks.values())
    bare = {
        column
        for row in rows
        for column, cell in enumerate(row)
        if not everywhere and _HUNDREDS.fullmatch(cell)
    }
    commas = any("," in cell for cell in chain.from_iterable(rows))
    if "," not in everywhere and not bare and not commas:
        return rows
    result = list[list[str]]()
    for line, row in enumerate(rows, start=1):
        cells = list(row)
        for column, cell in enumerate(row):
            known = marks[column] or everywhere
            if "," in cell or ("." in cell and ("," in known or column in bare)):
                mark = _certain(cell)
                if mark is None and _DOUBTFUL.fullmatch(cell) and _has_numbers(row):
                    if len(known) != 1:
                        whole, point = re.sub("[.,]", "", cell), cell.replace(",", ".")
                        raise DataFileError(
                            f"{path}, line {line}, column {column + 1}: '{cell}' is {whole} or "
                            f"{point}, and no other number tells which: write {whole} without a "
                            f"mark between thousands, or {point}0, with a decimal point."
                        )
                    (mark,) = known
                if mark is not None:
                    cells[column] = cell.replace(_OTHER[mark], "").replace(",", ".")
        result.append(cells)
    return result


def _certain(cell: str) -> str | None:
    """Returns the decimal mark of a number, None where it is no number
    or may have grouped thousands instead.
    """
    if _DOUBTFUL.fullmatch(cell):
        return None
    return next((mark for mark, form in _DECIMALS.items() if form.fullmatch(cell)), None)


def _has_numbers(row: Sequence[str]) -> bool:
    """Whether a line has two numbers or more, unlike one of a key and its value."""
    return sum(cell.lstrip("+-.,")[:1].isdecimal() for cell in row) > 1


def number(cell: str) -> float | None:
    """Returns the number in a cell, or None."""
    try:
        return float(cell)
    except ValueError:
        return None
