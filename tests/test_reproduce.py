"""The script of the published tables and of the page of robots:
its pages, which rows it keeps, and what it refuses.
"""

import io
import json
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import reproduce

from support.command_line import outcome
from warp_resphys.io.errors import ResphysError
from warp_resphys.overrides import composed
from warp_resphys.report.wording import error_parts, number_text

SCRIPT = Path(__file__).parents[1] / "scripts" / "reproduce.py"
DOCS = SCRIPT.parents[1] / "docs"
SMALL_BEAM = [
    "mesh.divisions=[4,2,2]",
    "data.steps=8",
    "trainer.epochs=4",
    "trainer.rollout_every=2",
    "budget=quick",
]
SMALL_ROBOT = [
    "data.sequences=5",
    "data.train=2",
    "data.validation=1",
    "data.test=2",
    "data.steps=12",
    "mesh.nodes=20",
    "mesh.layers=3",
    "laboratory.mesh.layers=4",
    "laboratory.mesh.nodes=20",
    "data.rest_seconds=0.01",
    "data.horizons=[0.06,0.12]",
    "data.cutoff=20.0",
    "laboratory.sequences.rest=0.01",
    "identify.trials=1",
    "laboratory.sequences.correlation_time=0.03",
    "identify.seconds=0.1",
    "identify.max_evaluations=2",
    *("mesh_check=1.4", "network.position_modes=2", "network.velocity_modes=0"),
    *("network.force_modes=2", "network.width=8", "trainer.epochs=4", "trainer.rollout_every=2"),
]


def end_of(monkeypatch, *arguments):
    """Runs the script in this process, whose runs are processes of their own.

    Returns its exit code.
    """
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *map(str, arguments)])
    try:
        reproduce.main()
    except SystemExit as end:
        return end.code
    return 0


class RunHere:
    """In place of the process of a run, which takes seconds to start.

    The row of a robot has one of its own.
    """

    def __init__(self, command, **_):
        ended = outcome(*command[3:])
        self.returncode, self.stderr = ended.code, io.StringIO(ended.err)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_the_page_of_robots_is_that_of_the_kept_results():
    kept = json.loads((DOCS / "robots.json").read_text())
    assert (DOCS / "robots.md").read_text() == reproduce.robots_page(
        kept, {}, DOCS / "robots"
    ) + "\n"


def test_the_readme_has_the_figures_of_the_robots():
    """Every row of README.md has the errors of a row of docs/robots.md
    or docs/results, rounded there.
    """
    pages = [
        (DOCS / name).read_text() for name in ("robots.md", "results/robots.md", "results/beams.md")
    ]
    measured = [
        table_of(pages[0], "| Robot | Without physics [mm]"),
        table_of(pages[2], "| trials | at rest |"),
    ]
    measured += [
        table_of(pages[1], f"| {head} | at rest |") for head in ("trials", "poses", "motions")
    ]
    errors = [
        [number for cell in row for number in re.findall(r"\d+\.\d+", cell)]
        for rows in measured
        for row in rows
    ]
    readme = table_of((DOCS.parent / "README.md").read_text(), "| robot | without physics")
    assert len(readme) >= 6
    for robot, *cells in readme:
        shown = [cell.strip("*") for cell in cells]
        assert any(
            all(any(same(text, exact) for exact in row) for text in shown) for row in errors
        ), robot


def same(text, exact):
    """Whether a number is another one, rounded, or is below a bound: "below 0.001"."""
    if text.startswith("below "):
        return 0.0 < float(exact) < float(text.removeprefix("below "))
    return abs(float(text) - float(exact)) <= 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9


def table_of(text, head):
    """The cells of the rows of a Markdown table whose first line begins in a given way."""
    lines = text[text.index(head) :].partition("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_every_row_is_an_experiment():
    experiments = {path.stem for path in (SCRIPT.parents[1] / "conf/experiment").glob("*.yaml")}
    assert {robot["experiment"] for robot in reproduce.ROWS["robots"].values()} <= experiments
    assert {*reproduce.ROWS["beams"]} <= experiments
    every = [*reproduce.ROWS["robots"].values(), *reproduce.ROWS["variants"].values()]
    assert composed("config", [override for row in every for override in row.get("overrides", ())])
    for name, beam in reproduce.ROWS["beams"].items():
        assert (
            composed("config", [f"experiment={name}", *beam.get("overrides", ())]).get("law")
            is None
        )


def test_less_error_of_a_robot_is_claimed_with_three_trials_or_more():
    kept = json.loads((DOCS / "robots.json").read_text())
    page = reproduce.robots_page(kept, {}, DOCS / "robots")
    tested = {len(row["tested"]) for row in kept.values() if row["beside"]}
    assert min(tested) < 3 <= max(tested)
    for text in re.findall(r"^Tested on .*", page, flags=re.MULTILINE):
        few = int(re.match(r"Tested on (\d+)", text)[1]) < 3
        assert ("No evidence either way" in text) == few
        assert ("less error than" in text) == (not few)


def test_gains_and_the_best_models_are_those_of_the_trials():
    errors = {
        "rest": [9.0, 8.0],
        "simulation": [2.0, 2.0],
        "sysid": [1.0, 1.0],
        "resphys": [3.0, None],
    }
    pair = reproduce.beside(errors)
    assert (pair["corrected"], pair["other"], pair["gain"]["share"]) == ("sysid", "simulation", 0.5)
    assert reproduce.gain_of(errors, "sysid", "resphys") is None
    kept = json.loads((DOCS / "robots.json").read_text())
    kept["sopra"]["gains"]["resphys"]["lower"] = -0.1
    page = reproduce.robots_page(kept, {"tentacle": "data.steps is -1"}, DOCS / "robots")
    assert f"reduces the error of identification on 1 of {len(kept)} robots (Real SoPrA)." in page
    assert "| 48 % (\N{MINUS SIGN}10 to 50) |" in page
    assert "| Tentacle (failed since 2026-11-27) |" in page
    assert "- Tentacle failed: data.steps is -1" in page


def test_rows_with_other_settings_and_other_recordings_are_refused(monkeypatch, capsys, tmp_path):
    with pytest.raises(
        ResphysError, match="has sopra with its own settings, not with budget=quick"
    ):
        reproduce.kept_results(DOCS / "robots.json", ["sopra"], ["budget=quick"])
    (tmp_path / "m1.csv").write_text("0,1")
    with pytest.raises(ResphysError, match="are not those of the page"):
        reproduce.robot_run("tentacle", tmp_path, [])
    assert end_of(monkeypatch, "tentacle", "--data", tmp_path, "--results", tmp_path / "out") == 2
    assert capsys.readouterr().err == "--data has no recordings of tentacle\n"
    assert not (tmp_path / "out").exists()
    with pytest.raises(
        ResphysError, match="there is no starfish: choose from beams, robots, beam_oscillation"
    ):
        reproduce.selected(["starfish"])


@pytest.mark.slow
def test_published_numbers_stand_beside_ours_and_a_failed_run_does_not_stop_the_others(
    monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reproduce, "subprocess", SimpleNamespace(Popen=RunHere, PIPE=None))
    monkeypatch.setitem(reproduce.ROWS["variants"]["published_physics"], "overrides", ["seed=-1"])
    arguments = ["--results", "out", "--overrides", *SMALL_BEAM]
    assert (
        end_of(
            monkeypatch,
            "beam_oscillation/default",
            "beam_oscillation/published_physics",
            *arguments,
        )
        == 2
    )
    page = Path("out/reproduction.md").read_text()
    (metrics,) = (json.loads(path.read_text()) for path in Path("runs").rglob("metrics.json"))
    ours = " ".join(error_parts(metrics["errors_mm"]["resphys"])).strip()
    assert f"| **ResPhys** | 0.004 ± 0.010 | {ours} |" in page
    time = metrics["seconds_per_test_trajectory"]["simulation"]
    assert (
        f"| Uncorrected simulator | 0.711 ± 0.002 5.1 ms a step | {time['mean']:.3f} ± "
        f"{time['std']:.3f}" in page
    )
    assert "seed is -1" in page
    assert Path("out/reproduction/beam_oscillation_error_over_time.png").is_file()
    overrides = ["ablation.counts=[1,4]", "ablation.draws=3", "ablation.processes=1"]
    assert end_of(monkeypatch, "marker_ablation", *arguments, *overrides) == 0
    (ablation,) = (
        json.loads(path.read_text()) for path in Path("runs/marker_ablation").rglob("metrics.json")
    )
    median = number_text(ablation["by_markers"][1]["median_mm"])
    assert f"| 4 | below 0.1 | high | {median} |" in Path("out/reproduction.md").read_text()


@pytest.mark.release
@pytest.mark.slow
def test_a_robot_has_a_row_and_those_of_earlier_runs_keep_theirs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(reproduce.ROWS["robots"]["sopra"], "experiment", "tendon_rod")
    shutil.copytree(DOCS / "robots", "out/robots")
    kept = json.loads((DOCS / "robots.json").read_text())
    del kept["sopra"]
    Path("out/robots.json").write_text(json.dumps(kept))
    assert end_of(monkeypatch, "robots", "--results", "out", "--overrides", *SMALL_ROBOT) == 0
    (metrics,) = (json.loads(path.read_text()) for path in Path("runs").rglob("metrics.json"))
    page = Path("out/robots.md").read_text()
    rows = {row[0]: row[1:] for row in table_of(page, "| Robot | Without physics [mm]")}
    before = {
        row[0]: row[1:]
        for row in table_of((DOCS / "robots.md").read_text(), "| Robot | Without physics [mm]")
    }
    means = [
        error_parts(metrics["errors_mm"][m])[0]
        for m in ("simulation", "sysid", "simfree", "resphys")
    ]
    (title,) = rows.keys() - before.keys()  # with the overrides
    assert title.startswith("SoPrA (")
    assert [cell.split()[0] for cell in rows.pop(title)[1:5]] == means
    del before["SoPrA"]
    assert rows == before
    assert "Tested on 2 trials, held out: " in page
    assert "A finer mesh moves the markers of the identified simulator by " in page
    assert json.loads(Path("out/robots.json").read_text()).keys() == {"sopra", *kept}
