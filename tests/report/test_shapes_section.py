"""The section on other bodies: shares of the error, and stretches beyond the training."""

import pytest

from support.made_up_run import vertex_settings, write_vertex_run
from support.report_page import report
from warp_resphys.io.files import write_json
from warp_resphys.report.sections import shapes_table, share_text


def result(simulation, sysid=None, law=None, **more):
    errors = {"simulation": simulation, "sysid": sysid, "law": law}
    kept = {model: error for model, error in errors.items() if error is not None}
    return {"vertices": 225, "moved_mm": 12.5, "errors_mm": kept, **more}


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.5, "50 %"),
        (0.897, "90 %"),
        (0.9958, "99.58 %"),
        (0.99976, "99.976 %"),
        (1.0, "100 %"),
        (-0.2, "\N{MINUS SIGN}20 %"),
    ],
)
def test_shares_have_digits_for_what_is_left(share, text):
    assert share_text(share) == text


def test_a_model_that_diverges_on_a_body():
    lost = result(1.0, 0.2)
    lost["errors_mm"]["law"] = None
    rows = {row.head: [cell.text for cell in row.cells] for row in shapes_table({"rod": lost}).rows}
    assert rows == {"rod": ["1.000", "0.200", "diverged"]}


@pytest.mark.usefixtures("no_drawing")
def test_page_has_the_bodies(tmp_path):
    write_vertex_run(tmp_path, vertex_settings(), models=("simulation", "simfree", "resphys"))
    found = {"thin <beam>": result(1.5, 0.3, 0.015, outside=0.12), "L": result(2.0, 0.5, 0.002, outside=0.0)}
    write_json(tmp_path / "shapes.json", found)
    shape = {"mesh": vertex_settings().mesh, "fixed": {"x": 0.0}, "held": {"twist_deg": 10.0}}
    ranges = {"youngs_modulus": {"lower": 1e5, "upper": 1e6}}
    page = report(tmp_path, vertex_settings().changed(identify={"parameters": ranges}, shapes={"thin": shape}))
    for said in (
        "Other bodies of the same material",
        "thin <beam>",
        "removes 99.0 %",
        "225 vertices, moves by 12.5 mm",
    ):
        assert said in page.text
    assert "was learned at, with the share of cells and times: thin <beam> (12 %)." in page.text
