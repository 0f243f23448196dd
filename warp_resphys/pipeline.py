"""An experiment: its stages in order, for one split or for every fold of a cross-validation.

The configuration determines the stages. The settings of a stage are exactly what its files depend
on.
"""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from threading import Thread
from typing import Any

import torch

from .control.control_files import BASELINES, plan_table, plans_file, reduced_file
from .control.control_stages import drive, fit_baselines, plan_motions, reduce_robot
from .control.task import motions_of
from .core.energies.catalogue import law_path
from .experiment import files
from .experiment.ablation import ablation_stages, print_ablation
from .experiment.build import choose_device
from .experiment.checks import check_run
from .experiment.digests import digest_of, files_read
from .experiment.experiment import LEARNED, SIMFREE
from .experiment.folds import Fold, intervals_of_folds, run_folds, workers_for
from .experiment.laboratory import run_laboratory
from .experiment.learning_stages import (
    evaluate,
    identify,
    identify_law,
    reconstruct,
    train,
    train_actuator,
)
from .experiment.mesh_check import check_mesh
from .experiment.recordings.importing import import_recordings, import_scaled
from .experiment.report import make_folds_report, make_report
from .experiment.run_metrics import collect_metrics
from .experiment.shapes import try_shapes
from .experiment.simulate import simulate
from .experiment.splits import folds_of, scaled_trials_of, split_of, test_groups, trials_of
from .experiment.timing import time_models
from .io.atomic import digest
from .io.fan_out import ALONE, Workers
from .io.kernel_cache import start_quietly
from .io.progress import show, title_of
from .io.resuming import (
    Stage,
    expected_seconds,
    package_versions,
    resources_used,
    run_stages,
    unfinished,
)
from .io.safe_files import read_json, write_json
from .learning.metrics import summarise_folds
from .report.conditions import conditions
from .report.control_section import tracking_table
from .report.data import Metrics
from .report.ranking import recommended, shown_metrics
from .report.sections import shapes_table
from .report.verdict import results_table, verdict
from .report.wording import duration_text
from .settings.body import TargetSettings
from .settings.control import ControlSettings
from .settings.performed import Split, Trial
from .settings.run import RunSettings
from .settings.stage_keys import (
    BATCH,
    FIGURES,
    IMPORTED,
    LEARNING,
    NETWORKS,
    PLAYED,
    SIMULATOR,
    StageSettings,
)

log = logging.getLogger(__name__)


_LEAST_SECONDS = 60.0  # that are announced
_MOST_THREADS = (
    4  # that share the trials of a batch, as Python's part of a step runs in one at a time
)


def acquisition_stages(run: RunSettings) -> list[Stage]:
    """Returns the stages that write dataset.h5: simulation of the trials,
    or import of (simulated) recordings.

    Args:
        run: settings that `check_run` accepts.

    Raises:
        DataFileError: a recording cannot be read.
    """
    digests, trials = files_read(run, run), trials_of(run)
    if run.recorded is None:
        keys = (*SIMULATOR, "target", "data")
        settings = StageSettings.reading(
            run, *keys, files=files_read(run, run, run.target), trials=trials
        )
        return [Stage("simulate", simulate, (files.DATASET,), settings)]
    split = None if folds_of(run) is not None else split_of(run)
    learned = None if split is None else split.train + split.validation

    def imported(trials: Sequence[Trial]) -> StageSettings:
        return StageSettings.reading(run, *IMPORTED, files=digests, trials=trials, learned=learned)

    outputs = (files.DATASET, files.QUALITY, files.REGISTRATION)
    if not run.is_laboratory:
        digests |= {
            str(trial.file): digest_of(Path(str(trial.file)), f"data.trials.{trial.name}.file")
            for trial in trials
        }
        return [Stage("import", import_recordings, outputs, imported(trials))]
    stages = [
        _laboratory_stage("laboratory", run, trials, files.TRUTH),
        Stage("import", import_recordings, outputs, imported(trials), ("laboratory",)),
    ]
    if scaled := scaled_trials_of(run):
        stages += [
            replace(_laboratory_stage("laboratory_scaled", run, scaled), upstream=("laboratory",)),
            Stage(
                "import_scaled",
                import_scaled,
                (files.SCALED_DATASET,),
                imported(scaled),
                ("import", "laboratory_scaled"),
            ),
        ]
    return stages


def _laboratory_stage(name: str, run: RunSettings, trials: Sequence[Trial], *truth: str) -> Stage:
    """Returns a stage that simulates the recordings of trials."""
    outputs = (*(trial.recording for trial in trials), *truth)
    settings = StageSettings.reading(
        run, *PLAYED, BATCH, files=files_read(run, run.laboratory), trials=trials
    )
    return Stage(name, partial(run_laboratory, workers=workers_of(run)), outputs, settings)


def workers_of(run: RunSettings) -> Workers:
    """Returns the workers of a run."""
    return workers_for(run.parallel, run.parallel.processes, run.device)


def learning_stages(
    run: RunSettings, split: Split, shared: str, acquired: str, workers: Workers | None = None
) -> list[Stage]:
    """Returns the stages of one split, from identification to report.

    Args:
        run: settings that `check_run` accepts.
        split: names of trials.
        shared: the folder of dataset.h5, relative to that of the split.
        acquired: fingerprint of the stage that wrote dataset.h5.
        workers: of the stages; those of the configuration if omitted.
    """
    split_stages = _SplitStages(
        run, split, shared, acquired, workers_of(run) if workers is None else workers
    )
    split_stages.identification()
    split_stages.learning()
    split_stages.evaluation()
    if run.control is not None:
        split_stages.control(run.control)
    return split_stages.with_report()


class _SplitStages:
    """The stages of one split in the order in which they run; see `learning_stages`."""

    def __init__(
        self, run: RunSettings, split: Split, shared: str, acquired: str, workers: Workers
    ) -> None:
        self.run, self.split, self.workers = run, split, workers
        self.stages: list[Stage] = []
        # Stages of the identification, which all others follow.
        self._identified: tuple[str, ...] = ()
        self._common: dict[str, Any] = {
            "files": files_read(run, run),
            "shared": shared,
            "split": split,
        }
        self._common["acquired"] = acquired

    def add(
        self,
        name: str,
        work: Callable[..., None],
        outputs: tuple[str, ...],
        keys: Sequence[str] = (),
        upstream: Sequence[str] = (),
        run: RunSettings | None = None,
        **values: Any,
    ) -> None:
        """Adds a stage.

        Args:
            name: of the stage.
            work: its function, which may take ``workers`` beside its context.
            outputs: its files.
            keys: of the run that it reads besides `LEARNING`.
            upstream: stages besides the identification whose files it reads.
            run: settings in place of those of the run.
            values: derived from the run.
        """
        work = (
            partial(work, workers=self.workers) if "workers" in signature(work).parameters else work
        )
        settings = StageSettings.reading(
            run or self.run, *LEARNING, *keys, **{**self._common, **values}
        )
        self.stages.append(Stage(name, work, outputs, settings, (*self._identified, *upstream)))

    def identification(self) -> None:
        """Adds the identification of parameters and law,
        its test on other bodies, and the learned actuator.
        """
        run = self.run.model_copy(update={"actuator": None, "control": None})
        digests = self._common["files"]
        if run.identify is not None:
            self.add(
                "identify",
                identify,
                (files.IDENTIFICATION,),
                ("seed",),
                run=run.model_copy(update={"law": None}),
            )
            self._identified = ("identify",)
        if run.law is not None:
            law = {} if run.law.file is None else {run.law.file: digest(law_path(run.law.file))}
            self.add(
                "identify_law",
                identify_law,
                (files.LAW_FILE,),
                ("name",),
                run=run,
                files=digests | law,
            )
            self._identified += ("identify_law",)
        if run.shapes:
            bodies = [body for shape in run.shapes.values() for body in (shape, shape.target_body)]
            keys = ("target", "shapes", "data.steps")
            self.add(
                "shapes",
                try_shapes,
                (files.SHAPES,),
                keys,
                run=run,
                files=digests | files_read(run, *bodies),
            )
        if self.run.actuator is not None:
            self.add("train_actuator", train_actuator, (files.ACTUATOR_FILE,))
            self._identified += ("train_actuator",)

    def learning(self) -> None:
        """Adds the reconstruction of residual forces, and the training of the networks."""
        run, split = self.run, self.split
        if run.reconstruction is None:
            return
        # For the published comparison, where all vertices are observed, test trials are
        # reconstructed, too.
        compared = split.test if run.markers is None and run.law is None else ()
        reconstructed = split.train + split.validation + compared
        for model in (model for model in LEARNED if model in run.models and model != SIMFREE):
            self.add(
                *(f"reconstruct_{model}", reconstruct, (files.reconstruction_file(model),)),
                ("reconstruction", "network.acts"),
                model=model,
                reconstructed=reconstructed,
            )
            outputs = (files.weights_file(model), files.training_file(model))
            training = run.training_of(model)
            upstream = (f"reconstruct_{model}",)
            self.add(
                f"train_{model}", train, outputs, NETWORKS, upstream, model=model, training=training
            )
        outputs = (files.weights_file(SIMFREE), files.training_file(SIMFREE))
        training = run.training_of(SIMFREE)
        needed = () if run.markers is None else ("reconstruct_resphys",)
        alone = (
            run
            if run.markers is not None or run.target is None
            else _without_simulator(run, run.target)
        )
        self.add(
            "train_simfree",
            train,
            outputs,
            NETWORKS,
            needed,
            alone,
            model=SIMFREE,
            training=training,
        )

    def evaluation(self) -> None:
        """Adds the roll-outs of all models on the test trials,
        their times, and the error of the mesh.
        """
        run, split, groups = self.run, self.split, test_groups(self.run, self.split)
        calibration = (
            (split.validation or split.train)
            if run.markers is not None and folds_of(run) is None
            else ()
        )
        made = [
            stage.name
            for stage in self.stages
            if stage.name.startswith(("train_", "reconstruct_resphys"))
        ]
        self.add(
            *("evaluate", evaluate, (files.ROLLOUTS, files.ERRORS)),
            (*NETWORKS, "reconstruction", "published", "correct_uncorrected", "data.horizons"),
            made,
            groups=groups,
            calibration=calibration,
        )
        if run.timing:
            keys = (*NETWORKS, "reconstruction", "target")
            self.add("time", time_models, (files.TIMES,), keys, made, groups=groups)
        played = run.laboratory if run.is_laboratory else None
        same = played is not None and (played.mesh, played.parts) == (run.mesh, run.parts)
        if run.mesh_check is not None and not same:
            first = {"1": groups["1"]}
            self.add(
                "mesh_check",
                check_mesh,
                (files.MESH_CHECK,),
                (*NETWORKS, "mesh_check"),
                groups=first,
            )

    def control(self, control: ControlSettings) -> None:
        """Adds plans on the models, and with a simulated laboratory, driven motions."""
        last, planned = control.models[-1], list[str]()
        # The last model must reach the paths, so it is checked first.
        for model in reversed(control.models):
            first, second = f"reduce_{model}", f"plan_{model}"
            planned += [first, second]
            keys: tuple[str, ...] = ("seed", "control.reduction")
            self.add(first, reduce_robot, (reduced_file(model),), keys, ("evaluate",), model=model)
            outputs = (
                plans_file(model),
                *(plan_table(model, motion) for motion in motions_of(control)),
            )
            keys = (*FIGURES, "control.plan")
            self.add(
                second, plan_motions, outputs, keys, (first,), model=model, must_reach=model == last
            )
        if self.run.laboratory is None:
            return
        digests = self._common["files"] | files_read(self.run, self.run.laboratory)
        keys = (*PLAYED, *FIGURES, "control.feedback")
        self.add(
            "baselines", fit_baselines, (BASELINES,), keys, ("evaluate",), model=last, files=digests
        )
        self.add(
            "drive",
            drive,
            (files.DRIVEN, files.CONTROL),
            (*PLAYED, "control"),
            (*planned, "baselines"),
            files=digests,
        )

    def with_report(self) -> list[Stage]:
        """Returns all stages, with that of the report, which shows the whole configuration."""
        shown = [
            stage.name
            for stage in self.stages
            if stage.name in ("shapes", "evaluate", "time", "mesh_check", "drive")
        ]
        return [*self.stages, Stage("report", make_report, (files.REPORT,), self.run, tuple(shown))]


def _without_simulator(run: RunSettings, target: TargetSettings) -> RunSettings:
    """Settings of a network that replaces the simulator, without those that identify the latter."""
    without = dict.fromkeys(("identify", "law", "actuator"))
    return run.model_copy(update={"simulation": target.material, "shapes": {}, **without})


def prepare(run: RunSettings) -> None:
    """Checks a run, and configures Warp and torch for it.

    Raises:
        InputError: values that do not match the mesh or the trials.
    """
    start_quietly()
    os.environ.setdefault("WARP_RESPHYS_THREADS", str(min(torch.get_num_threads(), _MOST_THREADS)))
    if run.device == "cpu" or not torch.cuda.is_available():
        # The networks are too small for several threads (linalg/threads.py).
        torch.set_num_threads(1)
    if run.material_tests is not None:
        from .experiment.material_stages import table_files

        table_files(run.material_tests)
    elif run.pictures is None:
        check_run(run)
    else:
        from .experiment.pictures.picture_stages import check_pictures

        check_pictures(run)


def acquire(run: RunSettings, folder: Path, wait: bool = False) -> tuple[list[Stage], str]:
    """Runs the stages that write dataset.h5; returns them, and the fingerprint of the last."""
    stages = acquisition_stages(run)
    if unfinished(stages, folder):
        # Torch's first optimiser imports it for a second, in which kernels are compiled.
        Thread(target=import_module, args=("torch._dynamo",)).start()
    run_stages(stages, folder, wait)
    (written,) = (stage.name for stage in stages if files.DATASET in stage.outputs)
    return stages, str(read_json(folder / "stages" / f"{written}.json")["fingerprint"])


def run_experiment(run: RunSettings, folder: Path) -> None:
    """Runs the stages that have changed, writes metrics.json to the run folder
    and prints the errors.

    Raises:
        InputError: an invalid setting.
    """
    prepare(run)
    if run.pictures is not None:
        from .experiment.pictures.picture_stages import picture_stages, print_pictures

        run_stages(picture_stages(run, files_read(run, run)), folder)
        print_pictures(run, folder)
        return
    if run.material_tests is not None:
        from .experiment.material_stages import material_stages, print_material

        run_stages(material_stages(run, run.material_tests), folder)
        print_material(run, folder)
        return
    if run.ablation is not None:
        run_stages(ablation_stages(run, files_read(run, run, run.target)), folder)
        print_ablation(run, folder)
        return
    if played := " and ".join(run.targets):
        log.info(
            "The %s is simulated as well: errors compare simulators, and no real robot", played
        )
    first, acquired = acquire(run, folder)
    folds = folds_of(run)
    if folds is None:
        stages = learning_stages(run, split_of(run), ".", acquired)
        _announce(unfinished(stages, folder), folder)
        run_stages(stages, folder)
        metrics = collect_metrics(folder, run, [stage.name for stage in (*first, *stages)])
    else:
        metrics = _run_folds(run, folder, folds, first, acquired)
    write_json(folder / files.METRICS, metrics)
    if folds is not None:
        errors = {trial: fold["errors_mm"] for trial, fold in metrics["folds"].items()}
        reported = StageSettings.reading(run, *RunSettings.model_fields, folds=errors)
        run_stages(
            [
                *first,
                Stage("report", make_folds_report, (files.REPORT,), reported, (first[-1].name,)),
            ],
            folder,
        )
    _print(metrics, folder, run)


def _announce(left: Sequence[Stage], folder: Path, times: float = 1.0) -> None:
    """Logs how long unfinished stages took the last time,
    if that is known of all and is more than a minute.

    Args:
        left: the stages.
        folder: of the split.
        times: factor of the duration, as of several folds.
    """
    took = {
        name: times * seconds
        for name, seconds in expected_seconds(left, folder).items()
        if name != "report"
    }
    if sum(took.values()) < _LEAST_SECONDS or not {stage.name for stage in left} <= {
        *took,
        "report",
    }:
        return
    longest = sorted(took, key=lambda name: -took[name])[:3]
    parts = ", ".join(f"{title_of(name)} {duration_text(took[name])}" for name in longest)
    log.info("About %s more, as the last time (%s)", duration_text(sum(took.values())), parts)


def _run_folds(
    run: RunSettings,
    folder: Path,
    splits: Mapping[str, Split],
    first: Sequence[Stage],
    acquired: str,
) -> Metrics:
    """Runs a cross-validation, each fold in its own folder; returns the content of metrics.json."""
    folds = {
        name: Fold(
            name,
            folder / files.fold_folder(name),
            partial(learning_stages, run, split, "..", acquired),
        )
        for name, split in splits.items()
    }
    left = [fold for fold in folds.values() if unfinished(fold.stages(ALONE), fold.folder)]
    if left:
        times = len(left) / workers_of(run).at_most(len(left)).count
        _announce(left[0].stages(ALONE), left[0].folder, times)
    run_folds(folds, workers_of(run))
    metrics = dict[str, Metrics]()
    for name, fold in folds.items():
        metrics[name] = collect_metrics(
            fold.folder, run, [stage.name for stage in fold.stages(ALONE)]
        )
        write_json(fold.folder / files.METRICS, metrics[name])
    over_folds: Metrics = {
        "errors_mm": summarise_folds([of_fold["errors_mm"] for of_fold in metrics.values()]),
        "folds": metrics,
        **resources_used(folder, [stage.name for stage in first]),
        "versions": package_versions(),
        "device": str(choose_device(run.device)),
    }
    if (intervals := intervals_of_folds(folder, {n: fold.folder for n, fold in folds.items()}))[
        "models"
    ]:
        over_folds["intervals"] = intervals
    over_folds["recommended"] = recommended(over_folds, run)
    return over_folds


def _print(metrics: Metrics, folder: Path, run: RunSettings) -> None:
    """Prints what the report begins with: the mean errors,
    the verdict, the advice and the conditions.
    """
    metrics = shown_metrics(metrics)
    tables = [results_table(metrics, run)]
    tables += [tracking_table(metrics["control"]["tracking"])] if "control" in metrics else []
    tables += [shapes_table(metrics["shapes"])] if "shapes" in metrics else []
    holds = [f"- {line}" for line in conditions(metrics, run)]
    show(*tables, *verdict(metrics, run), *holds, f"Report: {folder / files.REPORT}")
