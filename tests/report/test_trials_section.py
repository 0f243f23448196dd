"""The lines of single trials on the page of a run."""

from warp_resphys.report.page import NONE
from warp_resphys.report.trials_section import trial_table, worse


def row(name, **errors):
    thirds = {model: [3.0 * error, error, 0.5 * error] for model, error in errors.items()}
    return {"name": name, "errors_mm": errors, "amplitude_mm": 20.0, "thirds_mm": thirds}


def test_what_is_worse_than_a_simpler_model_is_named():
    assert worse({"simulation": 3.0, "sysid": 1.0, "resphys": 0.5, "interpolation": 0.7}, "interpolation") == []
    said = worse({"simulation": 3.0, "sysid": 1.0, "law": 0.9, "resphys": 1.2, "interpolation": 0.7}, "interpolation")
    assert said == ["ResPhys than Law (1.2 of 0.9)", "ResPhys than Interpolation (1.2 of 0.7)"]
    assert worse({"simfree": 9.0}) == []


def test_a_trial_has_its_best_model_its_coverage_and_where_its_error_sits():
    rows = [row("a", rest=9.0, interpolation=0.2, simulation=3.0, sysid=0.5, resphys=0.3), row("b", sysid=1.0)]
    rows.append({"name": "pose", "errors_mm": {"resphys": None}, "amplitude_mm": 1.0})
    table = trial_table(
        rows, "interpolation", {"sysid": {"by_trial": {"a": 0.5}}, "resphys": {"by_trial": {"a": 0.93}}}
    )
    assert table.columns == [
        "Amplitude [mm]",
        "Best [mm]",
        "Worse than a simpler one [mm]",
        "Thirds of the time [mm]",
        "Coverage",
    ]
    first, second, pose = ([cell.text for cell in line.cells] for line in table.rows)
    assert first == ["20.000", "Interpolation", "ResPhys than Interpolation (0.3 of 0.2)", "0.9 / 0.3 / 0.15", "93 %"]
    assert second[1:] == ["SysID", NONE, "3 / 1 / 0.5", NONE]
    assert pose[1:] == [NONE, NONE, NONE, NONE]
    short = trial_table(rows[2:], "", {})
    assert len(short.columns) == 3
    assert trial_table([], "", {}) is None
