"""Tables of the studies."""

from warp_resphys.studies.tables import Sheet


def test_a_table_is_a_template_of_its_lines():
    sheet = Sheet.of("Times", "name {name} | step, ms {time:.1f}", [{"name": "beam", "time": 2.04, "unused": 1}])
    assert (list(sheet.headings), sheet.rows) == (["name", "step, ms"], [["beam", "2.0"]])
    (table,) = sheet.for_page().blocks
    assert (table.head, list(table.columns)) == ("Name", ["Step, ms"])
