"""Records of the benchmark, and the page of their history."""

import re
from pathlib import Path

import pytest

from support.command_line import outcome
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.files import read_json, write_json
from warp_resphys.studies.benchmark_history import (
    histories,
    history_figure,
    history_page,
    read_records,
    record,
    write_record,
)

DOCS = Path(__file__).parents[2] / "docs"
ROW = {
    "solver": "newton",
    "model": "corotated",
    "poissons_ratio": 0.45,
    "refinement": 1,
    "unknowns": 24,
    "batch": 1,
    "contact": False,
    "repeats": 2,
    "plain_ms": 1.0,
    "forward_ms": 2.0,
    "backward_ms": 1.0,
    "iterations": 3.0,
}


def result(date, **row):
    """A result of the benchmark with one case."""
    settings = {"device": "cpu", "dtype": "float64"}
    return {
        "date": f"{date}T10:00:00+00:00",
        "settings": settings,
        "hardware": {},
        "versions": {},
        "yardstick_ms": 4.0,
        "steps": [ROW | row],
    }


def test_histories_are_quotients_by_machine_and_date(tmp_path):
    for date, machine, forward in (
        ("2026-02-01", "A (R) 7", 5.0),
        ("2026-01-01", "A (R) 7", 3.0),
        ("2026-01-01", "B", 7.0),
    ):
        write_record(tmp_path, record(result(date, forward_ms=forward), machine, ["seed=1"]))
    write_record(tmp_path, record(result("2026-03-01", contact=True), "B", []))
    assert (tmp_path / "2026-02-01-a-r-7.json").is_file()
    records = read_records(tmp_path)
    case = "newton, nu 0.45, 24 unknowns, batch 1"
    assert histories(records) == {
        "A (R) 7, float64": {case: {"2026-01-01": 1.0, "2026-02-01": 1.5}},
        "B, float64": {case: {"2026-01-01": 2.0}, f"{case}, on a floor": {"2026-03-01": 0.75}},
    }
    page = history_page(records, "picture.png")
    assert f"| {case} | 1.00 | 1.50 |" in page
    assert f"| {case}, on a floor |  | 0.75 |" in page
    assert "2026-02-01: `warp-resphys benchmark seed=1`" in page
    lines = [line for axes in history_figure(records).axes for line in axes.lines]
    assert [list(line.get_ydata()) for line in lines] == [[1.0, 1.5], [2.0], [0.75]]


def test_what_is_no_record_is_refused(tmp_path):
    with pytest.raises(InputError, match="has no records"):
        read_records(tmp_path)
    write_json(tmp_path / "settings.json", {"date": "2026-01-01"})
    with pytest.raises(DataFileError, match=r"settings\.json is no record"):
        read_records(tmp_path)


def test_the_command_writes_a_record(folder):
    tiny = ["mesh.divisions=[2,1,1]", "benchmark.quick=true", "benchmark.cold_start=false", "benchmark.contact=null"]
    ended = outcome("benchmark", *tiny, "benchmark.solvers=[newton]", "device=cpu", "benchmark.record=records")
    assert ended.code == 0, ended.err
    (kept,) = read_records(folder / "records")
    whole = read_json(folder / "outputs/benchmark/benchmark.json")
    assert kept["yardstick_ms"] == whole["yardstick_ms"]
    assert [case["forward_ms"] for case in kept["cases"]] == [row["forward_ms"] for row in whole["steps"]]
    assert kept["machine"] == whole["hardware"]["processor"]


def test_the_page_of_the_book_is_current():
    page = (DOCS / "benchmark_history.md").read_text(encoding="utf-8")
    assert page == history_page(read_records(DOCS / "results" / "benchmarks"), "benchmark_history.png")
    assert (DOCS / "benchmark_history.png").is_file()
    assert re.search(r"^benchmark_history$|<benchmark_history>", (DOCS / "index.md").read_text("utf-8"), re.MULTILINE)
