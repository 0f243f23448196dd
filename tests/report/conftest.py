import pytest

from support.report_page import FAILING, skip_figures
from warp_resphys.report import render


@pytest.fixture
def no_drawing(monkeypatch):
    """Nothing is drawn in another process, which takes seconds."""
    monkeypatch.setattr(render, "COMMAND", FAILING)


@pytest.fixture
def no_figures(no_drawing, monkeypatch):
    """Figures are drawn in tests of their own; here their names are kept."""
    skip_figures(monkeypatch)
