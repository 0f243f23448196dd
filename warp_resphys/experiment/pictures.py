"""Identification of a material from pictures of bodies at rest: stages and results.

The material is identified from the poses of training, with the camera. Every pose is then predicted by three models:
the identified simulator, the uncorrected one, and the undeformed body. In each, what belongs to a pose alone (the
values with ``per: trial``) is fitted to that pose, as nothing else tells where it stands.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from ..energies.law_files import LAW_FORMAT, unit_of
from ..io.errors import InputError
from ..io.files import atomic_hdf5, create, read_json, write_json
from ..io.progress import Progress
from ..io.stages import Stage, StageContext, package_versions, resources_used
from ..learning.bounds import Bounds
from ..learning.identification import ParameterSearch
from ..learning.parameters import configured_parameters, own_name, split_name
from ..pictures.camera import CORRECTIONS, PlacedCamera
from ..pictures.misfit import PictureMisfit, values_of
from ..pictures.seen import CLAMP_SHIFT, CLAMP_TURN, SeenPose, Shape
from ..report.page import number_text
from ..report.pictures_page import PictureResult, picture_verdict, write_pictures_report
from ..settings.pictures import PictureData
from ..settings.run import RunSettings
from ..settings.stages import IdentifyPicturesStage, PictureStage, ReportStage
from .build import simulation_device
from .files import COMPARE, IDENTIFICATION, LAW_FILE, METRICS, REPORT
from .identify import Checkpoint, bounds_of
from .picture_laboratory import play_camera
from .seen_poses import PICTURES, SCENE, SeenPoses, import_pictures, picture_files, read_lens

log = logging.getLogger(__name__)

DIFFERENCES: Final = "pictures.json"
OUTLINES: Final = "outlines.h5"
MODELS: Final = ("undeformed", "simulation", "sysid")

Values = dict[str, float]


def picture_stages(run: RunSettings, files: Mapping[str, str]) -> list[Stage]:
    """Returns the stages.

    Args:
        run: settings with ``data.kind: pictures``.
        files: see `SimulationStage`.

    Raises:
        DataFileError: a file is missing.
    """
    data = run.pictures
    assert data is not None
    stages, upstream = list[Stage](), tuple[str, ...]()
    common = {"files": {**files, **picture_files(data)}, "data": data}
    settings = PictureStage.of(run, **common)
    if data.folder is None:
        written = tuple(f"recordings/{pose.folder}/{SCENE}" for pose in data.poses.values())
        stages, upstream = [Stage("laboratory", play_camera, written, settings)], ("laboratory",)
    stages.append(Stage("import", import_pictures, (PICTURES,), settings, upstream))
    identified = IdentifyPicturesStage.of(run, **common)
    laws = dict.fromkeys(law_file(data.poses[name].material or "") for name in data.train)
    stages.append(Stage("identify", identify_pictures, (IDENTIFICATION, *laws), identified, ("import",)))
    stages.append(Stage(COMPARE, compare_pictures, (DIFFERENCES, OUTLINES), identified, ("identify",)))
    shown = ReportStage(config=run)
    stages.append(Stage("report", report_pictures, (REPORT,), shown, (COMPARE,)))
    return stages


def law_file(material: str) -> str:
    """Returns the file of a material's law, for ``law=FILE`` of other experiments."""
    return f"law_{material}.json" if material else LAW_FILE


def check_pictures(run: RunSettings) -> None:
    """Checks the settings of a run with pictures before its first stage.

    Raises:
        DataFileError: a file is missing or damaged.
        InputError: values that do not fit.
    """
    data, wanted = run.pictures, run.identify
    assert data is not None
    assert wanted is not None
    read_lens(data)
    if not wanted.parameters:
        raise InputError("identify.parameters is empty: give a range for at least one parameter.")
    for name, limits in wanted.parameters.items():
        if limits.per == "session":
            raise InputError(f"identify.parameters.{name}.per is session: pictures have all, material and trial.")


class _Plan:
    """Bounds and first guesses of the parameters of a run.

    Args:
        settings: of the stage.
        poses: their readers.
    """

    def __init__(self, settings: IdentifyPicturesStage, poses: SeenPoses) -> None:
        self.settings, self.data, self.poses = settings, settings.data, poses

    def bounds(self, poses: Sequence[SeenPose], per: Sequence[str] = ("all", "material", "trial")) -> dict[str, Bounds]:
        """Ranges of the parameters that act on some poses, and that all, a material's or one of them share."""
        result = {}
        for name, limits in self.settings.identify.parameters.items():
            owners = {"all": [""], "material": [pose.material for pose in poses], "trial": [p.name for p in poses]}
            for owner in dict.fromkeys(owners[limits.per]) if limits.per in per else ():
                mine = [pose for pose in poses if owner in ("", pose.material, pose.name)]
                if any(self._matters(name, pose) for pose in mine):
                    result[own_name(name, owner) if owner else name] = bounds_of(limits)
        return result

    @staticmethod
    def _matters(name: str, pose: SeenPose) -> bool:
        return name in CORRECTIONS if not pose.deforms else name in pose.parameter_names

    def guess(self, names: Sequence[str], poses: Sequence[SeenPose]) -> Values:
        """First guesses: as given, the mean of the prior, or as configured."""
        wanted, result = self.settings.identify, Values()
        neutral = dict(zip(CORRECTIONS, PlacedCamera.corrections({}).tolist(), strict=True))
        for name in names:
            parameter, owner = split_name(name)
            pose = next(pose for pose in poses if owner in ("", pose.material, pose.name))
            prior = wanted.parameters[parameter].prior
            if parameter in wanted.first_guess:
                value = wanted.first_guess[parameter]
            elif parameter == CLAMP_TURN:
                value = math.radians(self.data.poses[pose.name].clamp_turn)
            elif prior is not None:
                value = prior.mean
            elif parameter in neutral or parameter == CLAMP_SHIFT:
                value = neutral.get(parameter, 0.0)
            else:
                value = configured_parameters(pose.simulator, [parameter])[parameter]
            result[name] = value
        return result

    def given(self, pose: SeenPose) -> Values:
        """Values that act on a pose without being identified: the turn of its second clamp."""
        turn = self.data.poses[pose.name].clamp_turn
        return {CLAMP_TURN: math.radians(turn)} if turn and len(pose.clamps) > 1 else {}

    def seen_from(
        self, name: str, known: Values | None = None, deforms: bool = True, near: Shape | None = None
    ) -> SeenPose:
        """A pose; before a standing camera, with the given place of the camera from which it is seen best at first.

        Args:
            name: of the pose.
            known: values of parameters; first guesses of the others.
            deforms: whether the body is simulated.
            near: its shape with similar values.
        """
        first = self.poses.pose(name, 0 if self.data.stands else None, deforms)
        candidates = self.poses.cameras_of(name)
        if not self.data.stands or len(candidates) == 1:
            return first
        values = values_of(
            first, {**self.guess([*self.bounds([first])], [first]), **self.given(first), **(known or {})}
        )
        q, losses = first.shape(values, near), list[float]()
        for camera in candidates:
            pose = self.poses.pose(name, camera, deforms)
            losses.append(sum(pose.difference(photo, q, values).distance for photo in pose.photos))
        return self.poses.pose(name, candidates[int(np.argmin(losses))], deforms)


def identify_pictures(context: StageContext) -> None:
    """Writes identification.json: the parameters, their uncertainty, and the camera of each pose.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """
    settings: IdentifyPicturesStage = context.settings
    wanted, kept = settings.identify, Checkpoint(context, "sysid")
    plan = _Plan(settings, SeenPoses(settings, context.run_dir))
    poses = [plan.seen_from(name) for name in settings.data.train]
    bounds = plan.bounds(poses)
    given = {own_name(key, pose.name): value for pose in poses for key, value in plan.given(pose).items()}
    misfit = PictureMisfit(poses, bounds, given)
    search, guess = ParameterSearch(misfit), plan.guess([*bounds], poses)
    if "starts" not in kept.content:
        kept.keep(starts=search.starts(guess, wanted.starts, wanted.candidates, settings.seed), attempts=[])
    starts, attempts = kept.content["starts"], kept.content["attempts"]
    total = wanted.starts * wanted.max_evaluations
    with Progress(context.name, total, "evaluations at most", sum(len(a["history"]) for a in attempts)) as progress:

        def report(start: int, loss: float, values: Mapping[str, float]) -> None:
            name, value = next(iter(values.items()))
            progress.advance(1, start=start, loss=f"{loss:.3g}", **{name: f"{value:.4g}"})

        def keep(done: list[Any]) -> None:
            kept.keep(attempts=done)

        found = search.run(starts, wanted.max_evaluations, report, attempts, keep, wanted.tolerance)
    result = {**asdict(found), "first_guess": guess}
    cameras = {pose.name: pose.photos[0].camera.pose.tolist() for pose in poses}
    write_json(context.run_dir / IDENTIFICATION, {"sysid": result, "cameras": cameras})
    for material in dict.fromkeys(pose.material for pose in poses):
        pose = next(pose for pose in poses if pose.material == material)
        fitted = values_of(pose, found.parameters)
        constants = {key: fitted.get(key, value) for key, value in plan.poses.material(pose.name).constants.items()}
        law = {
            "format": LAW_FORMAT,
            "model": settings.simulation.model,
            "constants": constants,
            "units": {key: unit_of(key) for key in constants},
        }
        write_json(context.run_dir / law_file(material), law)
    kept.path.unlink(missing_ok=True)


def compare_pictures(context: StageContext) -> None:
    """Writes pictures.json, how far the pictures of every pose are from those of each model, and outlines.h5.

    Raises:
        ConvergenceError: a pose has no equilibrium.
    """
    settings: IdentifyPicturesStage = context.settings
    plan = _Plan(settings, SeenPoses(settings, context.run_dir))
    shared = read_json(context.run_dir / IDENTIFICATION)["sysid"]["parameters"]
    names = [*settings.data.train, *settings.data.test]
    rows = list[dict[str, Any]]()
    with (
        atomic_hdf5(context.run_dir / OUTLINES, "outlines", {"fingerprint": context.fingerprint}) as file,
        Progress(context.name, len(names) * len(MODELS), "fits") as progress,
    ):
        for name in names:
            near: Shape | None = None
            for model in reversed(MODELS):
                pose, values, near = _fitted(plan, name, model, shared, near)
                for number, photo in enumerate(pose.photos):
                    row = {"pose": name, "picture": number, "model": model, "tested": name in settings.data.test}
                    rows.append({**row, **asdict(pose.difference(photo, near[1], values)), "values": values})
                    if photo.outline is not None:
                        seen = pose.outlines(photo, near[1], PlacedCamera.corrections(values))
                        create(file, f"{name}/{number}/{model}", seen.silhouette.pixels, "px")
                        create(file, f"{name}/{number}/{model}_weight", seen.of_simulated, "px")
                        if model == MODELS[0]:
                            create(file, f"{name}/{number}/measured", photo.outline.points, "px")
                progress.advance(1, pose=name)
    write_json(context.run_dir / DIFFERENCES, {"rows": rows})


def _fitted(
    plan: _Plan, name: str, model: str, identified: Values, near: Shape | None
) -> tuple[SeenPose, Values, Shape]:
    """A pose with a model, the values of its parameters, and its shape; what belongs to it alone is fitted to it.

    The lens is shared with the identification; the other models have none, and fit it as well.
    """
    known = dict(identified) if model == "sysid" else {}
    pose = plan.seen_from(name, known, model != MODELS[0], near)
    bounds = plan.bounds([pose], ("trial",) if model == "sysid" else ("trial", "all"))
    if model != "sysid":
        bounds = {key: own for key, own in bounds.items() if split_name(key)[1] or key in CORRECTIONS}
    given = {**plan.given(pose), **known}
    fitted = {key: known[key] for key in bounds if key in known}
    if bounds and not fitted:
        wanted = plan.settings.identify
        search = ParameterSearch(PictureMisfit([pose], bounds, given, [near]))
        fitted = search.run(
            [plan.guess([*bounds], [pose])], wanted.max_evaluations, tolerance=wanted.tolerance
        ).parameters
    own = values_of(pose, {**given, **fitted})
    return pose, own, (own, pose.shape(own, near))


def summary_of(rows: Sequence[Mapping[str, Any]], data: PictureData) -> list[PictureResult]:
    """Returns the results of each pose: means over its pictures, by model."""
    return [
        PictureResult(
            pose=name,
            material=data.poses[name].material or "",
            tested=name in data.test,
            pictures=len({row["picture"] for row in rows if row["pose"] == name}),
            **{
                key: {
                    model: _mean(row[key] for row in rows if (row["pose"], row["model"]) == (name, model))
                    for model in MODELS
                }
                for key in ("outline_mm", "outline_px", "overlap", "points_mm")
            },
        )
        for name in (*data.train, *data.test)
    ]


def _mean(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def report_pictures(context: StageContext) -> None:
    """Writes report.html and its figures."""
    run: RunSettings = context.settings.config
    data = run.pictures
    assert data is not None
    settings = PictureStage.of(run, files={}, data=data)
    poses = SeenPoses(settings, context.run_dir)
    start = {name: value for name, value in run.simulation.constants.items()}
    write_pictures_report(
        context.run_dir / REPORT,
        picture_metrics(context.run_dir, run),
        run,
        read_json(context.run_dir / IDENTIFICATION)["sysid"],
        start,
        context.run_dir / OUTLINES,
        poses.picture,
    )


def picture_metrics(folder: Path, run: RunSettings) -> dict[str, Any]:
    """Returns the content of metrics.json."""
    data = run.pictures
    assert data is not None
    stages = [
        stage for stage in ("laboratory", "import", "identify", COMPARE) if stage != "laboratory" or data.folder is None
    ]
    rows = read_json(folder / DIFFERENCES)["rows"]
    return {
        "poses": [asdict(result) for result in summary_of(rows, data)],
        "parameters": read_json(folder / IDENTIFICATION)["sysid"]["parameters"],
        **resources_used(folder, stages),
        "versions": package_versions(),
        "device": str(simulation_device(run.device)),
    }


def print_pictures(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json, and prints the distances of the outlines, the parameters and the verdict."""
    metrics = picture_metrics(folder, run)
    write_json(folder / METRICS, metrics)
    results = [PictureResult(**row) for row in metrics["poses"]]
    table = Table(
        "pose", "undeformed [mm]", "uncorrected [mm]", "identified [mm]", "overlap", title="Distance of outlines"
    )
    for result in results:
        cells = [number_text(result.outline_mm[model]) for model in MODELS]
        head = f"{result.pose} (test)" if result.tested else result.pose
        table.add_row(head, *cells, number_text(result.overlap["sysid"]))
    console = Console()
    console.print(table)
    console.print(picture_verdict(results), soft_wrap=True)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)
