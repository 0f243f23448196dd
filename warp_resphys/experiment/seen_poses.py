"""Bodies at rest before a camera: from settings and the files of pictures to `SeenPose`."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from ..data.camera import Lens
from ..data.markers import bind_markers
from ..fem.body import Body
from ..io.atomic import atomic_path, digest
from ..io.errors import DataFileError, InputError
from ..io.files import atomic_hdf5, create, read_array, read_hdf5
from ..io.stages import StageContext
from ..mesh.mesh import Mesh, quadratic, select_vertices
from ..mesh.readers import read_mesh
from ..pictures.camera import PlacedCamera
from ..pictures.outlines import ClosedSurface, Outline
from ..pictures.reading import Colours, Frame, read_mask, read_picture, read_scene, read_tracked
from ..pictures.seen import Photo, SeenPose
from ..pictures.tags import Tag
from ..settings.body import MaterialSettings
from ..settings.pictures import PictureData, PoseSettings
from ..settings.stages import PictureStage
from .build import build_mesh, build_simulator

log = logging.getLogger(__name__)

PICTURES: Final = "pictures.h5"
SCENE: Final = "camera.json"
_KIND: Final = "pictures"
_ALIKE: Final = 1e-9  # of two cameras
_MOVED: Final = 0.05  # m: a tag that can be seen in two ways keeps its place


def scene_file(data: PictureData, pose: PoseSettings, run_dir: Path) -> Path:
    """Returns the path of a pose's camera.json, in the folder of the data or of a simulated laboratory."""
    folder = run_dir / "recordings" if data.folder is None else Path(data.folder).expanduser()
    return folder / pose.folder / SCENE


def picture_files(data: PictureData) -> dict[str, str]:
    """Returns the SHA-256 of all files of the pictures, by path; empty where they are simulated.

    Raises:
        DataFileError: a file is missing.
    """
    if data.folder is None:
        return {}
    paths = [] if data.lens.file is None else [Path(data.folder).expanduser() / data.lens.file]
    for pose in data.poses.values():
        scene = read_scene(scene_file(data, pose, Path()))
        own = [pose.mesh, pose.points]
        paths += [scene.path, *(scene.path.parent / name for name in own if name is not None)]
        paths += [
            path for frame in _chosen(scene.frames, pose) for path in (frame.image, frame.mask) if path is not None
        ]
    result = {}
    for path in paths:
        try:
            result[str(path)] = digest(path)
        except OSError as error:
            raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and data.poses.") from error
    return result


def _chosen(frames: Sequence[Frame], pose: PoseSettings) -> list[Frame]:
    return [frame for number, frame in enumerate(frames) if pose.frames is None or number in pose.frames]


def import_pictures(context: StageContext) -> None:
    """Writes pictures.h5: of every pose the masks of the body, the poses of the camera and the tracked points.

    Raises:
        DataFileError: a picture cannot be read, or does not show the body.
    """
    settings: PictureStage = context.settings
    data = settings.data
    with atomic_hdf5(context.run_dir / PICTURES, _KIND, {"fingerprint": context.fingerprint}) as file:
        for name, pose in data.poses.items():
            scene = read_scene(scene_file(data, pose, context.run_dir))
            wrong = [number for number in pose.frames or () if number >= len(scene.frames)]
            if wrong:
                raise InputError(f"data.poses.{name}.frames has {wrong[0]}, but {scene.path} has {len(scene.frames)}.")
            frames = _different(name, _chosen(scene.frames, pose))
            colours = pose.mask or data.mask
            chosen = None if colours is None else Colours(**dict(colours))
            masks = [_mask(frame, chosen) for frame in frames] if pose.outline else []
            if len({mask.shape for mask in masks}) > 1:
                raise DataFileError(f"{scene.path}: its pictures have different sizes: give each size its own pose.")
            numbers = [frame.number for frame in frames]
            if pose.points is not None:
                path = scene.path.parent / pose.points
                tracked = read_tracked(path, [*data.points], data.likelihood, numbers)
                if not np.isfinite(tracked).any():
                    raise DataFileError(f"{path}: no point was seen in the frames of data.poses.{name}: leave it out.")
                create(file, f"{name}/tracked", tracked, "px")
            create(file, f"{name}/masks", np.array(masks, dtype=bool))
            create(file, f"{name}/world_to_camera", _cameras(scene.path, frames, data), "1, m")
            create(file, f"{name}/frames", numbers)
            shares = [100.0 * mask.mean() for mask in masks]
            covers = f", of which the body covers {min(shares):.1f} to {max(shares):.1f} %" if shares else ""
            log.info("import: %s has %d picture%s%s", name, len(frames), "s"[: len(frames) != 1], covers)
            if masks:
                _show_mask(context.run_dir / "masks" / f"{name}.png", read_picture(frames[0].image), masks[0])


def _show_mask(path: Path, image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> None:
    """Writes a picture in which everything but the body is dark."""
    with atomic_path(path) as partial:
        Image.fromarray(np.where(mask[..., None], image, image // 4)).save(partial, format="png")


def _mask(frame: Frame, colours: Colours | None) -> NDArray[np.bool_]:
    """The mask of a picture, of the same size as that."""
    mask = read_mask(frame, colours)
    if frame.mask is not None and (size := read_picture(frame.image).shape[:2]) != mask.shape:
        raise DataFileError(
            f"{frame.mask} has {mask.shape[1]} x {mask.shape[0]} pixels, and {frame.image.name} {size[1]} x {size[0]}."
        )
    return mask


def _cameras(path: Path, frames: Sequence[Frame], data: PictureData) -> NDArray[np.float64]:
    """(F, 2, 4, 4) the given cameras of frames, or the two that a tag in each allows."""
    if data.tag is None:
        if missing := [frame.image.name for frame in frames if frame.pose is None]:
            raise DataFileError(f"{path}: {missing[0]} has no 'world_to_camera': give it, or the tag of data.tag.")
        given = np.stack([np.stack([frame.pose, frame.pose]) for frame in frames if frame.pose is not None])
        return _of_one_camera(path, given, data)
    tag, lens = Tag(**dict(data.tag)), read_lens(data)
    found = [tag.poses(read_picture(frame.image), lens) for frame in frames]
    if hidden := [frame.image for frame, own in zip(frames, found, strict=True) if not own]:
        raise DataFileError(
            f"{hidden[0]} does not show the tag {tag.number} of {tag.dictionary}: check data.tag, leave the frame out, "
            "or give its world_to_camera."
        )
    return _of_one_camera(path, np.stack([np.stack([own[0], own[-1]]) for own in found]), data)


def _of_one_camera(path: Path, cameras: NDArray[np.float64], data: PictureData) -> NDArray[np.float64]:
    """The cameras (F, 2, 4, 4), refused if a standing one sees the origin of the mesh at different places."""
    apart = np.linalg.norm(cameras[:, 0, :3, 3] - cameras[0, 0, :3, 3], axis=1).max()
    if data.stands and apart > _MOVED:
        raise DataFileError(
            f"{path}: between its frames the camera moves by {100.0 * apart:.0f} cm against the origin of the mesh: "
            "set data.stands=false if it does, or if there are several; world_to_camera is in m."
        )
    return cameras


def _different(name: str, frames: Sequence[Frame]) -> list[Frame]:
    """Frames without copies of earlier pictures, which would count as often as there are copies."""
    first: dict[str, Frame] = {}
    for frame in frames:
        first.setdefault(digest(frame.mask or frame.image), frame)
    if len(first) < len(frames):
        log.warning(
            "import: %d of the %d pictures of %s are copies of others, and are left out",
            *(len(frames) - len(first), len(frames), name),
        )
    return [*first.values()]


@dataclass(frozen=True)
class Loaded:
    """A pose as it was read."""

    masks: NDArray[np.bool_]  # (F, H, W), or empty
    cameras: NDArray[np.float64]  # (F, 2, 4, 4) world_to_camera: two that a tag allows, or the given one twice
    tracked: NDArray[np.float64] | None  # (F, M, 2) [px]
    frames: tuple[int, ...]


class SeenPoses:
    """The poses of a run.

    Args:
        settings: of the run's stage.
        run_dir: its folder, with pictures.h5.

    Raises:
        DataFileError: a file is missing or damaged.
        InputError: values that do not fit.
    """

    def __init__(self, settings: PictureStage, run_dir: Path) -> None:
        self.settings, self.data, self.run_dir = settings, settings.data, run_dir
        self.lens, self._poses = read_lens(self.data), dict[str, SeenPose]()
        with read_hdf5(run_dir / PICTURES, _KIND) as file:
            self.loaded = {
                name: Loaded(
                    read_array(file, f"{name}/masks"),
                    read_array(file, f"{name}/world_to_camera"),
                    read_array(file, f"{name}/tracked") if f"{name}/tracked" in file else None,
                    tuple(read_array(file, f"{name}/frames").tolist()),
                )
                for name in self.data.poses
            }

    def picture(self, name: str, number: int) -> NDArray[np.uint8]:
        """Returns a picture (H, W, 3) of a pose, by its number among those that are used.

        Raises:
            DataFileError: it is missing.
        """
        scene = read_scene(scene_file(self.data, self.data.poses[name], self.run_dir))
        return read_picture(scene.frames[self.loaded[name].frames[number]].image)

    def cameras_of(self, name: str) -> list[torch.Tensor]:
        """Returns the different cameras (4, 4) of a pose's frames, from which a standing camera is chosen."""
        different: list[torch.Tensor] = []
        for camera in torch.as_tensor(self.loaded[name].cameras.reshape(-1, 4, 4)):
            if all((camera - other).abs().max() > _ALIKE for other in different):
                different.append(camera)
        return different

    def material(self, name: str) -> MaterialSettings:
        """Returns the material of a pose, as configured."""
        constants = self.data.materials.get(self.data.poses[name].material or "", {})
        common = self.settings.simulation
        return common.changed(**{**common.constants, **constants})

    def pose(self, name: str) -> SeenPose:
        """Returns a pose by its name, with a camera for each frame; of a tag, the one that fits better."""
        if name not in self._poses:
            self._poses[name] = self._made(name)
        return self._poses[name]

    def _made(self, name: str) -> SeenPose:
        settings, own, loaded = self.settings, self.data.poses[name], self.loaded[name]
        mesh, clamps = self._mesh(name)
        fixed = np.unique(np.concatenate(clamps))
        material = self.material(name)
        if own.gravity is not None:
            settings = settings.model_copy(update={"gravity": own.gravity})
        simulator = build_simulator(settings, material, Body(mesh, fixed=fixed, **dict(settings.physics)))
        points = None
        if own.points is not None:
            points = bind_markers(mesh, [*self.data.points.values()], [*self.data.points])
        centre = torch.as_tensor(mesh.vertices[fixed].mean(0))
        outlines: list[Outline | None] = [Outline.of_mask(mask) for mask in loaded.masks] or [None] * len(loaded.frames)
        scene, photos = read_scene(scene_file(self.data, own, self.run_dir)), []
        for number, (frame, outline) in enumerate(zip(loaded.frames, outlines, strict=True)):
            image = f"{own.folder}/{scene.frames[frame].image.name}"
            tracked = None if loaded.tracked is None else loaded.tracked[number]
            camera = PlacedCamera(self.lens, torch.as_tensor(loaded.cameras[number, 0]), centre)
            photos.append(Photo(image, camera, outline, tracked))
        surface = ClosedSurface.of_mesh(mesh)
        return SeenPose(name, simulator, surface, clamps, tuple(photos), own.material or "", points)

    def _mesh(self, name: str) -> tuple[Mesh, tuple[NDArray[np.int64], ...]]:
        """Mesh of a pose, and the vertices in its clamps."""
        own = self.data.poses[name]
        scene = read_scene(scene_file(self.data, own, self.run_dir))
        if own.mesh is None:
            mesh = build_mesh(self.settings.mesh)
        else:
            mesh = read_mesh(scene.path.parent / own.mesh, self.data.units)
        corners = len(mesh.vertices)
        if wrong := [clamp for clamp in scene.clamps if clamp.min() < 0 or clamp.max() >= corners]:
            raise DataFileError(
                f"{scene.path}: 'fixed' has vertices from {wrong[0].min()} to {wrong[0].max()}, but the mesh has those "
                f"from 0 to {corners - 1}."
            )
        if own.mesh is not None and self.data.order == 2:
            mesh = quadratic(mesh)
        clamps = tuple(_with_midpoints(mesh, clamp) for clamp in scene.clamps)
        return mesh, clamps or (select_vertices(mesh, **self.settings.fixed.arguments()),)


def _with_midpoints(mesh: Mesh, corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Vertices of a clamp and, of quadratic elements, the nodes between them."""
    inside = np.isin(np.arange(len(mesh.vertices)), corners)
    within = inside.copy()
    first = mesh.cells.shape[1] - len(mesh.element.parents)
    for number, parents in enumerate(mesh.element.parents):
        within[mesh.cells[inside[mesh.cells[:, list(parents)]].all(1), first + number]] = True
    return np.flatnonzero(within)


def read_lens(data: PictureData) -> Lens:
    """Returns the lens of the camera.

    Raises:
        DataFileError: its calibration cannot be read.
    """
    if data.lens.file is not None:
        return Lens.read(Path(data.folder or ".").expanduser() / data.lens.file)
    return Lens(torch.tensor(data.lens.matrix, dtype=torch.float64))
