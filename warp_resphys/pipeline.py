"""An experiment: its stages in order, for one split or for every fold of a cross-validation.

The configuration determines the stages. The settings of a stage are exactly what its files depend on.
"""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

import torch

from .control.files import BASELINES, plan_table, plans_file, reduced_file
from .control.stages import drive, fit_baselines, plan_motions, reduce_robot
from .control.task import motions_of
from .energies.catalogue import law_path
from .experiment.build import choose_device
from .experiment.checks import check_run
from .experiment.duration import announcement
from .experiment.evaluate import check_mesh, evaluate, time_models
from .experiment.experiment import LEARNED
from .experiment.files import (
    CONTROL,
    DATASET,
    DRIVEN,
    ERRORS,
    IDENTIFICATION,
    LAW_FILE,
    MESH_CHECK,
    METRICS,
    QUALITY,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    SCALED_DATASET,
    SHAPES,
    TIMES,
    TRUTH,
    fold_folder,
    reconstruction_file,
    training_file,
    weights_file,
)
from .experiment.identify import identify
from .experiment.identify_law import identify_law
from .experiment.laboratory import run_laboratory
from .experiment.learn import train
from .experiment.models import SIMFREE
from .experiment.parts import Fold, run_folds, workers_for
from .experiment.prediction_intervals import intervals_of_folds
from .experiment.reconstruct import ablation_stages, print_ablation, reconstruct
from .experiment.recordings.importing import import_recordings, import_scaled
from .experiment.report import collect_metrics, make_folds_report, make_report
from .experiment.shapes import try_shapes
from .experiment.simulate import simulate
from .experiment.trials import folds_of, scaled_trials_of, split_of, test_groups, trials_of
from .io.atomic import digest
from .io.errors import DataFileError
from .io.fan_out import ALONE, Workers
from .io.files import read_json, write_json
from .io.kernel_cache import start_quietly
from .io.progress import show
from .io.stages import Stage, StageContext, package_versions, resources_used, run_stages, unfinished
from .learning.metrics import summarise_folds
from .report.control_section import tracking_table
from .report.sections import shapes_table
from .report.verdict import results_table, verdict
from .settings.body import BodySettings
from .settings.control import ControlSettings, FigureSettings
from .settings.run import RunSettings
from .settings.stages import LEARNING, NETWORKS, LaboratoryStage, PlayedSettings, ReportStage, StageSettings
from .settings.trials import ReadingSettings, Split, Trial

log = logging.getLogger(__name__)

_SHORT = 60  # characters of advice beside which the path of the report is printed

Work = Callable[[StageContext], None]

_MOST_THREADS = 4  # that share the trials of a batch, as Python's part of a step runs in one at a time


def files_read(run: RunSettings, *bodies: BodySettings | None) -> dict[str, str]:
    """Returns the SHA-256 of the files of bodies and base motions, by path.

    Args:
        run: settings of the run.
        bodies: of the simulator and of the simulation that plays the real body; None is left out.

    Raises:
        DataFileError: a file cannot be read.
    """
    folder = Path((run.recorded.folder if run.recorded is not None else None) or ".").expanduser()
    moved = {motion.file for motion in run.motions().values() if motion.file is not None}
    motions = {name: _digest(folder / name, "the file of base_motion or obstacle_motion") for name in sorted(moved)}
    meshes = [mesh for body in bodies if body for mesh in (body.mesh, *(part.mesh for part in body.parts.values()))]
    paths = [getattr(mesh, "path", None) for mesh in meshes]
    return motions | {path: digest(path) for path in paths if path is not None}


def _digest(path: Path, key: str) -> str:
    try:
        return digest(str(path))
    except OSError as error:
        raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and {key}.") from error


def acquisition_stages(run: RunSettings) -> list[Stage]:
    """Returns the stages that write dataset.h5: simulation of the trials, or import of (simulated) recordings.

    Args:
        run: settings that `check_run` accepts.

    Raises:
        DataFileError: a recording cannot be read.
    """
    files, trials, data = files_read(run, run), trials_of(run), run.recorded
    if data is None:
        simulated = StageSettings.reading(run, "target", "data", files=files_read(run, run, run.target), trials=trials)
        return [Stage("simulate", simulate, (DATASET,), simulated)]
    stages, upstream = list[Stage](), tuple[str, ...]()
    learned = None if folds_of(run) is not None else split_of(run).train + split_of(run).validation
    own = {"data": ReadingSettings.of(data), "files": files, "trials": trials, "learned": learned}
    imported = StageSettings.reading(run, "payload_at", "simulation", "markers", **own)
    if run.is_laboratory:
        stages.append(_laboratory_stage("laboratory", run, trials))
        upstream = ("laboratory",)
    else:
        recordings = {
            str(trial.file): _digest(Path(str(trial.file)), f"data.trials.{trial.name}.file") for trial in trials
        }
        imported = imported.model_copy(update={"files": {**files, **recordings}})
    stages.append(Stage("import", import_recordings, (DATASET, QUALITY, REGISTRATION), imported, upstream))
    scaled = scaled_trials_of(run)
    if scaled:
        stages.append(_laboratory_stage("laboratory_scaled", run, scaled, "laboratory"))
        upstream, imported = ("import", "laboratory_scaled"), imported.model_copy(update={"trials": scaled})
        stages.append(Stage("import_scaled", import_scaled, (SCALED_DATASET,), imported, upstream))
    return stages


def _played(run: RunSettings) -> PlayedSettings:
    """Settings that the recordings of a simulated laboratory depend on, without the trials."""
    assert run.laboratory is not None
    return PlayedSettings.of(run, files=files_read(run, run.laboratory))


def _laboratory_stage(name: str, run: RunSettings, trials: Sequence[Trial], *upstream: str) -> Stage:
    work = partial(run_laboratory, workers=workers_of(run))
    scaled = any(trial.scale != 1.0 for trial in trials)
    outputs = (*(trial.recording for trial in trials), *(() if scaled else (TRUTH,)))
    return Stage(name, work, outputs, LaboratoryStage.of(_played(run), trials=trials, batch=run.batch), upstream)


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
    workers = workers_of(run) if workers is None else workers
    needs = () if run.identify is None else ("identify",)
    common = {"files": files_read(run, run), "shared": shared, "acquired": acquired, "split": split}
    stages: list[Stage] = []

    def of(*keys: str, **values: Any) -> StageSettings:
        return StageSettings.reading(run, *LEARNING, *keys, **common, **values)

    def add(name: str, work: Work, outputs: tuple[str, ...], settings: StageSettings, *upstream: str) -> None:
        stages.append(Stage(name, work, outputs, settings, (*needs, *upstream)))

    if run.identify is not None:
        before = of("identify", "seed").model_copy(update={"with_law": False})
        stages.append(Stage("identify", identify, (IDENTIFICATION,), before))
    if run.law is not None:
        given = {} if run.law.file is None else {run.law.file: digest(law_path(run.law.file))}
        of_law = of(*needs, "law", "name")
        of_law = of_law.model_copy(update={"files": of_law.files | given})
        add("identify_law", identify_law, (LAW_FILE,), of_law)
        needs = (*needs, "identify_law")
    if run.shapes:
        assert run.data.steps is not None
        others = of("target", "shapes", steps=run.data.steps)
        bodies = [own for shape in run.shapes.values() for own in (shape, shape.target_body)]
        others = others.model_copy(update={"files": {**others.files, **files_read(run, *bodies)}})
        add("shapes", try_shapes, (SHAPES,), others)
    # For the published comparison, where all vertices are observed, test trials are reconstructed, too.
    compared = split.test if run.markers is None and run.law is None else ()
    reconstructed = split.train + split.validation + compared
    learned = []
    for model in [model for model in run.models if model in LEARNED and model != SIMFREE]:
        first, second = f"reconstruct_{model}", f"train_{model}"
        forces = of("reconstruction", model=model, reconstructed=reconstructed)
        add(first, partial(reconstruct, workers=workers), (reconstruction_file(model),), forces)
        trained = of(*NETWORKS, model=model, training=run.training(model))
        add(second, train, (weights_file(model), training_file(model)), trained, first)
        learned.append(stages[-1].name)
    trained = of(*NETWORKS, model=SIMFREE, training=run.training(SIMFREE))
    if run.markers is None and run.target is not None:
        # With observed states, a network that replaces the simulator does not depend on it.
        without = {"simulation": run.target.material, "identified": None, "with_law": False}
        trained = trained.model_copy(update=without)
    outputs = (weights_file(SIMFREE), training_file(SIMFREE))
    add("train_simfree", train, outputs, trained, *(() if run.markers is None else ("reconstruct_resphys",)))
    learned.append("train_simfree")
    groups = test_groups(run, split)
    calibration = (split.validation or split.train) if run.markers is not None and folds_of(run) is None else ()
    keys = (*NETWORKS, "published", "correct_uncorrected", "horizons")
    evaluated = of(*keys, groups=groups, calibration=calibration)
    add("evaluate", partial(evaluate, workers=workers), (ROLLOUTS, ERRORS), evaluated, *learned, "reconstruct_resphys")
    targets = () if run.target is None else ("target",)
    if run.timing:
        add("time", time_models, (TIMES,), of(*NETWORKS, *targets, groups=groups), *learned)
    same = run.is_laboratory and run.laboratory and (run.laboratory.mesh, run.laboratory.parts) == (run.mesh, run.parts)
    if run.mesh_check is not None and not same:
        add("mesh_check", check_mesh, (MESH_CHECK,), of(*NETWORKS, "mesh_check", groups={"1": groups["1"]}))
    if run.control is not None:
        stages += control_stages(run, run.control, of, workers)
    last = tuple(stage.name for stage in stages if stage.name in ("shapes", "evaluate", "time", "mesh_check", "drive"))
    shown = ReportStage(config=run, acquired=acquired)
    stages.append(Stage("report", make_report, (REPORT,), shown, last))
    return stages


def control_stages(
    run: RunSettings, control: ControlSettings, of: Callable[..., StageSettings], workers: Workers
) -> list[Stage]:
    """Returns the stages of control: plans on the models, and with a simulated laboratory, driven motions.

    Args:
        run: settings that `check_run` accepts.
        control: its group ``control``.
        of: makes the settings of a stage of the split.
        workers: of the driven motions.
    """
    stages, last = list[Stage](), control.models[-1]
    figures = FigureSettings.of(control)
    for model in reversed(control.models):  # The last model must reach the paths, so it is checked first.
        first = f"reduce_{model}"
        reduced = of("seed", model=model, reduction=control.reduction)
        stages.append(Stage(first, reduce_robot, (reduced_file(model),), reduced, ("evaluate",)))
        tables = [plan_table(model, motion) for motion in motions_of(control)]
        planned = of(model=model, figures=figures, plan=control.plan, must_reach=model == last)
        stages.append(Stage(f"plan_{model}", plan_motions, (plans_file(model), *tables), planned, (first,)))
    if run.laboratory is None:
        return stages
    played, needs = _played(run), tuple(stage.name for stage in stages)
    settings = of(model=last, figures=figures, feedback=control.feedback, played=played)
    stages.append(Stage("baselines", fit_baselines, (BASELINES,), settings, ("evaluate",)))
    driven = of("control", played=played)
    work = partial(drive, workers=workers)
    stages.append(Stage("drive", work, (DRIVEN, CONTROL), driven, (*needs, "baselines")))
    return stages


def prepare(run: RunSettings) -> None:
    """Checks a run, and configures Warp and torch for it.

    Raises:
        InputError: values that do not match the mesh or the trials.
    """
    start_quietly()
    os.environ.setdefault("WARP_RESPHYS_THREADS", str(min(torch.get_num_threads(), _MOST_THREADS)))
    if run.device == "cpu" or not torch.cuda.is_available():
        torch.set_num_threads(1)  # The networks are too small for several threads (linalg/threads.py).
    if run.pictures is None:
        check_run(run)
    else:
        from .experiment.pictures.stages import check_pictures

        check_pictures(run)


def acquire(run: RunSettings, folder: Path, wait: bool = False) -> tuple[list[Stage], str]:
    """Runs the stages that write dataset.h5; returns them, and the fingerprint of the last."""
    stages = acquisition_stages(run)
    if unfinished(stages, folder):  # Torch's first optimiser imports it for a second, in which kernels are compiled.
        Thread(target=import_module, args=("torch._dynamo",)).start()
    run_stages(stages, folder, wait)
    (written,) = (stage.name for stage in stages if DATASET in stage.outputs)
    return stages, str(read_json(folder / "stages" / f"{written}.json")["fingerprint"])


def run_experiment(run: RunSettings, folder: Path) -> None:
    """Runs the stages that have changed, writes metrics.json to the run folder and prints the errors.

    Raises:
        InputError: an invalid setting.
    """
    prepare(run)
    if run.pictures is not None:
        from .experiment.pictures.stages import picture_stages, print_pictures

        run_stages(picture_stages(run, files_read(run, run)), folder)
        print_pictures(run, folder)
        return
    if run.ablation is not None:
        run_stages(ablation_stages(run, files_read(run, run, run.target)), folder)
        print_ablation(run, folder)
        return
    first, acquired = acquire(run, folder)
    folds = folds_of(run)
    if folds is None:
        stages = learning_stages(run, split_of(run), ".", acquired)
        _announce(run, stages, folder, workers_of(run))
        run_stages(stages, folder)
        metrics = collect_metrics(folder, run, [stage.name for stage in (*first, *stages)])
    else:
        metrics = _run_folds(run, folder, folds, first, acquired)
    write_json(folder / METRICS, metrics)
    if folds is not None:
        errors = {trial: fold["errors_mm"] for trial, fold in metrics["folds"].items()}
        reported = ReportStage(config=run, folds=errors)
        run_stages([*first, Stage("report", make_folds_report, (REPORT,), reported, (first[-1].name,))], folder)
    _print(metrics, folder, run)


def _announce(run: RunSettings, stages: Sequence[Stage], folder: Path, workers: Workers, times: float = 1.0) -> None:
    """Logs how long the unfinished stages of a split take, unless that is short; see `announcement`."""
    left = unfinished(stages, folder)
    try:
        sentence = announcement(left, folder, run.budget == "quick", workers, times)
    except Exception as error:  # An estimate never ends a run.
        log.debug("no estimate: %s", error)
        return
    if sentence:
        log.info("%s", sentence)


def _run_folds(
    run: RunSettings, folder: Path, splits: Mapping[str, Split], first: Sequence[Stage], acquired: str
) -> dict[str, Any]:
    """Runs a cross-validation, each fold in its own folder; returns the content of metrics.json."""
    folds = {
        name: Fold(name, folder / fold_folder(name), partial(learning_stages, run, split, "..", acquired))
        for name, split in splits.items()
    }
    left = [fold for fold in folds.values() if unfinished(fold.stages(ALONE), fold.folder)]
    if left:
        times = len(left) / workers_of(run).at_most(len(left)).count
        _announce(run, left[0].stages(ALONE), left[0].folder, ALONE, times)
    run_folds(folds, workers_of(run))
    metrics = {}
    for name, fold in folds.items():
        metrics[name] = collect_metrics(fold.folder, run, [stage.name for stage in fold.stages(ALONE)])
        write_json(fold.folder / METRICS, metrics[name])
    return {
        "errors_mm": summarise_folds(_of_all([of_fold["errors_mm"] for of_fold in metrics.values()])),
        "folds": metrics,
        **intervals_of_folds(folder / DATASET, {name: fold.folder for name, fold in folds.items()}),
        **resources_used(folder, [stage.name for stage in first]),
        "versions": package_versions(),
        "device": str(choose_device(run.device)),
    }


def _of_all(folds: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Errors of the models that all folds have: a law is used in some folds alone."""
    shared = [model for model in folds[0] if all(model in fold for fold in folds)]
    return [{model: fold[model] for model in shared} for fold in folds]


def _print(metrics: Mapping[str, Any], folder: Path, run: RunSettings) -> None:
    """Prints what the report begins with: the mean errors, the verdict and the advice."""
    tracking, shapes = metrics.get("control", {}).get("tracking"), metrics.get("shapes")
    tables = [results_table(metrics, run)]
    tables += [tracking_table(tracking)] if tracking else []
    tables += [shapes_table(shapes)] if shapes else []
    said, *advice = (*verdict(metrics, run), "")
    last = [" ".join(filter(None, advice)), f"Report: {folder / REPORT}"]
    lines = ["  ".join(filter(None, last))] if len(last[0]) < _SHORT else last
    show(*tables, *filter(None, (said, *lines)))
