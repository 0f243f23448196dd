"""Tables of the page, and which trials, markers and frames are shown."""

from dataclasses import replace
from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from support.made_up_run import vertex_settings, write_vertex_run
from support.report_page import report
from warp_resphys.data.recordings.marker_quality import MarkerQuality, quality_table
from warp_resphys.io.safe_files import write_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.identification.search import Identification
from warp_resphys.learning.identification.uncertainty import Uncertainty
from warp_resphys.learning.metrics import PUBLISHED_MM, PUBLISHED_WINDOWS_MM
from warp_resphys.report import sections, wording
from warp_resphys.report.body_motions import instants
from warp_resphys.report.control_section import control_section
from warp_resphys.report.data import Driven, at_times
from warp_resphys.report.identification_section import (
    parameter_rows,
    placement_text,
    uncertainty_text,
)
from warp_resphys.report.page import Cell, PageTable, Row
from warp_resphys.report.pages.run_page import range_table
from warp_resphys.report.wording import MINUS, NO_BREAK_SPACE, NONE
from warp_resphys.settings.learning import IdentifySettings

TIMES = "\N{MULTIPLICATION SIGN}"
DOWN = np.array([0.0, 0.0, -9.8])


@pytest.mark.parametrize("summary", ["", "Trial [1]"])
def test_units_in_brackets_reach_the_terminal(summary):
    table = PageTable(
        "Error [mm]",
        ["Mean [mm]"],
        [Row("At rest [2]", [Cell("1.2", beside="[3]")])],
        summary=summary,
    )
    console = Console(width=80, file=StringIO())
    console.print(table)
    words = console.file.getvalue().split()
    assert {"Error", "[mm]", "Mean", "[2]", "[3]", *summary.split()} <= {*words}
    assert words.count("[mm]") == 2


def test_a_table_that_is_too_wide_wraps_its_heads_alone():
    table = PageTable(
        "A long head over short rows",
        ["one column"],
        [Row("r" * 60, [Cell("4.3e-07")], "best of all")],
    )
    console = Console(width=80, file=StringIO())
    console.print(table)
    assert f"{'r' * 60}  4.3e-07  best of" in console.file.getvalue()


def summary(mean, diverged=0):
    return {
        "mean": mean,
        "std": None if mean is None else 0.1,
        "trajectories": 3,
        "diverged": diverged,
    }


ERRORS = {"sysid": summary(2.0), "resphys": summary(1.0)}
MORE = {"sysid": summary(None, 1), "resphys": summary(1.5)}


def test_errors_are_by_horizon_and_published_ones_stand_beside_the_same_model():
    metrics = {"horizons": {"10": MORE, "5": ERRORS}}
    table = sections.horizon_table(metrics, PUBLISHED_WINDOWS_MM["sopra_extrapolation"])
    assert table.columns == ["SysID", "ResPhys"]
    assert {row.head: row.cells for row in table.rows} == {
        "First 5 s": [Cell("2.00", "7.51 ± 3.63"), Cell("1.00", "5.79 ± 3.09")],
        "First 10 s": [Cell("1 of 3 diverged", "7.57 ± 3.59"), Cell("1.50", "6.10 ± 3.22")],
    }
    (row,) = sections.horizon_table({"horizons": {"5": ERRORS}}, {}).rows
    assert row.cells == [Cell("2.00"), Cell("1.00")]
    assert sections.horizon_table({}, {}) is None
    published = PUBLISHED_MM["beam_real"]
    beside = sections.published_beside(published, ["published", "simulation", "sysid", "resphys"])
    assert beside.keys() == {"published", "sysid", "simfree", "resphys"}
    beside = sections.published_beside(published, ["simulation", "sysid_elastic", "sysid"])
    assert beside["sysid_elastic"] == ("1.32", "± 1.38")


def test_control_is_told_by_controller_and_speed():
    errors = {"mean_mm": 1.0, "max_mm": 2.0}
    metrics = {
        "tracking": {
            "4.0": {"open_sysid": errors, "receding_resphys": {**errors, "mean_mm": 0.5}},
            "2.0": {},
        },
        "reduced": {
            "sysid": dict.fromkeys(("modes", "window_s", "window_error_mm", "whole_error_mm"), 1)
        },
        "planned_mm": {"sysid": {"eight": [3.0, 0.5, 1.0], "circle": [5.0, 1.5]}},
        "command_ms": {"receding_resphys": {"median": 2.0, "largest_of_20": 4.0}, "open_sysid": {}},
    }
    metrics["reduced"]["sysid"]["window_relative"] = 0.01
    control = SimpleNamespace(seconds=(4.0,), shapes=("eight",), tracked=("A", "B"), size=0.04)
    data = SimpleNamespace(
        metrics={"control": metrics}, settings=SimpleNamespace(control=control), followed=()
    )
    task, table, _, facts = control_section(data, None).blocks
    assert "the mean of A and B, follows 1 paths (eight) of 40 mm" in task.text
    plan, receding = table.rows
    assert plan.head == "SysID, open loop"
    assert plan.cells == [Cell("1.00", beside="at most 2.00"), Cell(NONE)]
    assert (receding.mark, plan.mark) == ("best", "")
    assert any(
        "to 1.00 mm after corrections" in said and "to 4.00 mm before" in said
        for said in facts.items
    )
    assert any("a command takes 2.0 ms" in said for said in facts.items)
    assert (
        control_section(SimpleNamespace(metrics={}, settings=SimpleNamespace(control=None)), None)
        is None
    )


class TestIdentification:
    @pytest.fixture
    def identified(self):
        parameters = {"youngs_modulus": 251.3e3, "stiffness_damping": 0.0029}
        uncertainty = Uncertainty(
            deviation={"youngs_modulus": 2513.0, "stiffness_damping": 1e-4},
            correlation=[[1.0, 0.5], [0.5, 1.0]],
            poorest={"youngs_modulus": 0.1, "stiffness_damping": 0.99},
            poorest_deviation=0.034,
            ranges={},
        )
        return Identification(parameters, at_bounds=("stiffness_damping",), uncertainty=uncertainty)

    def test_a_row_a_parameter(self, identified):
        modulus, damping = parameter_rows(
            identified, {"youngs_modulus": 264e3}, {"youngs_modulus": 250e3}
        )
        assert modulus.head == "Young's modulus [kPa]"
        assert modulus.cells == [Cell("264"), Cell("251.3", beside="± 2.5"), Cell("250"), Cell("")]
        assert damping.head == "Stiffness damping [ms]"
        assert damping.cells == [Cell(NONE), Cell("2.90", beside="± 0.10"), Cell(NONE), Cell("yes")]
        identified = replace(identified, parameters={"youngs_modulus": -3.0})
        assert parameter_rows(identified, {}, {})[0].cells[1].text == "0.0"
        assert (
            parameter_rows(replace(identified, uncertainty=None), {}, {})[0].cells[1].text
            == f"{MINUS}0.003"
        )

    @pytest.mark.parametrize(
        ("parameter", "value", "head", "text"),
        [
            ("prony_ratio_1", 0.25, "Prony ratio 1", "0.25"),
            ("prony_time_2", 0.3125, "Prony time 2 [s]", "0.3125"),
            ("tendon_offset_1_left", 0.002, "Tendon offset 1 left [mm]", "2"),
            ("pressure_delay", 0.03, "Pressure delay [ms]", "30"),
            ("pressure_slew", 2e-6, "Pressure slew [µs/Pa]", "2"),
            ("tendon_contraction_dead_band", 0.003, "Tendon contraction dead band [mm]", "3"),
            ("muscle_contraction_dead_band", 0.03, "Muscle contraction dead band [%]", "3"),
            ("pressure_slope_3", 2.0, "Pressure slope 3", "2"),
            ("pressure_delay_1", 0.02, "Pressure delay 1 [ms]", "20"),
            ("tip_youngs_modulus", 2e5, "Tip Young's modulus [kPa]", "200"),
            ("obstacle_turn_x_bar", np.pi / 180, "Obstacle turn x bar [°]", "1"),
            ("unknown", 2.0, "Unknown", "2"),
        ],
    )
    def test_names_and_units(self, parameter, value, head, text):
        (row,) = parameter_rows(Identification({parameter: value}), {}, {})
        assert (row.head, row.cells[1].text) == (head, text)

    def test_what_the_data_cannot_tell(self, identified):
        said = uncertainty_text("sysid", identified, None).replace(NO_BREAK_SPACE, " ")
        assert said == "SysID: stiffness damping is least certain (3.4 % of the range)."
        assert uncertainty_text("sysid", replace(identified, uncertainty=None), None) == ""
        tied = replace(
            identified.uncertainty, poorest_deviation=1.9, correlation=[[1.0, -0.95], [-0.95, 1.0]]
        )
        said = uncertainty_text("sysid", replace(identified, uncertainty=tied), None)
        assert "the data do not constrain stiffness damping: set a prior." in said
        assert (
            f"do not separate Young's modulus and stiffness damping (correlation {MINUS}0.95)"
            in said
        )

    @pytest.mark.parametrize(("deviation", "informs"), [(2.5e3, True), (9.9e3, False)])
    def test_what_the_data_add_nothing_to_is_said_to_be_its_prior(
        self, identified, deviation, informs
    ):
        identified.uncertainty.deviation["youngs_modulus"] = deviation
        prior = {"mean": 250e3, "deviation": 10e3}
        ranges = {"youngs_modulus": {"lower": 5e4, "upper": 2e6, "prior": prior}}
        said = uncertainty_text(
            "sysid", identified, parse(IdentifySettings, {"parameters": ranges})
        )
        assert (
            said.endswith("do not constrain Young's modulus beyond its prior (250 ± 10 kPa).")
            is not informs
        )

    def test_where_markers_and_recordings_lie(self):
        offsets = {"A": [0.001, 0.0, 0.0], "B": [0.0, 0.003, 0.004]}
        said = placement_text(
            "sysid", {"offsets": offsets, "shift": [0.0, 0.002, 0.0], "turn": [0.0, 0.0, 0.1]}, {}
        )
        said = said.replace(NO_BREAK_SPACE, " ")
        assert "B the most, by 5.0 mm" in said
        assert "by 2.0 mm and rotated by 5.7°" in said


def test_rows_of_markers_that_were_never_seen():
    table = quality_table([MarkerQuality("A", False, 0.0, 1, 9, 9, (), None, None)])
    assert table == {"A": ["0.0 %", "1", "9", "9", "0", "", ""]}
    table = sections.residual_table(
        {"t": {"rms_mm": 0.5, "residual_mm": {"A": None, "B": 0.5}, "outliers": []}}
    )
    assert table.columns == ["A", "B", "Root mean square"]
    assert table.rows[0].cells == [Cell(NONE), Cell("0.50"), Cell("0.50")]
    many = {str(marker): 0.1 for marker in range(9)}
    table = sections.residual_table({"t": {"rms_mm": 0.5, "residual_mm": many, "outliers": ["3"]}})
    assert table.columns == ["t"]
    assert [row.head for row in table.rows] == [*many, "Root mean square"]
    assert table.rows[3].cells == [Cell("0.10", "left out")]
    fit = {"rms_mm": 0.5, "residual_mm": many | {"4": 0.7, "5": None}, "outliers": []}
    table = sections.residual_table({f"t{k}": fit for k in range(9)})
    assert table.columns == ["Largest", "Marker", "Root mean square"]
    assert [cell.text for cell in table.rows[8].cells] == ["0.70", "4", "0.50"]


def test_bodies_at_frames_instants_that_lie_apart_the_uncorrected_model_and_the_best_one():
    positions = np.arange(4.0)[:, None, None] * np.ones((1, 2, 3))
    times = np.array([0.0, 0.1, 0.2, 0.3])
    between = at_times(positions, times, np.array([0.0, 0.05, 0.11, 0.3, 0.5]))
    np.testing.assert_allclose(between[:, 0, 0], [0.0, 0.5, 1.1, 3.0, 3.0])
    positions[2:] = np.nan
    np.testing.assert_array_equal(
        at_times(positions, times, np.array([0.1, 0.11]))[:, 0, 0], [1.0, np.nan]
    )
    measured, rest = np.zeros((100, 1, 3)), np.zeros((1, 3))
    measured[40, 0, 2] = -1.0
    simulated = measured.copy()
    simulated[97, 0, 0] = 1.0
    # The last is too close to where the model is worst.
    assert instants(measured, rest, simulated) == [25, 40, 97]
    simulated[70, 0, 0] = 2.0
    assert instants(measured, rest, simulated) == [40, 70, 99]
    measured[70] = np.nan
    assert instants(measured, rest, simulated) == [25, 40, 97]
    assert instants(measured[:1], rest, simulated[:1]) == [0]
    assert wording.shown_models({"resphys": 0, "simulation": 0, "sysid": 0}) == [
        "simulation",
        "resphys",
    ]
    assert wording.shown_models({"sysid": 0, "published": 0}) == ["published", "sysid"]
    every = dict.fromkeys(("simulation", "sysid", "actuator", "resphys"), 0)
    assert wording.shown_models(every, "actuator") == ["simulation", "actuator"]
    assert wording.shown_models(every, "simulation") == ["simulation", "resphys"]


def test_numbers_have_sensible_digits_and_shares_those_for_what_is_left():
    shown = [wording.number_text(value) for value in (4.48812, 0.000721, 0.0, None)]
    assert shown == ["4.49", "below 0.001", "0", "diverged"]
    shown = [wording.number_text(value) for value in (2.14e-9, 0.00123, 0.09994, 0.154, 1234.5)]
    assert shown == ["below 0.001", "0.00123", "0.0999", "0.154", "1,234"]
    deviating = {"mean": 0.000721, "std": 0.00031, "trajectories": 5, "diverged": 0}
    assert wording.error_parts(deviating) == ("below 0.001", "")
    assert wording.error_parts({**deviating, "mean": 0.0721}) == ("0.0721", "± 0.0003")
    # Of one fold.
    assert wording.error_parts({**deviating, "mean": 0.0721, "std": None}) == ("0.0721", "")
    shown = [wording.duration_text(seconds) for seconds in (0.421, 12.34, 59.97, 184.6)]
    assert shown == ["0.42 s", "12.3 s", "60.0 s", "3 min 05 s"]
    shown = [wording.share_text(share) for share in (0.5, 0.897, 0.9958, 0.99976, 1.0, -0.2)]
    assert shown == ["50 %", "90 %", "99.6 %", "more than 99.9 %", "100 %", f"{MINUS}20 %"]


def test_each_trial_has_its_errors_its_amplitude_and_its_coverage():
    rows = [
        {"name": name, "errors_mm": {"sysid": error}, "amplitude_mm": 20.0}
        for name, error in [("a", 1.0), ("b", 2.0)]
    ]
    covered = {"models": {"sysid": {"by_trial": {"a": 0.93}}}}
    metrics = {"per_trajectory": rows, "errors_mm": {"sysid": {"mean": 1.5}}, "intervals": covered}
    run = SimpleNamespace(test_titles=("weights", "other loads"))
    data = SimpleNamespace(metrics=metrics, settings=run, others=("b",), pages={}, driven=None)
    (table,) = sections.trials_section(data, None).blocks
    assert [(row.head, row.cells[0].text, row.small) for row in table.rows] == [
        ("a", "1.00", "amplitude 20 mm, coverage 93 %"),
        ("b", "2.00", "amplitude 20 mm, other loads"),
    ]
    assert (
        sections.trials_section(SimpleNamespace(metrics={}, others=(), pages={}, driven=None), None)
        is None
    )


def test_what_could_explain_the_remaining_error_is_that_of_the_best_model():
    def fit(name, error, **left):
        return {
            "name": name,
            "as_is_mm": error,
            "left_mm": left,
            "values": {"scale": 0.05, "zero": 2.0},
        }

    quantity = SimpleNamespace(shown=lambda value: f"{value:g} kPa")
    fits = {
        "sysid": [fit("a", 2.0, scale=1.0, zero=0.5), fit("b", 4.0, scale=1.0)],
        "simulation": [fit("a", 9.0)],
    }
    driven = Driven(quantity, ("c",), {})
    (table,) = sections.rest_table(fits, driven)
    assert table.columns == ["As it is", "Refitted gain", "Refitted offset"]
    assert [[(cell.text, cell.small) for cell in row.cells] for row in table.rows] == [
        [("2.00", ""), ("1.00", "+5.0 %"), ("0.500", "2 kPa")],
        [("4.00", ""), ("1.00", "+5.0 %"), (NONE, "")],
        [("3.00", ""), ("1.00", ""), ("2.25", "")],
    ]
    assert (
        sections.rest_table({}, None) == sections.rest_table({"sysid": [fit("a", 2.0)]}, None) == []
    )

    def text(gains, left=1.0, pressures=(3.0, 1.0, 2.0)):
        rows = [
            fit(n, 2.0, scale=left) | {"values": {"scale": gain}}
            for n, gain in zip("abc", gains, strict=True)
        ]
        values = {n: np.array([[0.0], [-p]]) for n, p in zip("abc", pressures, strict=True)}
        return sections.gain_text(rows, Driven(quantity, ("c",), values))

    assert "from +2.1 % at 1 kPa to +11.0 % at 3 kPa" in text([0.11, 0.021, 0.066])
    assert "may lack physics" in text([-0.11, -0.021, -0.066])
    assert "much the same in all trials (+5.1 %)" in text([0.051, 0.05, 0.052])
    assert text([0.11, 0.021, 0.066], left=1.9) == text([0.066, 0.021, 0.11]) == ""
    assert text([0.11, 0.021, 0.066], pressures=(1.0, 1.0, 2.0)) == ""


def result(simulation, sysid=None, law=None, **more):
    errors = {"simulation": simulation, "sysid": sysid, "law": law}
    kept = {model: error for model, error in errors.items() if error is not None}
    return {"vertices": 225, "moved_mm": 12.5, "errors_mm": kept, **more}


def test_trials_out_of_range_and_models_that_diverge_on_a_body_are_counted_where_they_belong():
    lost = result(1.0, 0.2)
    lost["errors_mm"]["law"] = None
    rows = {
        row.head: [cell.text for cell in row.cells]
        for row in sections.shapes_table({"rod": lost}).rows
    }
    assert rows == {"rod": ["1.00", "0.200", "diverged"]}
    none, some, late = {"first_s": {}}, {"first_s": {"b": 2.5, "a": 1.0}}, {"first_s": {"d": 0.25}}
    metrics = {
        "range": {"resphys": some, "simfree": none},
        "scales_range": {
            "1": {"resphys": some, "simfree": none},
            "1.5": {"resphys": late, "simfree": none},
            "1.25": {"resphys": none, "simfree": none},
        },
    }
    table = range_table({**metrics, "errors_mm": {}}, ["a", "b", "c"])
    assert table.columns == ["Of the test trials", f"Inputs {TIMES} 1.25", f"Inputs {TIMES} 1.5"]
    rows = {
        row.head: [(c.text, c.small.replace(NO_BREAK_SPACE, " ")) for c in row.cells]
        for row in table.rows
    }
    assert rows == {
        "SimFree": [("none of 3", "")] * 3,
        "ResPhys": [
            ("2 of 3", "after 1.00 s (a)"),
            ("none of 3", ""),
            ("1 of 3", "after 0.25 s (d)"),
        ],
    }
    at_once = {"range": {"simfree": {"first_s": dict.fromkeys("abcd", 0.0)}}, "errors_mm": {}}
    assert range_table(at_once, "abcd").rows[0].cells == [
        Cell("4 of 4", "from the start (a, b and 2 more)")
    ]
    assert range_table({}, ["a"]) is None


@pytest.mark.usefixtures("no_drawing")
def test_page_has_the_bodies(tmp_path):
    write_vertex_run(tmp_path, vertex_settings(), models=("simulation", "simfree", "resphys"))
    found = {
        "thin <beam>": result(1.5, 0.3, 0.015, outside=0.12),
        "L": result(2.0, 0.5, 0.002, outside=0.0),
    }
    write_json(tmp_path / "shapes.json", found)
    shape = {"mesh": vertex_settings().mesh, "fixed": {"x": 0.0}, "held": {"twist_deg": 10.0}}
    ranges = {"youngs_modulus": {"lower": 1e5, "upper": 1e6}}
    page = report(
        tmp_path, vertex_settings().changed(identify={"parameters": ranges}, shapes={"thin": shape})
    )
    page.says(
        "Other bodies of the same material",
        "thin <beam>",
        "removes 99 %",
        "225 vertices, moves by 12.5 mm",
    )
    assert "was learned at, with the share of cells and times: thin <beam> (12 %)." in page.text
