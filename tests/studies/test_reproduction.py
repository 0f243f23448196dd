"""The reproduction: which runs it makes, what its page says of them, and how it ends. Small beams, few steps."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

import pytest

from support.command_line import configuration, settings_of
from support.main_job import end_of
from support.reproduced import runs_in_this_process
from warp_resphys import cli
from warp_resphys.io.errors import InputError
from warp_resphys.learning.metrics import PUBLISHED_MM, PublishedError
from warp_resphys.report.page import NONE, error_parts, number_text
from warp_resphys.studies.comparison import missing_section
from warp_resphys.studies.rows import Reproduction
from warp_resphys.studies.runs import Run, _Pace, execute

TINY = [
    'overrides=["mesh.divisions=[4,2,2]","data.steps=8","trainer.epochs=4","trainer.rollout_every=2"]',
    'experiments.marker_ablation.overrides=["ablation.counts=[1,4]","ablation.draws=3","ablation.processes=1"]',
    "budget=quick",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
]
STARTED = ["beam_oscillation/default", "beam_oscillation/published_network", "beam_twist/default", "marker_ablation"]
FAILING = 'experiments.beam_twist.overrides=["data.twist_axis=w"]'
DEFAULT = Path("runs/beam_oscillation")


def plan(*overrides):
    return settings_of(Reproduction, "reproduce", *overrides).beams()


def run(*arguments):
    """Exit code of the command in this process, and what it wrote to stderr."""
    return end_of(cli.main, "warp-resphys", "reproduce", *arguments)


@pytest.fixture(scope="module", autouse=True)
def _runs_are_in_this_process():
    """Other processes are tested by Ctrl-C below, and in `test_robots`."""
    with runs_in_this_process():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two variants of one experiment, the ablation, and a run that fails between them."""
    root = tmp_path_factory.mktemp("reproduction")
    with contextlib.chdir(root):
        code, err = run(*TINY, FAILING, f"only=[{','.join(STARTED)}]", "results=docs")
    return root, code, err


def metrics(root, experiment, variant):
    folder = root / "runs" / experiment
    published = [path for path in folder.iterdir() if "network=published" in path.name]
    other = [path for path in folder.iterdir() if path not in published]
    (chosen,) = published if variant == "published_network" else other
    return json.loads((chosen / "metrics.json").read_text())


class TestPage:
    def test_a_failed_run_is_one_sentence_and_the_others_are_run(self, finished):
        root, code, err = finished
        assert code == 2
        assert err.splitlines()[-1].startswith("error: 1 of 4 runs failed (beam_twist/default): the page says why")
        assert "Traceback" not in err
        assert [f"[{number}/4] {name}" for number, name in enumerate(STARTED[:3], 1)] == re.findall(
            r"^(\[[123]/4\] [\w/]+), about \d+:\d\d left in all$", err, flags=re.MULTILINE
        )
        page = (root / "outputs/reproduce/beams/reproduction.html").read_text()
        assert "Twisting beam: here: data.twist_axis is &#39;w&#39;" in page
        assert len(list((root / "runs/marker_ablation").glob("*/metrics.json"))) == 1

    def test_each_published_number_stands_beside_ours(self, finished):
        root, _, _ = finished
        text = (root / "outputs/reproduce/beams/results.md").read_text()
        ours, network = (
            metrics(root, "beam_oscillation", variant)["errors_mm"] for variant in ("default", "published_network")
        )
        for model, label, published in (
            ("simulation", "Uncorrected simulation", "4.488 ± 1.468"),
            ("simfree", "SimFree", "0.035 ± 0.070"),
            ("resphys", r"\*\*ResPhys\*\*", "0.004 ± 0.010"),
        ):
            cells = [" ".join(error_parts(errors[model])).strip() for errors in (ours, network)]
            assert re.search(
                rf"^\| {label} \| {published} \| {re.escape(cells[0])} \| {re.escape(cells[1])} \|$", text, re.M
            )
        times = metrics(root, "beam_oscillation", "default")["seconds_per_test_trajectory"]["simulation"]
        assert (
            f"| Uncorrected simulation | 0.711 ± 0.002 5.1 ms a step | {times['mean']:.3f} ± {times['std']:.3f}" in text
        )
        for row in metrics(root, "marker_ablation", "default")["by_markers"]:
            published = "below 0.1" if row["markers"] >= 4 else "not given"
            assert f"| {row['markers']} | {published} | high | {number_text(row['median_mm'])} |" in text
        assert "| Degrees of freedom | 528 | 135 |" in text
        assert "| Testing trajectories | 5 | 2 |" in text

    def test_the_page_needs_nothing_beside_it(self, finished):
        page = (finished[0] / "outputs/reproduce/beams/reproduction.html").read_text()
        assert not re.search(r"""<(?:script|img|link|iframe|source)\b[^>]*\b(?:src|href)\s*=\s*["'](?!data:)""", page)
        assert len(re.findall(r"<figure ", page)) == 3
        assert "4.488" in page

    def test_the_dated_results_are_small_and_whole(self, finished):
        (page,) = (finished[0] / "docs").glob("*.md")
        assert page.name == f"{datetime.now():%Y-%m-%d}-reproduction.md"
        text = page.read_text()
        names = re.findall(r"\]\(([\w./-]+\.png)\)", text)
        assert len(names) == 3
        assert all(0 < (page.parent / name).stat().st_size < 200_000 for name in names)
        assert "warp-resphys reproduce " in text
        assert "| processor | " in text
        assert "&#39;" not in text

    def test_what_is_up_to_date_is_not_run_again(self, finished):
        root, _, _ = finished
        records = {path: path.read_bytes() for path in root.glob("runs/*/*/stages/*.json")}
        with contextlib.chdir(root):
            assert run(*TINY, "only=[beam_oscillation/default,marker_ablation]")[0] == 0
        assert {path: path.read_bytes() for path in root.glob("runs/*/*/stages/*.json")} == records


class TestPlan:
    def test_the_folders_are_those_of_the_ordinary_command(self):
        runs = {beam.name: beam for beam in plan('overrides=["seed=1"]', "runs=elsewhere")}
        assert runs["beam_twist/published_physics"].folder == Path("elsewhere/beam_twist/physics=published,seed=1")
        assert runs["beam_twist/published_physics"].arguments == (
            "experiment=beam_twist",
            "physics=published",
            "seed=1",
        )
        assert plan()[0].folder == Path("runs/beam_oscillation/default")

    def test_every_configured_run_is_a_configuration(self):
        assert [beam.name for beam in plan()] == [
            *(
                f"{beam}/{variant}"
                for beam in ("beam_oscillation", "beam_twist")
                for variant in ("default", "published_physics", "published_network")
            ),
            "marker_ablation/default",
        ]
        runs = plan("budget=quick")
        assert all(configuration("config", *run.arguments)["budget"] == "quick" for run in runs)

    def test_only(self):
        names = [beam.name for beam in plan("only=[marker_ablation,beam_twist/default]")]
        assert names == ["beam_twist/default", "marker_ablation/default"]

    @pytest.mark.parametrize(
        ("override", "sentence"),
        [
            ("only=[beam_twst]", "only names 'beam_twst': there are beams, robots, beam_oscillation, "),
            ("only=[]", "only is []: "),
            ("only=beam_twist", "only is 'beam_twist': it must be a list of "),
            ("overrides=[1]", "overrides is [1]: it must be a list of words"),
            ("experiments.beam_twist.variants=[quick]", "experiments.beam_twist.variants names 'quick': there are "),
        ],
    )
    def test_bad_input(self, override, sentence):
        with pytest.raises(InputError, match=re.escape(sentence)):
            plan(override)

    def test_bad_input_on_the_command_line(self, folder):
        code, err = run("sopra_fibres", "hydra/job_logging=none", "hydra/hydra_logging=none")
        assert code == 2
        assert err.startswith("error: only names 'sopra_fibres'")
        assert len(err.splitlines()) == 1


def test_what_no_run_reproduces_is_listed_with_what_was_published():
    published = {"sopra": PUBLISHED_MM["sopra"], "new": {"resphys": PublishedError(1.25, 0.5)}}
    (table,) = missing_section(published).blocks
    assert [row.head for row in table.rows] == ["Pneumatic arm", "new"]
    assert [cell.text for cell in table.rows[1].cells] == [NONE, NONE, NONE, "1.25"]
    assert len(table.columns) == 4


def test_the_estimate_learns_from_the_runs_that_are_done(tmp_path):
    def planned(name, minutes):
        return Run(name, "default", (), tmp_path / name, minutes)

    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "metrics.json").write_text("{}")
    runs = [planned("first", 1.0), planned("there", 50.0), planned("last", 2.0)]
    pace = _Pace(runs)
    assert pace.left() == pytest.approx(180.0 + 8.0)
    pace.count(runs[0], 30.0)
    assert pace.left() == pytest.approx(0.5 * 120.0 + 8.0)
    pace.count(runs[1], 5.0)
    assert pace.left() == pytest.approx(60.0)


def test_a_run_that_ends_without_a_sentence_points_to_its_log(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    log = tmp_path / "log"
    assert execute(Run("a", "b", (), tmp_path, 1.0), log, print) == f"exit code 1; its output is in {log}"


def test_ctrl_c_stops_the_run_and_keeps_what_it_has(folder):
    """The signal reaches the reproduction alone; it hands it on to the run, which is out of reach of the terminal."""
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program += "from warp_resphys.cli import main\nmain()"
    arguments = [override for override in TINY if not override.startswith("overrides")]
    command = [sys.executable, "-c", program, "reproduce", *arguments, "only=[beam_oscillation/default]"]
    child = subprocess.Popen(
        command,
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    checkpoints = []
    while not checkpoints and child.poll() is None:
        time.sleep(0.01)
        checkpoints = [*DEFAULT.glob("*/**/*.frames_*.safetensors")]
    child.send_signal(signal.SIGINT)
    err = child.communicate(timeout=100)[1]
    assert child.returncode == 130, err
    assert "interrupted in run 1 of 1, beam_oscillation/default" in err
    assert "Traceback" not in err
    assert not Path("outputs/reproduce/beams/reproduction.html").exists()
    assert "interrupted in stage 'simulate'" in Path("outputs/reproduce/logs/beam_oscillation-default.log").read_text()
    assert checkpoints[0].stat().st_size > 0
