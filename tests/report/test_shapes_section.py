"""The section on other bodies: shares of the error, sentences, and stretches beyond the training."""

import pytest

from support.report_page import report
from support.vertex_run import settings, write_run
from warp_resphys.io.files import write_json
from warp_resphys.report.shapes_section import shapes_table, shapes_text, share_text


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


def test_the_sentence_compares_the_law_with_sysid():
    better = {"rod": result(1.0, 0.2, 0.01), "L": result(2.0, 0.2, 0.004)}
    assert shapes_text(better) == (
        "On 2 other bodies of the same material, SysID removes 80 to 90 % and the law removes 99.0 to 99.80 % of "
        "the error of the uncorrected simulation; the law is better on all of them."
    )
    worse = shapes_text({**better, "fin": result(1.0, 0.1, 0.3)})
    assert worse.endswith("; the law is not better than SysID on fin.")
    assert "the law" not in shapes_text({"rod": result(1.0, 0.2)})


def test_a_body_on_which_a_model_diverges_is_counted():
    lost = result(1.0, 0.2)
    lost["errors_mm"]["law"] = None
    text = shapes_text({"rod": lost, "L": result(2.0, 0.2, 0.1)})
    assert "the law removes 95.0 % (1 diverged) of the error" in text
    rows = {row.head: [cell.text for cell in row.cells] for row in shapes_table({"rod": lost}).rows}
    assert rows == {"rod": ["1.000", "0.200", "diverged"]}


@pytest.mark.usefixtures("no_drawing")
def test_page_has_the_bodies(tmp_path):
    write_run(tmp_path, settings(), models=("simulation", "simfree", "resphys"))
    found = {"thin <beam>": result(1.5, 0.3, 0.015, outside=0.12), "L": result(2.0, 0.5, 0.002, outside=0.0)}
    write_json(tmp_path / "shapes.json", found)
    shape = {"mesh": settings().mesh, "fixed": {"x": 0.0}, "held": {"twist_deg": 10.0}}
    ranges = {"youngs_modulus": {"lower": 1e5, "upper": 1e6}}
    page = report(tmp_path, settings().changed(identify={"parameters": ranges}, shapes={"thin": shape}))
    for said in (
        "Other bodies of the same material",
        "thin <beam>",
        "removes 99.0 %",
        "225 vertices, moves by 12.5 mm",
    ):
        assert said in page.text
    assert "was learned at, with the share of cells and times: thin <beam> (12 %)." in page.text
