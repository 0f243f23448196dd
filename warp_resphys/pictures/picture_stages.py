"""Identification of a material from pictures of bodies at rest or released: stages and results.

The material is identified from the poses of training, with the camera. Every pose is then predicted
by three models: the identified simulator, the uncorrected one, and the undeformed body. In each,
the place before the camera, the tilt of gravity, the clamps and the release are fitted to the pose,
as nothing else shows them.
"""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ..core.energies.catalogue import law_content
from ..data.camera import CORRECTIONS, PlacedCamera
from ..experiment.build import build_mesh, simulation_device
from ..experiment.digests import files_read
from ..experiment.files import COMPARE, IDENTIFICATION, LAW_FILE, METRICS, REPORT
from ..io.errors import InputError
from ..io.parts import Checkpoint
from ..io.progress import Progress, show
from ..io.resuming import Stage, StageContext, package_versions, resources_used, run_stages
from ..io.safe_files import atomic_hdf5, create, read_json, write_json
from ..learning.identification.search import (
    Identification,
    Searches,
    first_points,
    refined_searches,
    search_parameters,
)
from ..learning.parameters import TILTS, configured_parameters, split_name, value_name
from ..report.identification_section import parameter_rows
from ..settings.learning import Bounds
from ..settings.pictures import PictureData
from ..settings.run import RunSettings
from ..settings.stage_keys import SIMULATOR, StageSettings
from .camera_laboratory import frame_files, play_camera
from .picture_misfit import PictureMisfit, values_of
from .pictures_page import (
    PictureMetrics,
    PictureResult,
    distance_table,
    picture_verdict,
    write_pictures_report,
)
from .released_force import OF_RELEASE
from .seen import CLAMP_SHIFT, CLAMP_TURN, NEUTRAL, SeenPose, Shape, distance_of
from .seen_poses import (
    PICTURES,
    SCENE,
    SeenPoses,
    import_pictures,
    picture_files,
    read_lenses,
    released_force,
    scene_of,
)

log = logging.getLogger(__name__)

DIFFERENCES: Final = "pictures.json"
OUTLINES: Final = "outlines.h5"
MODELS: Final = ("undeformed", "simulation", "sysid")

# What is of a picture, not of a material.
_PLACED: Final = (*CORRECTIONS, CLAMP_TURN, CLAMP_SHIFT, *TILTS, *OF_RELEASE)
_TRIED: Final = 10  # pictures, evenly chosen, by which a standing camera is chosen

Values = dict[str, float]


def picture_stages(run: RunSettings, files: Mapping[str, str]) -> list[Stage]:
    """Returns the stages.

    Args:
        run: settings with ``data.kind: pictures``.
        files: see `StageSettings`.

    Raises:
        DataFileError: a file is missing.
    """
    data = run.pictures
    assert data is not None
    stages, upstream = list[Stage](), tuple[str, ...]()
    run, files = run.model_copy(update={"data": data}), {**files, **picture_files(data)}
    keys = (*SIMULATOR, "simulation", "seed", "data")
    settings = StageSettings.reading(run, *keys, files=files)
    if data.folder is None:
        of_poses = {pose.folder: [SCENE, pose.points] for pose in data.poses.values()}
        for pose in data.poses.values():
            for files_of_frame in frame_files(data, pose):
                of_poses[pose.folder] += files_of_frame.values()
        written = tuple(
            f"recordings/{folder}/{file}"
            for folder, files in of_poses.items()
            for file in files
            if file
        )
        stages, upstream = [Stage("laboratory", play_camera, written, settings)], ("laboratory",)
    stages.append(Stage("import", import_pictures, (PICTURES,), settings, upstream))
    identified = StageSettings.reading(run, *keys, "identify", files=files)
    laws = dict.fromkeys(law_file(data.poses[name].material or "") for name in data.train)
    stages.append(
        Stage("identify", identify_pictures, (IDENTIFICATION, *laws), identified, ("import",))
    )
    stages.append(
        Stage(COMPARE, compare_pictures, (DIFFERENCES, OUTLINES), identified, ("identify",))
    )
    stages.append(Stage("report", report_pictures, (REPORT,), run, (COMPARE,)))
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
    read_lenses(data)
    for name, pose in data.poses.items():
        if data.folder is None:
            deep = data.simulated is not None and data.simulated.depth is not None
        else:
            deep = any(frame.depth is not None for frame in scene_of(data, pose, Path()).frames)
        if not (pose.outline or pose.points or pose.cloud or (pose.depth and deep)):
            raise InputError(
                f"data.poses.{name} has no outline, no points, "
                "no scan and no depth image: give one."
            )
        if pose.release is not None and pose.mesh is None:
            released_force(name, pose, build_mesh(run.mesh))
    if not wanted.parameters:
        raise InputError("identify.parameters is empty: give a range for at least one parameter.")
    known = [*run.simulation.values, *_PLACED]
    for name, limits in wanted.parameters.items():
        if name not in known:
            raise InputError(f"identify.parameters names '{name}': choose from {', '.join(known)}.")
        if limits.by_part or limits.owner == "session":
            raise InputError(
                f"identify.parameters.{name}.per is {limits.per}: "
                "choose all, material, lens or trial."
            )
        if limits.per == "lens" and name not in CORRECTIONS:
            raise InputError(
                f"identify.parameters.{name}.per is lens, "
                "and is not of a camera: take all or material."
            )
        if limits.per == "trial" and name not in _PLACED:
            raise InputError(
                f"identify.parameters.{name}.per is trial, "
                "which says nothing of others: take material."
            )


class _Plan:
    """Poses of a run, and bounds and first guesses of their parameters.

    Args:
        settings: of the stage.
        run_dir: the run folder.
        cameras: (4, 4) of poses whose standing cameras were chosen in the identification, by name
            and lens.
    """

    def __init__(
        self,
        settings: StageSettings,
        run_dir: Path,
        cameras: Mapping[str, Mapping[str, list[list[float]]]] | None = None,
    ) -> None:
        self.settings = settings
        self.data = settings.data
        self.poses = SeenPoses(settings, run_dir)
        self._cameras = {
            name: {
                lens: torch.tensor(camera, dtype=torch.float64) for lens, camera in by_lens.items()
            }
            for name, by_lens in (cameras or {}).items()
        }

    def bounds(
        self, poses: Sequence[SeenPose], chosen: Callable[[str, str], bool]
    ) -> dict[str, Bounds]:
        """Ranges of parameters that act on some poses, with a name for each owner.

        Args:
            poses: some poses.
            chosen: whether a parameter of this name and ``per`` is wanted.
        """
        result = {}
        for name, limits in self.settings.identify.parameters.items():
            owners = {
                "all": [""],
                "material": [pose.material for pose in poses],
                "trial": [pose.name for pose in poses],
                "lens": [*chain.from_iterable(pose.lenses for pose in poses)],
            }
            shared = limits.owner or "all"
            for owner in dict.fromkeys(owners[shared]) if chosen(name, shared) else ():
                mine = [pose for pose in poses if owner in (*pose.owners, *pose.lenses)]
                if any(
                    name in pose.parameter_names and (pose.deforms or name in CORRECTIONS)
                    for pose in mine
                ):
                    result[value_name(name, owner) if owner else name] = limits
        return result

    def guess(self, names: Iterable[str], poses: Sequence[SeenPose]) -> Values:
        """First guesses: as given, the configured turn of a clamp,
        the mean of the prior, or as configured.
        """
        wanted, result = self.settings.identify, Values()
        for name in names:
            parameter, owner = split_name(name)
            pose = next(pose for pose in poses if owner in (*pose.owners, *pose.lenses))
            prior = wanted.parameters[parameter].prior
            if parameter in wanted.first_guess:
                result[name] = wanted.first_guess[parameter]
            elif parameter == CLAMP_TURN:
                result[name] = math.radians(self.data.poses[pose.name].clamp_turn)
            elif prior is not None:
                result[name] = prior.mean
            elif parameter in NEUTRAL:
                result[name] = NEUTRAL[parameter]
            else:
                result[name] = configured_parameters(pose.simulator, [parameter])[parameter]
        return result

    def clamp_turns(self, poses: Sequence[SeenPose]) -> Values:
        """The turns of second clamps, where they are not identified."""
        turns = {pose.name: math.radians(self.data.poses[pose.name].clamp_turn) for pose in poses}
        if CLAMP_TURN in self.settings.identify.parameters:
            return {}
        return {value_name(CLAMP_TURN, name): turn for name, turn in turns.items() if turn}

    def pose(
        self, name: str, known: Values, deforms: bool = True, near: Shape | None = None
    ) -> SeenPose:
        """A pose.

        A standing camera is the one of its frames' from which the body is seen best at first.

        Args:
            name: of the pose.
            known: identified values of parameters; first guesses of the others.
            deforms: whether the body is simulated.
            near: its shape with similar values.

        Raises:
            InputError: none of the cameras sees the body.
        """
        pose = replace(self.poses.pose(name), deforms=deforms)
        if not self.data.stands:
            return pose
        if known and name in self._cameras:
            return pose.before(self._cameras[name])
        guess = {
            **self.guess(self.bounds([pose], lambda name, per: True), [pose]),
            **self.clamp_turns([pose]),
            **known,
        }
        shape = pose.shape(values_of(pose, guess), near)
        return pose.before(
            {lens: self._best_camera(pose, lens, shape, guess) for lens in pose.lenses}
        )

    def _best_camera(
        self, pose: SeenPose, lens: str, shape: torch.Tensor, values: Values
    ) -> torch.Tensor:
        """The camera (4, 4) of the frames by a lens from which a shape is seen best."""
        seen = list[tuple[float, torch.Tensor]]()
        failure = None
        known = values_of(pose, values, lens)
        for camera in self.poses.cameras_of(pose.name, lens):
            tried = pose.before({lens: camera})
            try:
                photos = [
                    photo
                    for photo in tried.photos
                    if photo.camera.lens is not None and photo.lens == lens
                ]
                photos = photos[:: math.ceil(len(photos) / _TRIED)]
                bodies = [tried.vertices(photo, shape, known) for photo in photos]
                distances = (
                    distance_of(tried.difference(*pair, known))
                    for pair in zip(photos, bodies, strict=True)
                )
                seen.append((sum(distances), camera))
            except InputError as error:
                failure = error
        if failure is not None and not seen:
            raise failure
        return min(seen, key=lambda pair: pair[0])[1]

    def fitted(
        self, name: str, model: str, identified: Values, near: Shape | None
    ) -> tuple[SeenPose, Values, Shape]:
        """A pose with a model, the values of parameters, and its shape.

        Place before the camera, tilt of gravity and clamps are fitted to it, unless they were
        identified with it. The identified model has the identified lens; the others, which have
        none, fit it as well, and choose among the cameras of the frames anew.
        """
        known = dict(identified) if model == "sysid" else {}
        pose = self.pose(name, known, model != MODELS[0], near)
        bounds = self.bounds(
            [pose], lambda name, per: name in _PLACED and (model != "sysid" or per == "trial")
        )
        fixed = {**self.clamp_turns([pose]), **known}
        fitted = {key: known[key] for key in bounds if key in known}
        if bounds and not fitted:
            wanted, guess = self.settings.identify, self.guess(bounds, [pose])
            misfit = PictureMisfit([pose], bounds, fixed, [near])
            fitted = dict(
                search_parameters(
                    misfit, [guess], wanted.max_evaluations, wanted.tolerance
                ).parameters
            )
        values = {**fixed, **fitted}
        shared = values_of(pose, values)
        return pose, values, (shared, pose.shape(shared, near))


def identify_pictures(context: StageContext) -> None:
    """Writes identification.json: parameters, uncertainty and cameras.

    An interrupted run keeps its finished search.

    Raises:
        ConvergenceError: the simulation fails at every start.
    """
    settings: StageSettings = context.settings
    wanted = settings.identify
    plan = _Plan(settings, context.run_dir)
    poses = [plan.pose(name, {}) for name in settings.data.train]
    bounds = plan.bounds(poses, lambda name, per: True)
    misfit = PictureMisfit(poses, bounds, plan.clamp_turns(poses))
    guess, kept = plan.guess(bounds, poses), context.run_dir / f"{context.name}_parts.safetensors"
    first = (guess, wanted.starts, wanted.candidates, settings.seed)
    searches = Searches(
        wanted.max_evaluations,
        wanted.tolerance,
        Checkpoint(kept, context.fingerprint),
        context.name,
        starts=wanted.starts,
    )
    (found,) = refined_searches(lambda before: (misfit, first_points(misfit, *first)), searches)
    result = replace(found, first_guess=guess).plain()
    cameras = {}
    for pose in poses if settings.data.stands else ():
        cameras[pose.name] = {
            photo.lens: photo.camera.pose.tolist()
            for photo in pose.photos
            if photo.camera.lens is not None
        }
    write_json(context.run_dir / IDENTIFICATION, {"sysid": result, "cameras": cameras})
    for material in dict.fromkeys(pose.material for pose in poses):
        pose = next(pose for pose in poses if pose.material == material)
        fitted = values_of(pose, found.parameters)
        parameters = {
            key: fitted.get(key, value)
            for key, value in plan.poses.material(pose.name).values.items()
        }
        write_json(
            context.run_dir / law_file(material), law_content(settings.simulation.model, parameters)
        )
    kept.unlink(missing_ok=True)


def compare_pictures(context: StageContext) -> None:
    """Writes pictures.json, how far the pictures of every pose are
    from those of each model, and outlines.h5.

    Raises:
        ConvergenceError: a pose has no equilibrium.
    """
    settings: StageSettings = context.settings
    identified = read_json(context.run_dir / IDENTIFICATION)
    plan = _Plan(settings, context.run_dir, identified["cameras"])
    shared = identified["sysid"]["parameters"]
    names = [*settings.data.train, *settings.data.test]
    rows = list[dict[str, Any]]()
    with (
        atomic_hdf5(
            context.run_dir / OUTLINES, "outlines", {"fingerprint": context.fingerprint}
        ) as file,
        Progress(context.name, len(names) * len(MODELS), "fits") as progress,
    ):
        for name in names:
            near: Shape | None = None
            for model in reversed(MODELS):
                pose, values, near = plan.fitted(name, model, shared, near)
                for number, photo in enumerate(pose.photos):
                    seen_by = values_of(pose, values, photo.lens)
                    row = {
                        "pose": name,
                        "picture": number,
                        "model": model,
                        "tested": name in settings.data.test,
                    }
                    q = pose.vertices(photo, near[1], seen_by)
                    rows.append({**row, **pose.difference(photo, q, seen_by), "values": seen_by})
                    corrections = PlacedCamera.corrections(seen_by)
                    if photo.outline is not None:
                        rim, weights, _ = pose.outlines(photo, q, corrections)
                        create(file, f"{name}/{number}/{model}", rim.pixels, "px")
                        create(file, f"{name}/{number}/{model}_weight", weights, "px")
                        if model == MODELS[0]:
                            create(file, f"{name}/{number}/measured", photo.outline.points, "px")
                    if photo.cloud is not None:
                        closest = photo.cloud.distances(
                            photo.camera, corrections, pose.surface.triangles, q
                        )
                        distances = np.abs(closest.distances)
                        content = {
                            "places": closest.places,
                            "distances": distances,
                            "surface": q.numpy(),
                        }
                        for key, array in content.items():
                            create(file, f"{name}/{number}/{model}_{key}", array, "m")
                        if model == MODELS[0]:
                            create(file, f"{name}/{number}/triangles", pose.surface.triangles)
                progress.advance(1, pose=name)
    write_json(context.run_dir / DIFFERENCES, {"rows": rows})


def summary_of(rows: Sequence[Mapping[str, Any]], data: PictureData) -> list[PictureResult]:
    """Returns the results of each pose: means over its pictures, by model."""
    results = []
    for name in (*data.train, *data.test):
        of_pose = [row for row in rows if row["pose"] == name]
        means = dict[str, dict[str, float | None]]()
        for key in ("outline_mm", "outline_px", "overlap", "cloud_mm", "points_mm"):
            for model in MODELS:
                known = [row[key] for row in of_pose if row["model"] == model and key in row]
                means.setdefault(key, {})[model] = float(np.mean(known)) if known else None
        count = len({row["picture"] for row in of_pose})
        results.append(
            PictureResult(name, data.poses[name].material or "", name in data.test, count, **means)
        )
    return results


def report_pictures(context: StageContext) -> None:
    """Writes report.html and its figures."""
    run: RunSettings = context.settings
    data = run.pictures
    assert data is not None
    settings = StageSettings.reading(run, *SIMULATOR, "simulation", "seed", "data")
    poses = SeenPoses(settings, context.run_dir)
    identified = Identification.from_plain(read_json(context.run_dir / IDENTIFICATION)["sysid"])
    start = dict(run.simulation.values)
    for name in data.train:
        material, parameters = data.poses[name].material or "", poses.material(name).values
        start |= (
            {value_name(key, material): value for key, value in parameters.items()}
            if material
            else {}
        )
    write_pictures_report(
        context.run_dir / REPORT,
        picture_metrics(context.run_dir, run),
        run,
        identified,
        start,
        context.run_dir / OUTLINES,
        poses.picture,
    )


def picture_metrics(folder: Path, run: RunSettings) -> PictureMetrics:
    """Returns the content of metrics.json."""
    data = run.pictures
    assert data is not None
    rows = read_json(folder / DIFFERENCES)["rows"]
    stages = ["laboratory", "import", "identify", COMPARE]
    return {
        "poses": [asdict(result) for result in summary_of(rows, data)],
        "parameters": read_json(folder / IDENTIFICATION)["sysid"]["parameters"],
        **resources_used(folder, stages[data.folder is not None :]),
        "versions": package_versions(),
        "device": str(simulation_device(run.device)),
    }


def run_pictures(run: RunSettings, folder: Path) -> None:
    """Runs the stages of pictures, and prints the results."""
    run_stages(picture_stages(run, files_read(run, run)), folder)
    print_pictures(run, folder)


def print_pictures(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json, and prints the distances of outlines, the parameters and the verdict."""
    metrics = picture_metrics(folder, run)
    write_json(folder / METRICS, metrics)
    results = [PictureResult(**row) for row in metrics["poses"]]
    identified = Identification.from_plain(read_json(folder / IDENTIFICATION)["sysid"])
    material = {
        name: v for name, v in identified.parameters.items() if split_name(name)[0] not in _PLACED
    }
    rows = parameter_rows(replace(identified, parameters=material), {}, {})
    values = (f"{row.head}: {row.cells[1].text} {row.cells[1].beside}" for row in rows)
    show(
        run.heading,
        distance_table(results),
        *values,
        *picture_verdict(results),
        f"Report: {folder / REPORT}",
    )
