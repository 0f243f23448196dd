import pytest

from support.report_page import FAILING
from warp_resphys.report import render


@pytest.fixture
def no_drawing(monkeypatch):
    """Nothing is drawn in another process, which takes seconds."""
    monkeypatch.setattr(render, "COMMAND", FAILING)
