"""The study of contact: its closed forms, and its smallest form from end to end."""

import math

import pytest

from support.command_line import outcome, settings_of
from warp_resphys.studies.contact_check import ContactStudy, hertz_force


def test_a_thick_layer_is_a_half_space():
    """The correction of Dimitriadis et al., whose first term for an incompressible layer is 1.133 chi."""
    hertz = 4.0 / 3.0 * 1e5 / (1.0 - 0.25) * math.sqrt(0.01) * 1e-4**1.5
    assert hertz_force(0.01, 1e-4, 1e3, 1e5, 0.5) == pytest.approx(hertz, rel=2e-6)
    chi = math.sqrt(0.01 * 1e-4) / 0.01
    series = 1.0 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    assert hertz_force(0.01, 1e-4, 0.01, 1e5, 0.5) / hertz == pytest.approx(series, abs=1e-4)


def test_the_quick_form_is_smaller():
    study = settings_of(ContactStudy, "verify_contact")
    assert study.chosen == study
    small = settings_of(ContactStudy, "verify_contact", "quick=true").chosen
    assert small.throws < study.throws
    assert len(small.frictions) == len(small.cells) == len(small.batches) == 1


def test_the_smallest_check_passes_and_writes_a_page(folder):
    ended = outcome("verify", "contact", "quick=true", "throws=1", "results=docs", "hydra.run.dir=out")
    assert ended.code == 0, ended.out
    assert "FAILED" not in ended.out
    (page,) = (folder / "docs").glob("*-contact.md")
    text = page.read_text()
    assert "checks: all passed" in text
    for title in (
        "Inclined plane",
        "Stopping distance",
        "A sphere on a block",
        "Thrown blocks",
        "Closing plates",
        "Energy",
    ):
        assert title in text
    assert "warp-resphys verify contact" in text
    assert (folder / "out" / "contact.html").is_file()
