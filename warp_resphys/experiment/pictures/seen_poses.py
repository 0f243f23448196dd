"""Bodies before a camera, at rest or released: from settings and the files of pictures to `SeenPose`."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from ...data.camera import Lens, PlacedCamera
from ...data.markers import bind_markers
from ...fem.body import Body
from ...io.atomic import atomic_path, digest
from ...io.errors import DataFileError, InputError, MeshError, listed
from ...io.files import atomic_hdf5, create, read_array, read_hdf5
from ...io.stages import StageContext
from ...mesh.mesh import Mesh, quadratic, select_vertices
from ...mesh.readers import METRES, read_mesh
from ...pictures.clouds import Cloud
from ...pictures.motion import ReleasedForce
from ...pictures.outlines import ClosedSurface, Outline
from ...pictures.reading import (
    Colours,
    Frame,
    SceneFile,
    check_times,
    read_depth,
    read_mask,
    read_picture,
    read_scene,
    read_tracked,
)
from ...pictures.scans import read_scan
from ...pictures.seen import Photo, SeenPose
from ...pictures.tags import Tag
from ...settings.body import MaterialSettings
from ...settings.pictures import PictureData, PoseSettings
from ...settings.stages import PictureStage
from ..build import build_mesh, build_simulator

log = logging.getLogger(__name__)

PICTURES: Final = "pictures.h5"
SCENE: Final = "camera.json"
_KIND: Final = "pictures"
_OF_FRAMES: Final = ("masks", "depths")
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
    paths = [Path(data.folder).expanduser() / lens.file for lens in data.lenses.values() if lens.file is not None]
    for pose in data.poses.values():
        scene = scene_of(data, pose, Path())
        own = [pose.mesh, pose.points, pose.cloud]
        paths += [scene.path] if scene.path.exists() else []
        paths += [scene.path.parent / name for name in own if name is not None]
        paths += [path for frame in scene.frames for path in frame.files]
    result = {}
    for path in paths:
        try:
            result[str(path)] = digest(path)
        except OSError as error:
            raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and data.poses.") from error
    return result


def scene_of(data: PictureData, pose: PoseSettings, run_dir: Path) -> SceneFile:
    """Returns the content of a pose's camera.json, with the chosen frames.

    Raises:
        DataFileError: it is missing or damaged.
        InputError: a chosen frame, or a lens, is not there.
    """
    scene = read_scene(scene_file(data, pose, run_dir), pose.cloud is not None)
    if wrong := [number for number in pose.frames or () if number >= len(scene.frames)]:
        raise InputError(
            f"the frames of {pose.folder} in data.poses name {wrong[0]}, but {scene.path} has {len(scene.frames)}, "
            "from 0: leave it out."
        )
    frames = tuple(frame for frame in scene.frames if pose.frames is None or frame.number in pose.frames)
    if frames and not data.lenses:
        raise InputError(f"data.lens is not set, and {scene.path} has frames: give the lens of the camera.")
    for frame in frames:
        if frame.lens not in data.lenses:
            names = listed([own for own in data.lenses if own])
            raise InputError(
                f"{scene.path}: frame {frame.number} has the lens '{frame.lens}', and data.lens has the names {names}: "
                "name the lens of a frame, as 'lens', where data.lens has several, and only there."
            )
    scene = replace(scene, frames=frames)
    if pose.release is not None:
        check_times(scene, pose.release.time)
    return scene


def released_force(name: str, pose: PoseSettings, mesh: Mesh) -> ReleasedForce | None:
    """Returns the force that holds the body of a pose until its release; None for one at rest.

    Raises:
        MeshError: no vertex carries it.
    """
    wanted = pose.release
    if wanted is None:
        return None
    try:
        return ReleasedForce(select_vertices(mesh, **wanted.at.arguments()), wanted.force, wanted.time)
    except MeshError as error:
        raise MeshError(f"data.poses.{name}.release.at: {error}") from None


def import_pictures(context: StageContext) -> None:
    """Writes pictures.h5: of every pose the masks, depths, cameras, tracked points and the scan.

    Raises:
        DataFileError: a picture cannot be read, or does not show the body.
    """
    settings: PictureStage = context.settings
    data = settings.data
    with atomic_hdf5(context.run_dir / PICTURES, _KIND, {"fingerprint": context.fingerprint}) as file:
        for name, pose in data.poses.items():
            scene = scene_of(data, pose, context.run_dir)
            frames = _different(name, scene.frames)
            if pose.release is not None:
                check_times(replace(scene, frames=tuple(frames)), pose.release.time)
            colours = pose.mask or data.mask
            chosen = None if colours is None else Colours(**dict(colours))
            masks = dict[int, NDArray[np.bool_]]()
            for frame in frames:
                with_depth = pose.depth and frame.depth is not None
                coloured = chosen is not None and frame.image != frame.depth
                if pose.outline or (with_depth and (frame.mask is not None or coloured)):
                    masks[frame.number] = _mask(frame, chosen)
                    create(file, f"{name}/masks/{frame.number}", masks[frame.number])
                if with_depth:
                    create(file, f"{name}/depths/{frame.number}", _depth(frame, masks.get(frame.number), data), "m")
            numbers = [frame.number for frame in frames]
            if pose.points is not None:
                path = scene.path.parent / pose.points
                tracked = read_tracked(path, [*data.points], data.likelihood, numbers)
                if not np.isfinite(tracked).any():
                    raise DataFileError(f"{path}: no point was seen in the frames of data.poses.{name}: leave it out.")
                create(file, f"{name}/tracked", tracked, "px")
            if pose.cloud is not None:
                points, normals = read_scan(scene.path.parent / pose.cloud, METRES[data.cloud.units], settings.seed)
                create(file, f"{name}/scan", points, "m")
                if normals is not None:
                    create(file, f"{name}/scan_normals", normals)
                log.info("import: %s has a scan of %d points", name, len(points))
            create(file, f"{name}/world_to_camera", _cameras(scene.path, frames, data), "1, m")
            create(file, f"{name}/frames", numbers)
            shares = [100.0 * mask.mean() for mask in masks.values()]
            covers = f", of which the body covers {min(shares):.1f} to {max(shares):.1f} %" if shares else ""
            if frames:
                log.info("import: %s has %d picture%s%s", name, len(frames), "s"[: len(frames) != 1], covers)
            shown = next((frame for frame in frames if frame.number in masks and frame.image != frame.depth), None)
            if shown is not None:
                image = read_picture(shown.image)
                _show_mask(context.run_dir / "masks" / f"{name}.png", image, masks[shown.number])


def _depth(frame: Frame, mask: NDArray[np.bool_] | None, data: PictureData) -> NDArray[np.float32]:
    """A depth image (H, W), zero where the mask does not show the body [m]."""
    assert frame.depth is not None
    depth = read_depth(frame.depth, data.cloud.depth_unit)
    others = {} if mask is None else {"mask": mask.shape}
    if frame.image != frame.depth:
        others["picture"] = read_picture(frame.image).shape[:2]
    for other, shape in others.items():
        if shape != depth.shape:
            raise DataFileError(
                f"{frame.depth} has {depth.shape[1]} x {depth.shape[0]} pixels, and its {other} {shape[1]} x "
                f"{shape[0]}: register the depths to the picture."
            )
    return np.where(np.isfinite(depth) & (True if mask is None else mask), depth, 0.0).astype(np.float32)


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
        given = [np.stack([frame.pose, frame.pose]) for frame in frames if frame.pose is not None]
        return _of_standing(path, frames, np.array(given).reshape(-1, 2, 4, 4), data)
    tag, lenses = Tag(**dict(data.tag)), read_lenses(data)
    tagged = [tag.poses(read_picture(frame.image), lenses[frame.lens]) for frame in frames]
    if hidden := [frame.image for frame, own in zip(frames, tagged, strict=True) if not own]:
        raise DataFileError(
            f"{hidden[0]} does not show the tag {tag.number} of {tag.dictionary}: check data.tag, leave the frame out, "
            "or give its world_to_camera."
        )
    both = np.array([np.stack([own[0], own[-1]]) for own in tagged]).reshape(-1, 2, 4, 4)
    return _of_standing(path, frames, both, data)


def _of_standing(
    path: Path, frames: Sequence[Frame], cameras: NDArray[np.float64], data: PictureData
) -> NDArray[np.float64]:
    """The cameras (F, 2, 4, 4), refused if a standing one sees the origin of the mesh at different places."""
    first: dict[str, NDArray[np.float64]] = {}
    places = [(first.setdefault(f.lens, own[0, :3, 3]), own[0, :3, 3]) for f, own in zip(frames, cameras, strict=True)]
    apart = max((float(np.linalg.norm(there - here)) for here, there in places), default=0.0)
    if data.stands and apart > _MOVED:
        raise DataFileError(
            f"{path}: between its frames the camera moves by {100.0 * apart:.0f} cm against the origin of the mesh: "
            "set data.stands=false if it does, or name several in data.lens; world_to_camera is in m."
        )
    return cameras


def _different(name: str, frames: Sequence[Frame]) -> list[Frame]:
    """Frames without copies of earlier pictures, which would count as often as there are copies."""
    first: dict[str, Frame] = {}
    for frame in frames:
        first.setdefault(digest(frame.files[0]), frame)
    if len(first) < len(frames):
        log.warning(
            "import: %d of the %d pictures of %s are copies of others, and are left out",
            *(len(frames) - len(first), len(frames), name),
        )
    return [*first.values()]


@dataclass(frozen=True)
class Loaded:
    """A pose as it was read."""

    masks: dict[int, NDArray[np.bool_]]  # (H, W) by number of the frame
    depths: dict[int, NDArray[np.float64]]  # (H, W) by number of the frame [m]
    cameras: NDArray[np.float64]  # (F, 2, 4, 4) world_to_camera: two that a tag allows, or the given one twice
    tracked: NDArray[np.float64] | None  # (F, M, 2) [px]
    frames: tuple[int, ...]
    scan: NDArray[np.float64] | None = None  # (P, 3) [m]
    normals: NDArray[np.float64] | None = None  # (P, 3) of these points


def _loaded(file: h5py.Group) -> Loaded:
    """A pose of pictures.h5."""
    masks, depths = ({int(own): read_array(file, f"{key}/{own}") for own in file.get(key, ())} for key in _OF_FRAMES)
    tracked, scan, normals = (
        read_array(file, key) if key in file else None for key in ("tracked", "scan", "scan_normals")
    )
    frames = tuple(read_array(file, "frames").tolist())
    return Loaded(masks, depths, read_array(file, "world_to_camera"), tracked, frames, scan, normals)


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
        self.lenses, self._poses = read_lenses(self.data), dict[str, SeenPose]()
        with read_hdf5(run_dir / PICTURES, _KIND) as file:
            self.loaded = {name: _loaded(file[name]) for name in self.data.poses}

    def picture(self, name: str, number: int) -> NDArray[np.uint8]:
        """Returns a picture (H, W, 3) of a pose, by its number among those that are used.

        Raises:
            DataFileError: it is missing.
        """
        return read_picture(self._frames(name)[number].image)

    def _frames(self, name: str) -> list[Frame]:
        """The frames of a pose that are used."""
        used = self.loaded[name].frames
        return [f for f in scene_of(self.data, self.data.poses[name], self.run_dir).frames if f.number in used]

    def cameras_of(self, name: str, lens: str) -> list[torch.Tensor]:
        """Returns the different cameras (4, 4) of a pose's frames by a lens, from which a standing one is chosen."""
        different, mine = list[torch.Tensor](), [frame.lens == lens for frame in self._frames(name)]
        for camera in torch.as_tensor(self.loaded[name].cameras[mine].reshape(-1, 4, 4)):
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
        scene, photos, surface = scene_of(self.data, own, self.run_dir), list[Photo](), ClosedSurface.of_mesh(mesh)
        for number, frame in enumerate(self._frames(name)):
            camera = PlacedCamera(self.lenses[frame.lens], torch.as_tensor(loaded.cameras[number, 0]), centre)
            outline = Outline.of_mask(loaded.masks[frame.number]) if own.outline else None
            tracked = None if loaded.tracked is None else loaded.tracked[number]
            cloud, depth = None, loaded.depths.get(frame.number)
            if depth is not None:
                cloud = self._cloud(frame.files[0], Cloud.of_depth(depth), camera, mesh, fixed)
            row_time = self.data.lenses[frame.lens].row_time
            title, time = f"{own.folder}/{frame.image.name}", frame.time or 0.0
            photos.append(Photo(title, camera, outline, tracked, cloud, frame.lens, time, row_time))
        if loaded.scan is not None:
            camera = PlacedCamera(None, torch.as_tensor(scene.scan_pose), centre)
            outside = None if loaded.normals is None else loaded.scan + loaded.normals
            cloud = self._cloud(scene.path.parent / str(own.cloud), Cloud(loaded.scan, outside), camera, mesh, fixed)
            photos.append(Photo(f"{own.folder}/{own.cloud}", camera, cloud=cloud))
        release, material_name = released_force(name, own, mesh), own.material or ""
        return SeenPose(name, simulator, surface, clamps, tuple(photos), material_name, points, release=release)

    def _cloud(self, path: Path, cloud: Cloud, camera: PlacedCamera, mesh: Mesh, clamped: NDArray[np.int64]) -> Cloud:
        """The points that may be of a body, as many as configured."""
        wanted = self.data.cloud
        cloud = replace(cloud, noise=wanted.noise, reach=wanted.reach)
        try:
            return cloud.around(camera, mesh, clamped, wanted.points, self.settings.seed)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def _mesh(self, name: str) -> tuple[Mesh, tuple[NDArray[np.int64], ...]]:
        """Mesh of a pose, and the vertices in its clamps."""
        own = self.data.poses[name]
        scene = scene_of(self.data, own, self.run_dir)
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
        if clamps:
            return mesh, clamps
        if self.settings.fixed is None:
            raise InputError(f"{scene.path} has no clamps, and fixed is null: give one of them.")
        return mesh, (select_vertices(mesh, **self.settings.fixed.arguments()),)


def _with_midpoints(mesh: Mesh, corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Vertices of a clamp and, of quadratic elements, the nodes between them."""
    inside = np.isin(np.arange(len(mesh.vertices)), corners)
    within = inside.copy()
    first = mesh.cells.shape[1] - len(mesh.element.parents)
    for number, parents in enumerate(mesh.element.parents):
        within[mesh.cells[inside[mesh.cells[:, list(parents)]].all(1), first + number]] = True
    return np.flatnonzero(within)


def read_lenses(data: PictureData) -> dict[str, Lens]:
    """Returns the lenses of the cameras by name, which is empty for a single one.

    Raises:
        DataFileError: a calibration cannot be read.
    """
    folder = Path(data.folder or ".").expanduser()
    return {
        name: Lens(torch.tensor(own.matrix, dtype=torch.float64)) if own.file is None else Lens.read(folder / own.file)
        for name, own in data.lenses.items()
    }
