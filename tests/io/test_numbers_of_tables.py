"""Numbers of tables: decimal commas and thousands, by the other numbers of the column
or the table, or refused.
"""

import pytest

from support.refusals import refuses
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.text import read_rows


def column(path, *cells, other=("0.0200", "0.0366"), mark=";"):
    """Cells of the second column of a table, as they are read."""
    lines = [f"{other[line % len(other)]}{mark}{cell}" for line, cell in enumerate(cells)]
    path.write_text("\n".join([f"strain{mark}force [mN]", *lines]), encoding="utf-8")
    return [row[1] for row in read_rows(path)[1:]]


@pytest.mark.parametrize(
    ("cells", "other", "read"),
    [
        (("999", "1,012", "-12,345"), "0.02", ("999", "1012", "-12345")),
        (("999", "1.012"), "0,02", ("999", "1012")),
        (("999.5", "1,012.5"), "0.02", ("999.5", "1012.5")),
        (("999,5", "1.012,5"), "0,02", ("999.5", "1012.5")),
        (("999.5", "1'012.5"), "0.02", ("999.5", "1012.5")),
        (("999.5", "1\u2019012.5"), "0.02", ("999.5", "1012.5")),
        (("999,5", "1 012,5", "1\u00a0012\u00a0345,5"), "0,02", ("999.5", "1012.5", "1012345.5")),
        (("999", "1\u202f012"), "0.02", ("999", "1012")),
        (("1,234,567", "1,012"), "3", ("1234567", "1012")),
        (("0,500", "1,012"), "3", ("0.500", "1.012")),  # no group begins with zero
        (("12,5", "1,012"), "0.02", ("12.5", "1.012")),  # a column decides before the table
        (("1.012", "1.999"), "3", ("1.012", "1.999")),
        (("0.5", "1.012", "100"), "3", ("0.5", "1.012", "100")),
        (("1,0e3", "2,5e-1"), "3", ("1.0e3", "2.5e-1")),
    ],
)
@pytest.mark.parametrize("mark", [";", "\t"])
def test_other_numbers_decide_what_a_mark_is(tmp_path, cells, other, read, mark):
    assert column(tmp_path / "a.csv", *cells, other=(other,), mark=mark) == [*read]


def test_quoted_numbers_between_commas(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('time,force\n0.5,"1,012"\n0.6,"1,012.25"\n', encoding="utf-8")
    assert [row[1] for row in read_rows(path)[1:3]] == ["1012", "1012.25"]


@pytest.mark.parametrize(
    ("cells", "other"),
    [
        (("999", "1,012"), "3"),
        (("999", "1.012"), "3"),
        (("1,012", "2,500"), "3"),
        (("1,012", "5"), "0.5 0,5"),
    ],
)
def test_a_number_that_may_be_two_is_refused(tmp_path, cells, other):
    path = tmp_path / "a.csv"
    said = (
        r"a.csv, line \d, column 2: '1[,.]012' is 1012 or 1.012, "
        "and no other number tells which: write 1012"
    )
    refuses(DataFileError, said, column, path, *cells, other=other.split())


def test_names_and_a_key_with_its_value_are_no_evidence(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "Version;1.25\nSerial;1,234\nstrain;force [N]\n0,1;1.012\n0,2;999\n", encoding="utf-8"
    )
    rows = read_rows(path)
    assert rows[1] == ["Serial", "1,234"]
    assert rows[3] == ["0.1", "1012"]
