"""The table of single trials, and of what could explain the errors that remain."""

from types import SimpleNamespace

from warp_resphys.report.page import NONE
from warp_resphys.report.sections import rest_table, trials_section


def test_each_trial_has_its_errors_its_amplitude_and_its_coverage():
    rows = [
        {"name": name, "errors_mm": {"sysid": error}, "amplitude_mm": 20.0} for name, error in [("a", 1.0), ("b", 2.0)]
    ]
    covered = {"models": {"sysid": {"by_trial": {"a": 0.93}}}}
    metrics = {"per_trajectory": rows, "errors_mm": {"sysid": {"mean": 1.5}}, "intervals": covered}
    data = SimpleNamespace(metrics=metrics, others=("b",), pages={}, driven=None)
    (table,) = trials_section(data, None).blocks
    assert [(row.head, row.cells[0].text, row.small) for row in table.rows] == [
        ("a", "1.000", "amplitude 20 mm, coverage 93 %"),
        ("b", "2.000", "amplitude 20 mm, other loads"),
    ]
    assert trials_section(SimpleNamespace(metrics={}, others=(), pages={}, driven=None), None) is None


def test_what_could_explain_the_remaining_error_is_that_of_the_best_model():
    def fit(name, error, **left):
        return {"name": name, "as_is_mm": error, "left_mm": left, "values": {"scale": 0.05, "zero": 2.0}}

    quantity = SimpleNamespace(shown=lambda value: f"{value:g} kPa")
    fits = {"sysid": [fit("a", 2.0, scale=1.0, zero=0.5), fit("b", 4.0, scale=1.0)], "simulation": [fit("a", 9.0)]}
    (table,) = rest_table(fits, quantity)
    assert table.columns == ["As it is", "Refitted gain", "Refitted offset"]
    assert [[(cell.text, cell.small) for cell in row.cells] for row in table.rows] == [
        [("2.000", ""), ("1.000", "+5.0 %"), ("0.500", "2 kPa")],
        [("4.000", ""), ("1.000", "+5.0 %"), (NONE, "")],
        [("3.000", ""), ("1.000", ""), ("2.250", "")],
    ]
    assert rest_table({}, None) == rest_table({"sysid": [fit("a", 2.0)]}, None) == []
