"""The page of robots: whose recordings are there, that they are the right ones, and what it says of each."""

import contextlib
import json
import shutil
from pathlib import Path

import pytest

from support.command_line import configuration, settings_of
from support.main_job import end_of
from support.reproduced import runs_in_this_process
from warp_resphys import cli
from warp_resphys.io.errors import InputError
from warp_resphys.io.settings import parse
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.report.page import NONE, error_parts
from warp_resphys.studies.reproduction import reproduce
from warp_resphys.studies.robot_results import Measured, _beside, summary, verdict
from warp_resphys.studies.rows import Reproduction

SMALL = [
    *("mesh.layers=3", "mesh.nodes=20", "laboratory.mesh.layers=4", "laboratory.mesh.nodes=20"),
    *("data.steps=12", "data.sequences=5", "data.train=2", "data.validation=1", "data.test=2"),
    *("data.horizons=[0.06,0.12]", "data.rest_seconds=0.01", "data.cutoff=20.0", "laboratory.sequences.rest=0.01"),
    *("laboratory.sequences.correlation_time=0.03", "identify.trials=1", "identify.seconds=0.1"),
    *("identify.max_evaluations=2", "identify.grid=null", "mesh_check=1.4", "parallel.processes=1"),
    *("network.position_modes=2", "network.velocity_modes=0", "network.force_modes=2", "network.width=8"),
    *("trainer.epochs=4", "trainer.rollout_every=2", "trainer.batch_size=16"),
]
# In place of the arm, whose recordings are simulated too, a rod that takes seconds.
ARGUMENTS = [
    "robots.sopra.experiment=tendon_rod",
    f"robots.sopra.overrides={json.dumps(SMALL, separators=(',', ':'))}",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
]


def run(*arguments):
    """Exit code of the command in this process, and what it wrote to stderr."""
    return end_of(cli.main, "warp-resphys", "reproduce", *arguments)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("robots")
    with contextlib.chdir(root), runs_in_this_process():
        (root / "shelf").mkdir()
        code, err = run(*ARGUMENTS, "only=[sopra,tentacle]", "data=shelf", "results=docs")
    assert (code, err[-500:] if code else "") == (0, "")
    return root


def test_a_robot_has_a_row_a_picture_and_what_was_tested(finished):
    (folder,) = (finished / "runs/tendon_rod").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    for text in (
        (finished / "docs/robots.md").read_text(),
        (finished / "outputs/reproduce/robots/results.md").read_text(),
    ):
        row = next(line for line in text.splitlines() if line.startswith("| SoPrA |"))
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        means = [error_parts(metrics["errors_mm"][m])[0] for m in ("simulation", "sysid", "simfree", "resphys")]
        assert [cell.split()[0] for cell in cells[2:6]] == means
        plain = {model: metrics["errors_mm"][model]["mean"] for model in BASELINES if model in metrics["errors_mm"]}
        assert cells[1].startswith(error_parts(metrics["errors_mm"][min(plain, key=plain.get)])[0])
        share = 1.0 - metrics["errors_mm"]["sysid"]["mean"] / metrics["errors_mm"]["simulation"]["mean"]
        assert cells[6].replace("\N{MINUS SIGN}", "-") == f"{100.0 * share:.0f} %"
        assert "Tested on 2 trials, held out: " in text
        assert "A finer mesh moves the markers of the identified simulator by " in text
        assert "Tentacle: no folder tentacle" in text
    assert (finished / "docs/robots/sopra.png").is_file()
    page = (finished / "outputs/reproduce/robots/robots.html").read_text()
    assert "pressures of six chambers" in page
    assert str(finished) not in page
    assert "data=FOLDER" in page


def test_robots_of_earlier_runs_keep_their_rows(finished, tmp_path, monkeypatch):
    """The page is of all that was measured, each with its day; what is run again has a new row."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished / "docs", "docs")
    shutil.copytree(finished / "runs", "runs")
    known = json.loads(Path("docs/robots.json").read_text())
    assert list(known) == ["sopra"]
    other = {
        **known["sopra"],
        "day": "2020-02-02",
        "beside": None,
        "errors_mm": {"sysid": {**known["sopra"]["errors_mm"]["sysid"], "mean": 77.7}},
    }
    old = {**known["sopra"], "day": "2019-01-01", "seconds": 1.0}
    Path("docs/robots.json").write_text(json.dumps({"sopra": old, "fish_tail": other}))
    shutil.copy("docs/robots/sopra.png", "docs/robots/fish_tail.png")
    code, err = run(*ARGUMENTS, "only=[sopra]", "results=docs")
    assert (code, err[-500:] if code else "") == (0, "")
    assert json.loads(Path("docs/robots.json").read_text()) == {"sopra": known["sopra"], "fish_tail": other}
    page = Path("docs/robots.md").read_text()
    assert "2020-02-02" in page
    assert "2019-01-01" not in page
    row = next(line for line in page.splitlines() if line.startswith("| Fish tail |"))
    assert "77.7" in row.split("|")[4]
    assert Path("docs/robots/fish_tail.png").is_file()


@pytest.mark.parametrize(
    ("kept", "arguments", "said"),
    [
        ('{"sopra": {"mean": 1.0}}', [], "robots.json"),
        (None, ["budget=quick"], "budget=quick"),
    ],
)
def test_rows_that_cannot_be_kept_or_replaced_are_refused(kept, arguments, said, finished, tmp_path, monkeypatch):
    """One of another version, and one that was measured with other settings."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished / "docs", "docs")
    if kept is not None:
        Path("docs/robots.json").write_text(kept)
    settings = settings_of(Reproduction, "reproduce", *ARGUMENTS, "only=[sopra]", "results=docs", *arguments)
    with pytest.raises(InputError, match=said):
        reproduce(settings, tmp_path / "outputs")
    assert not Path("runs").exists()


def measured(*gain):
    """A row with this share of the error that the learned force removes, its interval, and the number of trials."""
    share = dict(zip(("share", "lower", "upper", "trials"), gain, strict=True)) if gain else None
    row = {"day": "2026-01-02", "machine": {}, "arguments": [], "beyond": [], "tested": ["a"], "how": "held out"}
    errors = {model: {"mean": 2.0, "std": 0.5} for model in ("simulation", "sysid")}
    row |= {"errors_mm": errors, "gains": {"sysid": None, "resphys": share}, "intervals": None}
    return parse(Measured, {**row, "seconds": 90.0, "moved_mm": None})


def test_the_best_corrected_model_is_one_of_the_table():
    errors = {"rest": 9.0, "simulation": 2.0, "sysid_elastic": 0.1, "sysid": 1.0, "published": 0.1}
    row = _beside({"per_trajectory": [{"name": "a", "errors_mm": errors}]})
    assert (row.corrected, row.other) == ("sysid", "simulation")
    assert row.gain.share == pytest.approx(0.5)


def test_a_force_helps_where_the_whole_interval_of_several_trials_does():
    robots = settings_of(Reproduction, "reproduce").robots
    names = list(robots)[:4]
    gains = [(0.5, 0.2, 0.7, 5), (0.5, -0.1, 0.7, 5), (0.5, 0.4, 0.6, 4), ()]
    rows = {name: measured(*gain) for name, gain in zip(names, gains, strict=True)}
    assert [row.is_helped for row in rows.values()] == [True, False, False, False]
    said = verdict(robots, rows)
    assert f"identification on 1 of 4 robots ({robots[names[0]].title})." in said
    assert "all other models (uncorrected, a network alone, without physics) on 0 of 0 robots for which" in said
    (table,) = summary(robots, rows, failed=[names[1]]).blocks
    assert [row.head for row in table.rows] == [robots[name].title for name in names]
    texts = ["50 % (20 to 70)", "50 % (\N{MINUS SIGN}10 to 70)", "50 %", NONE]
    assert [row.cells[6].text for row in table.rows] == texts
    assert [row.small.endswith("failed since 2026-01-02") for row in table.rows] == [False, True, False, False]


def test_a_robot_that_fails_keeps_its_row_and_says_so(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished / "docs", "docs")
    broken = ARGUMENTS[1].replace("data.steps=12", "data.steps=-1")
    code, err = run(ARGUMENTS[0], broken, *ARGUMENTS[2:], "only=[sopra]", "results=docs")
    assert code != 0
    assert "1 of 1 runs failed" in err
    page = Path("docs/robots.md").read_text()
    row = next(line for line in page.splitlines() if line.startswith("| SoPrA |"))
    assert "±" in row
    assert "SoPrA failed: data.steps is -1" in page
    assert json.loads(Path("docs/robots.json").read_text()) == json.loads((finished / "docs/robots.json").read_text())


def test_every_robot_is_an_experiment_whose_files_are_known():
    for robot in settings_of(Reproduction, "reproduce").robots.values():
        assert configuration("config", f"experiment={robot.experiment}", *robot.overrides)["name"] == robot.experiment
        assert (robot.recordings is None) == (not robot.files)
        assert all(len(digest) == 64 for digest in robot.files.values())


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "is missing: fetch it again, or leave tentacle out"),
        (b"0,1", "differs from the file that tentacle was measured with"),
    ],
)
def test_recordings_that_are_not_those_of_the_page_are_refused(content, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "shelf/tentacle"
    folder.mkdir(parents=True)
    if content is not None:
        (folder / "m1_u01.csv").write_bytes(content)
    for file in settings_of(Reproduction, "reproduce").robots["tentacle"].files if content is not None else ():
        (folder / file).write_bytes(content)
    code, err = run("data=shelf", "only=[tentacle]", *ARGUMENTS[2:])
    assert code == 2
    assert said in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["only=[starfish]"], "'starfish'"),
        (["only=[]"], "only is []"),
        (["robots", "robots.tentacle.minutes=3"], "robots.tentacle.minutes is 3"),
        (["only=[tentacle]"], "data is None, where there is none of tentacle"),
        (["only=[tentacle]", "data=nowhere"], "data is nowhere, where there is none of tentacle"),
    ],
)
def test_what_cannot_be_run_is_refused(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, err = run(*arguments, *ARGUMENTS[2:])
    assert code == 2
    assert said in err


def test_the_readme_has_the_figures_of_the_robots():
    """Every robot of docs/robots.md has a row in README.md, with the same errors, rounded there."""
    robots = table_of(Path("docs/robots.md").read_text(), "| Robot | Without physics [mm]")
    readme = table_of(Path("README.md").read_text(), "| robot | without physics")
    for robot, *measured in robots:
        (row,) = (cells for cells in readme if cells[0].casefold().startswith(robot.casefold()))
        shown = [cell.strip("*") for cell in row[1:5]]
        expected = [measured[column].split()[0] for column in (0, 1, 2, 4)]
        for text, exact in zip(shown, expected, strict=True):
            digits = len(text.partition(".")[2])
            assert abs(float(text) - float(exact)) <= 0.5 * 10.0**-digits + 1e-9, (robot, text, exact)


def table_of(text, head):
    """The cells of the rows of a Markdown table whose first line begins in a given way."""
    lines = text[text.index(head) :].partition("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
