import io
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from support.refusals import refuses
from warp_resphys.io import resuming
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.machine import peak_memory_gib
from warp_resphys.io.progress import Progress, one_line, title_of
from warp_resphys.io.safe_files import write_json

REPOSITORY = Path(__file__).parents[2]


class Experiment:
    """Three small stages in a row, and the order in which they ran."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.ran: list[str] = []
        self.settings: dict[str, dict[str, Any]] = {
            "generate": {"seed": 0},
            "train": {"epochs": 5},
            "report": {},
        }
        self.behaviour: dict[str, Callable[[resuming.StageContext], None]] = {}

    def work(self, context: resuming.StageContext) -> None:
        self.ran.append(context.name)
        self.behaviour.get(context.name, lambda context: None)(context)
        write_json(context.run_dir / f"{context.name}.json", context.settings)

    def stages(self) -> list[resuming.Stage]:
        upstream = {"generate": (), "train": ("generate",), "report": ("generate", "train")}
        return [
            resuming.Stage(name, self.work, (f"{name}.json",), self.settings[name], upstream[name])
            for name in self.settings
        ]

    def run(self) -> list[str]:
        self.ran.clear()
        self.seconds = resuming.run_stages(self.stages(), self.run_dir)
        return list(self.ran)


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    return Experiment(tmp_path / "run")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_the_peak_of_memory_is_the_largest_of_all_stages(experiment):
    experiment.run()
    used = resuming.resources_used(experiment.run_dir, ["generate", "train", "evaluate"])
    assert used["seconds"] == {name: experiment.seconds[name] for name in ("generate", "train")}
    assert used["peak_memory_gib"] == pytest.approx(peak_memory_gib(), rel=0.1)
    path = experiment.run_dir / "stages" / "generate.json"
    write_json(path, json.loads(path.read_text()) | {"peak_memory_gib": 3.0})
    assert (
        resuming.resources_used(experiment.run_dir, ["generate", "train"])["peak_memory_gib"] == 3.0
    )
    assert resuming.resources_used(experiment.run_dir, ["none"])["peak_memory_gib"] is None
    assert experiment.run() == []


class TestSkipping:
    def test_nothing_runs_twice(self, experiment, caplog):
        caplog.set_level("INFO")
        assert experiment.run() == ["generate", "train", "report"]
        seconds = experiment.seconds
        assert seconds.keys() == experiment.settings.keys()
        assert experiment.run() == []
        assert experiment.seconds == seconds
        lines = [r.message.split() for r in caplog.records]
        assert lines == [
            ["generate", "0", "s"],
            ["Training", "the", "force", "0", "s"],
            ["Writing", "the", "report", "0", "s"],
        ]
        record = json.loads((experiment.run_dir / "stages" / "train.json").read_text())
        assert record["settings"] == {"epochs": 5}
        assert record["versions"]["h5py"]

    def test_changed_settings_run_the_stage_and_those_after_it(self, experiment):
        experiment.run()
        experiment.settings["train"] = {"epochs": 6}
        assert experiment.run() == ["train", "report"]
        experiment.settings["generate"] = {"seed": 1}
        assert experiment.run() == ["generate", "train", "report"]
        assert experiment.run() == []

    def test_missing_or_damaged_outputs_are_made_again(self, experiment, caplog):
        experiment.run()
        output = experiment.run_dir / "train.json"
        for content in (None, "{", '{\n  "epochs": 7\n}\n'):
            output.unlink()
            if content is not None:
                output.write_text(content)
            assert experiment.run() == ["train"]
            assert "missing or changed since they were written: train.json" in caplog.text
            assert json.loads(output.read_text()) == {"epochs": 5}
        assert experiment.run() == []

    @pytest.mark.parametrize("record", ["", "[]", '{"fingerprint": 3}'])
    def test_a_stage_with_an_invalid_record_runs_again(self, experiment, record):
        experiment.run()
        (experiment.run_dir / "stages" / "train.json").write_text(record)
        assert experiment.run() == ["train"]

    def test_outputs_of_two_settings_are_never_mixed(self, experiment):
        """Old outputs stay valid until new ones replace them.

        Half replaced, they are valid for neither.
        """

        def two_outputs(context: resuming.StageContext) -> None:
            write_json(context.run_dir / "a.json", context.settings)
            if stop:
                raise KeyboardInterrupt
            write_json(context.run_dir / "b.json", context.settings)
            experiment.ran.append(str(context.settings["x"]))

        def run(x: int) -> list[str]:
            experiment.ran.clear()
            resuming.run_stages(
                [resuming.Stage("s", two_outputs, ("a.json", "b.json"), {"x": x})],
                experiment.run_dir,
            )
            return experiment.ran

        stop = False
        assert run(1) == ["1"]
        stop = True
        with pytest.raises(resuming.StageInterrupted):
            run(2)
        stop = False
        assert run(1) == ["1"]
        assert run(2) == ["2"]

    def test_the_fingerprint_does_not_depend_on_the_order_of_keys(self):
        def of(upstream: str = "u", **changes: Any) -> str:
            fields = {
                "name": "s",
                "function": print,
                "outputs": (),
                "settings": {"a": 1, "b": {"c": 2.0}},
            }
            return resuming.fingerprint(
                resuming.Stage(**{**fields, "upstream": ("before",), **changes}),
                {"before": upstream},
            )

        assert of() == of(settings={"b": {"c": 2.0}, "a": 1})
        others = [of("v"), of(name="t"), of(settings={"a": 1, "b": {"c": 3.0}})]
        assert len({of(), *others}) == 4


class TestInterruption:
    def test_the_message_names_finished_stages_and_seconds_add_up(self, experiment, clock):
        def interrupt_after_a_while(context: resuming.StageContext) -> None:
            clock[0] += 30.0
            raise KeyboardInterrupt

        def finish(context: resuming.StageContext) -> None:
            clock[0] += 5.0

        experiment.behaviour["train"] = interrupt_after_a_while
        for _ in range(2):
            refuses(
                resuming.StageInterrupted,
                r"in stage 'train' \(finished and kept: generate; ",
                experiment.run,
            )
        experiment.behaviour["train"] = finish
        assert experiment.run() == ["train", "report"]
        assert experiment.seconds == {"generate": 0.0, "train": 65.0, "report": 0.0}
        records = sorted(path.name for path in (experiment.run_dir / "stages").iterdir())
        assert records == ["generate.json", "report.json", "train.json"]

        experiment.settings["train"] = {"epochs": 6}
        experiment.behaviour["train"] = interrupt_after_a_while
        with pytest.raises(resuming.StageInterrupted):
            experiment.run()
        experiment.settings["train"] = {"epochs": 7}
        experiment.behaviour["train"] = finish
        experiment.run()
        assert experiment.seconds["train"] == 5.0

    def test_errors_pass_through_and_the_stage_runs_again(self, experiment):
        def fail(context: resuming.StageContext) -> None:
            raise InputError("no")

        experiment.behaviour["train"] = fail
        refuses(InputError, "no", experiment.run)
        experiment.behaviour.clear()
        assert experiment.run() == ["train", "report"]


def test_one_process_at_a_time_in_a_folder_that_can_be_made(experiment, tmp_path):
    with (
        resuming.run_lock(experiment.run_dir),
        pytest.raises(InputError, match="another process is writing the run folder"),
    ):
        experiment.run()
    assert experiment.ran == []
    assert experiment.run() == ["generate", "train", "report"]
    (tmp_path / "file").touch()
    with (
        pytest.raises(DataFileError, match="cannot write the run folder"),
        resuming.run_lock(tmp_path / "file" / "run"),
    ):
        pass


class TestProgress:
    @pytest.mark.parametrize(
        ("stage", "title"),
        [
            ("train_resphys: without 1 of 3", "Training the force: without 1 of 3"),
            ("train_actuator: held out", "Training the actuator: held out"),
            ("reduce", "Fitting the reduced model"),
            ("Differentiating", "Differentiating"),
        ],
    )
    def test_parts_of_a_stage_have_its_title(self, stage, title):
        assert title_of(stage) == title

    def test_a_log_gets_a_line_every_ten_seconds_and_one_at_the_end(self, clock):
        stream = io.StringIO()
        with Progress("train", 100, "epochs", start_at=40, console=Console(file=stream)) as bar:
            for _ in range(60):
                clock[0] += 0.5
                bar.advance(loss=0.0012345, rate="slow")
        assert stream.getvalue().splitlines() == [
            "Training the force: 60/100 epochs, 0:20 left, loss 0.00123, rate slow",
            "Training the force: 80/100 epochs, 0:10 left, loss 0.00123, rate slow",
            "Training the force: 100/100 epochs, in 30 s, loss 0.00123, rate slow",
        ]

    def test_the_time_left_does_not_count_a_slow_start(self, clock):
        """The first unit waits for its kernels for 60 s; the others take one."""
        stream = io.StringIO()
        with Progress("evaluate", 101, "frames", console=Console(file=stream)) as bar:
            for number in range(41):
                clock[0] += 60.0 if number == 0 else 1.0
                bar.advance()
        lines = stream.getvalue().splitlines()
        assert lines[0] == "Simulating the test trials: 1/101 frames"
        assert lines[1] == "Simulating the test trials: 11/101 frames, 1:30 left"
        assert lines[-1] == "Simulating the test trials: 41/101 frames, 1:00 left"

    @pytest.mark.parametrize("terminal", [True, False])
    def test_a_stage_ends_with_one_line_for_its_loops(self, clock, terminal):
        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, width=120)
        with one_line("reconstruct_resphys") as line:
            for unit in ("frames", "evaluations at most"):
                with Progress("reconstruct_resphys", 1650, unit, console=console) as bar:
                    clock[0] += 2.5
                    bar.advance(1650)
            assert (
                " ".join(line(5.0).split()) == "Reconstructing the missing forces 1,650 frames 5 s"
            )
        assert ("1650/1650 frames" in stream.getvalue()) is terminal

    @pytest.mark.parametrize("terminal", [True, False])
    def test_mostly_short_work_is_quiet_until_it_takes_long(self, clock, terminal):
        for seconds, shown in ((0.5, False), (1.5, True)):
            stream = io.StringIO()
            console = Console(file=stream, force_terminal=terminal)
            with Progress(
                "equilibrium", 9, "iterations at most", console=console, after=2.0
            ) as bar:
                for _ in range(3):
                    clock[0] += seconds
                    bar.advance()
            assert ("equilibrium" in stream.getvalue()) is shown
        if not terminal:
            assert stream.getvalue() == "equilibrium: iteration 3 (limit 9), in 4 s\n"

    @pytest.mark.parametrize(
        ("terminal", "most"), [(True, 201), (False, 2)], ids=["terminal", "log"]
    )
    def test_most_calls_only_count(self, clock, terminal, most):
        """In 20 s a bar is drawn every 0.1 s at most, a line printed every 10 s."""
        described = []

        class Observed(Progress):
            def status(self) -> str:
                described.append(self.done)
                return super().status()

        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, width=120)
        with Observed("roll out", 20_000, "steps", console=console) as bar:
            described.clear()
            for step in range(20_000):
                clock[0] += 1e-3
                bar.advance(error=0.5 * step)
            assert 0.9 * most <= len(described) <= most
        assert "20000/20000 steps" in stream.getvalue()
        assert "error 1e+04" in stream.getvalue()


def test_stages_are_expected_to_take_as_long_as_the_last_time(tmp_path):
    """As stages of one name on the same body and data, in any folder beside this one."""
    body = {
        "mesh": {"size": 0.01},
        "data": {"kind": "release"},
        "budget": "full",
        "time_step": 0.01,
    }

    def stage(**changes):
        return resuming.Stage("identify", lambda context: None, (), {**body, **changes})

    assert resuming.expected_seconds([stage()], tmp_path / "new") == {}
    for number, (changes, seconds) in enumerate(
        [({"seed": 1}, 80.0), ({"seed": 2}, 70.0), ({"budget": "quick"}, 5.0)]
    ):
        resuming.run_stages([stage(**changes)], tmp_path / str(number))
        record = tmp_path / str(number) / "stages" / "identify.json"
        finished = f"2026-01-0{3 - number}T00:00:00+00:00"
        record.write_text(
            json.dumps(json.loads(record.read_text()) | {"seconds": seconds, "finished": finished})
        )
    (tmp_path / "damaged" / "stages").mkdir(parents=True)
    (tmp_path / "damaged" / "stages" / "identify.json").write_text("{")
    assert resuming.expected_seconds(
        [stage(), replace(stage(), name="train")], tmp_path / "new"
    ) == {"identify": 80.0}
    assert resuming.expected_seconds([stage(budget="quick")], tmp_path / "new") == {"identify": 5.0}
    assert resuming.expected_seconds([stage(mesh={"size": 0.02})], tmp_path / "new") == {}
