"""Bodies before a camera, at rest or released: from settings
and the files of pictures to `SeenPose`.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from ..core.fem.bodies import Body
from ..core.mesh.readers import METRES, read_mesh
from ..core.mesh.selection import vertices_at
from ..core.mesh.volume_mesh import Mesh, quadratic
from ..data.camera import Lens, PlacedCamera
from ..data.markers import bind_markers
from ..experiment.build import build_mesh, build_simulator
from ..io.arrays import FloatArray, IntArray
from ..io.atomic import atomic_path, digest
from ..io.errors import DataFileError, InputError, listed, naming, number_of
from ..io.resuming import StageContext
from ..io.safe_files import atomic_hdf5, create, read_array, read_hdf5
from ..settings.body import MaterialSettings
from ..settings.pictures import PictureData, PoseSettings
from ..settings.stage_keys import StageSettings
from .clouds import Cloud
from .outlines import ClosedSurface, Outline
from .released_force import ReleasedForce
from .scene_files import (
    Frame,
    SceneFile,
    check_times,
    read_depth,
    read_mask,
    read_picture,
    read_scan,
    read_scene,
    read_tracked,
)
from .seen import Photo, SeenPose
from .tags import tag_poses

log = logging.getLogger(__name__)

PICTURES: Final = "pictures.h5"
SCENE: Final = "camera.json"
_KIND: Final = "pictures"
_ALIKE: Final = 1e-9  # of two cameras
_MOVED: Final = 0.05  # m: a tag that can be seen in two ways keeps its place


def scene_file(data: PictureData, pose: PoseSettings, run_dir: Path) -> Path:
    """Returns the path of a pose's camera.json, in the folder of the data
    or of a simulated laboratory.
    """
    folder = run_dir / "recordings" if data.folder is None else Path(data.folder).expanduser()
    return folder / pose.folder / SCENE


def picture_files(data: PictureData) -> dict[str, str]:
    """Returns the SHA-256 of all files of the pictures, by path; empty where they are simulated.

    Raises:
        DataFileError: a file is missing.
    """
    if data.folder is None:
        return {}
    paths = [
        Path(data.folder).expanduser() / lens.file
        for lens in data.lenses.values()
        if lens.file is not None
    ]
    for pose in data.poses.values():
        scene = scene_of(data, pose, Path())
        beside = [pose.mesh, pose.points, pose.cloud]
        paths += [scene.path] if scene.path.exists() else []
        paths += [scene.path.parent / name for name in beside if name is not None]
        paths += chain.from_iterable(frame.files for frame in scene.frames)
    result = {}
    for path in paths:
        try:
            result[str(path)] = digest(path)
        except OSError as error:
            raise DataFileError(
                f"cannot read {path} ({error.strerror}): check data.folder and data.poses."
            ) from error
    return result


def scene_of(data: PictureData, pose: PoseSettings, run_dir: Path) -> SceneFile:
    """Returns the content of a pose's camera.json, with the chosen frames.

    Raises:
        DataFileError: it is missing or damaged.
        InputError: a chosen frame, or a lens, is not there.
    """
    scene = read_scene(scene_file(data, pose, run_dir), pose.cloud is not None)
    wrong = [number for number in pose.frames or () if number >= len(scene.frames)]
    if wrong:
        raise InputError(
            f"the frames of {pose.folder} in data.poses name {wrong[0]}, but {scene.path} has "
            f"{len(scene.frames)}, from 0: leave it out."
        )
    frames = tuple(
        frame for frame in scene.frames if pose.frames is None or frame.number in pose.frames
    )
    if frames and not data.lenses:
        raise InputError(
            f"data.lens is not set, and {scene.path} has frames: give the lens of the camera."
        )
    for frame in frames:
        if frame.lens not in data.lenses:
            names = listed([lens for lens in data.lenses if lens])
            raise InputError(
                f"{scene.path}: frame {frame.number} has the lens '{frame.lens}', and data.lens "
                f"has the names {names}: name the lens of a frame, as 'lens', where data.lens "
                "has several, and only there."
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
    with naming(f"data.poses.{name}.release.at: "):
        return ReleasedForce(vertices_at(mesh, wanted.at), wanted.force, wanted.time)


def import_pictures(context: StageContext) -> None:
    """Writes pictures.h5: of every pose the masks, depths, cameras, tracked points and the scan.

    Copies of earlier pictures are left out, as they would count as often as there are copies.

    Raises:
        DataFileError: a picture cannot be read, or does not show the body.
    """
    settings: StageSettings = context.settings
    data = settings.data
    with atomic_hdf5(
        context.run_dir / PICTURES, _KIND, {"fingerprint": context.fingerprint}
    ) as file:
        for name, pose in data.poses.items():
            scene = _without_copies(scene_of(data, pose, context.run_dir), name)
            if pose.release is not None:
                check_times(scene, pose.release.time)
            arrays, shares = dict[str, tuple[NDArray[Any], str]](), list[float]()
            for frame in scene.frames:
                mask, depth = _shown(frame, pose, data)
                if mask is not None:
                    arrays[f"masks/{frame.number}"] = mask, "1"
                    if frame.image != frame.depth and not shares:
                        # A picture with everything but the body dark.
                        image = read_picture(frame.image)
                        with atomic_path(context.run_dir / "masks" / f"{name}.png") as partial:
                            Image.fromarray(np.where(mask[..., None], image, image // 4)).save(
                                partial, format="png"
                            )
                    shares.append(100.0 * mask.mean())
                if depth is not None:
                    arrays[f"depths/{frame.number}"] = depth, "m"
            numbers = [frame.number for frame in scene.frames]
            if pose.points is not None:
                arrays["tracked"] = (
                    _tracked(scene.path.parent / pose.points, name, numbers, data),
                    "px",
                )
            if pose.cloud is not None:
                points, normals = read_scan(
                    scene.path.parent / pose.cloud, METRES[data.cloud.units], settings.seed
                )
                arrays["scan"] = points, "m"
                arrays |= {} if normals is None else {"scan_normals": (normals, "1")}
                log.info("import: %s has a scan of %d points", name, len(points))
            arrays["world_to_camera"] = _cameras(scene.path, scene.frames, data), "1, m"
            arrays["frames"] = np.array(numbers), "1"
            for key, (array, unit) in arrays.items():
                create(file, f"{name}/{key}", array, unit)
            covers = (
                f", of which the body covers {min(shares):.1f} to {max(shares):.1f} %"
                if shares
                else ""
            )
            if numbers:
                log.info("import: %s has %s%s", name, number_of(len(numbers), "picture"), covers)


def _without_copies(scene: SceneFile, name: str) -> SceneFile:
    """Returns a scene without frames of a pose that are copies of others, with a warning."""
    different = dict[str, Frame]()
    for frame in scene.frames:
        different.setdefault(digest(frame.files[0]), frame)
    if len(different) < len(scene.frames):
        log.warning(
            "import: %d of the %d pictures of %s are copies of others, and are left out",
            len(scene.frames) - len(different),
            len(scene.frames),
            name,
        )
    return replace(scene, frames=(*different.values(),))


def _shown(
    frame: Frame, pose: PoseSettings, data: PictureData
) -> tuple[NDArray[Any] | None, NDArray[Any] | None]:
    """Returns the mask (H, W) of a frame, and its depths (H, W) of the body, zero elsewhere [m].

    None without.
    """
    colours = pose.mask or data.mask
    pictured = frame.image != frame.depth
    mask = None
    deep = frame.depth if pose.depth else None
    if pose.outline or (
        deep is not None and (frame.mask is not None or (colours is not None and pictured))
    ):
        mask = read_mask(frame, colours)
        if frame.mask is not None:
            _check_size(frame.mask, mask, frame.image, read_picture(frame.image))
    if deep is None:
        return mask, None
    depth = read_depth(deep, data.cloud.depth_unit)
    if mask is not None:
        _check_size(deep, depth, frame.mask or frame.image, mask)
    if pictured:
        _check_size(deep, depth, frame.image, read_picture(frame.image))
    return mask, np.where(np.isfinite(depth) & (True if mask is None else mask), depth, 0.0).astype(
        np.float32
    )


def _tracked(path: Path, name: str, frames: Sequence[int], data: PictureData) -> FloatArray:
    """Returns the pixels (F, M, 2) of the tracked points of a pose in frames by their numbers."""
    tracked = read_tracked(path, [*data.points], data.likelihood, frames)
    if not np.isfinite(tracked).any():
        raise DataFileError(
            f"{path}: no point was seen in the frames of data.poses.{name}: leave it out."
        )
    return tracked


def _check_size(path: Path, one: NDArray[Any], picture: Path, other: NDArray[Any]) -> None:
    if one.shape[:2] != other.shape[:2]:
        (height, width), (rows, columns) = one.shape[:2], other.shape[:2]
        raise DataFileError(
            f"{path} has {width} x {height} pixels, and {picture.name} {columns} x {rows}: bring "
            "both to one size, depths registered to their picture."
        )


def _cameras(path: Path, frames: Sequence[Frame], data: PictureData) -> FloatArray:
    """(F, 2, 4, 4) the given cameras of frames, or the two that a tag in each allows.

    Refused if a standing one sees the origin of the mesh at different places.
    """
    if data.tag is None:
        missing = [frame.image.name for frame in frames if frame.pose is None]
        if missing:
            raise DataFileError(
                f"{path}: {missing[0]} has no 'world_to_camera': give it, or the tag of data.tag."
            )
        poses = [[frame.pose] for frame in frames if frame.pose is not None]
    else:
        tag, lenses = data.tag, read_lenses(data)
        poses = [tag_poses(tag, read_picture(frame.image), lenses[frame.lens]) for frame in frames]
        hidden = [frame.image for frame, pair in zip(frames, poses, strict=True) if not pair]
        if hidden:
            raise DataFileError(
                f"{hidden[0]} does not show the tag {tag.number} of {tag.dictionary}: check "
                "data.tag, leave the frame out, or give its world_to_camera."
            )
    cameras = np.array([[pair[0], pair[-1]] for pair in poses]).reshape(-1, 2, 4, 4)
    places = cameras[:, 0, :3, 3]
    first = {frame.lens: place for frame, place in reversed([*zip(frames, places, strict=True)])}
    moved = [
        float(np.linalg.norm(place - first[f.lens]))
        for f, place in zip(frames, places, strict=True)
    ]
    if data.stands and max(moved, default=0.0) > _MOVED:
        raise DataFileError(
            f"{path}: between its frames the camera moves by {100.0 * max(moved):.0f} cm against "
            "the origin of the mesh: set data.stands=false if it does, or name several in "
            "data.lens; world_to_camera is in m."
        )
    return cameras


class SeenPoses:
    """The poses of a run.

    Args:
        settings: of the run's stage.
        run_dir: its folder, with pictures.h5.

    Raises:
        DataFileError: a file is missing or damaged.
        InputError: values that do not fit.
    """

    def __init__(self, settings: StageSettings, run_dir: Path) -> None:
        self.settings = settings
        self.data = settings.data
        self.run_dir = run_dir
        self.lenses, self._poses = read_lenses(self.data), dict[str, SeenPose]()
        # Arrays of each pose in pictures.h5, by name.
        self._loaded: dict[str, dict[str, NDArray[Any]]] = {}
        with read_hdf5(run_dir / PICTURES, _KIND) as file:
            for name in self.data.poses:
                keys = list[str]()
                file[name].visititems(
                    lambda key, item, keys=keys: (
                        keys.append(key) if hasattr(item, "shape") else None
                    )
                )
                self._loaded[name] = {key: read_array(file[name], key) for key in keys}

    def picture(self, name: str, number: int) -> NDArray[np.uint8]:
        """Returns a picture (H, W, 3) of a pose, by its number among those that are used.

        Raises:
            DataFileError: it is missing.
        """
        return read_picture(self._frames(name)[number].image)

    def _frames(self, name: str) -> list[Frame]:
        """The frames of a pose that are used."""
        used = self._loaded[name]["frames"]
        return [
            f
            for f in scene_of(self.data, self.data.poses[name], self.run_dir).frames
            if f.number in used
        ]

    def cameras_of(self, name: str, lens: str) -> list[torch.Tensor]:
        """Returns the different cameras (4, 4) of a pose's frames by a lens,
        from which a standing one is chosen.
        """
        different, mine = list[torch.Tensor](), [frame.lens == lens for frame in self._frames(name)]
        for camera in torch.as_tensor(
            self._loaded[name]["world_to_camera"][mine].reshape(-1, 4, 4)
        ):
            if all((camera - other).abs().max() > _ALIKE for other in different):
                different.append(camera)
        return different

    def material(self, name: str) -> MaterialSettings:
        """Returns the material of a pose, as configured."""
        parameters = self.data.materials.get(self.data.poses[name].material or "", {})
        common = self.settings.simulation
        return common.changed(**{**common.values, **parameters})

    def pose(self, name: str) -> SeenPose:
        """Returns a pose by its name, with a camera for each frame.

        Of a tag, the one that fits better.
        """
        if name in self._poses:
            return self._poses[name]
        settings = self.settings
        wanted = self.data.poses[name]
        loaded = self._loaded[name]
        mesh, clamps = self._mesh(name)
        fixed = np.unique(np.concatenate(clamps))
        material = self.material(name)
        if wanted.gravity is not None:
            settings = settings.model_copy(update={"gravity": wanted.gravity})
        simulator = build_simulator(
            settings, material, Body(mesh, fixed=fixed, **dict(settings.physics))
        )
        points = None
        if wanted.points is not None:
            points = bind_markers(mesh, [*self.data.points.values()], [*self.data.points])
        centre = torch.as_tensor(mesh.vertices[fixed].mean(0))
        scene = scene_of(self.data, wanted, self.run_dir)
        photos = list[Photo]()
        surface = ClosedSurface.of(mesh)
        for number, frame in enumerate(self._frames(name)):
            camera = PlacedCamera(
                self.lenses[frame.lens],
                torch.as_tensor(loaded["world_to_camera"][number, 0]),
                centre,
            )
            outline = Outline.of_mask(loaded[f"masks/{frame.number}"]) if wanted.outline else None
            tracked = loaded["tracked"][number] if "tracked" in loaded else None
            cloud, depth = None, loaded.get(f"depths/{frame.number}")
            if depth is not None:
                cloud = self._cloud(frame.files[0], Cloud.of_depth(depth), camera, mesh, fixed)
            row_time = self.data.lenses[frame.lens].row_time
            title, time = f"{wanted.folder}/{frame.image.name}", frame.time or 0.0
            photos.append(Photo(title, camera, outline, tracked, cloud, frame.lens, time, row_time))
        scan = loaded.get("scan")
        if scan is not None:
            camera = PlacedCamera(None, torch.as_tensor(scene.scan_pose), centre)
            outside = scan + loaded["scan_normals"] if "scan_normals" in loaded else None
            cloud = self._cloud(
                scene.path.parent / str(wanted.cloud), Cloud(scan, outside), camera, mesh, fixed
            )
            photos.append(Photo(f"{wanted.folder}/{wanted.cloud}", camera, cloud=cloud))
        release, material_name = released_force(name, wanted, mesh), wanted.material or ""
        pose = SeenPose(
            name, simulator, surface, clamps, tuple(photos), material_name, points, release=release
        )
        self._poses[name] = pose
        return pose

    def _cloud(
        self, path: Path, cloud: Cloud, camera: PlacedCamera, mesh: Mesh, clamped: IntArray
    ) -> Cloud:
        """The points that may be of a body, as many as configured."""
        wanted = self.data.cloud
        cloud = replace(cloud, noise=wanted.noise, reach=wanted.reach)
        with naming(f"{path}: "):
            return cloud.around(camera, mesh, clamped, wanted.points, self.settings.seed)

    def _mesh(self, name: str) -> tuple[Mesh, tuple[IntArray, ...]]:
        """Mesh of a pose, and the vertices in its clamps."""
        pose = self.data.poses[name]
        scene = scene_of(self.data, pose, self.run_dir)
        if pose.mesh is None:
            mesh = build_mesh(self.settings.mesh)
        else:
            mesh = read_mesh(scene.path.parent / pose.mesh, self.data.units)
        corners = len(mesh.vertices)
        wrong = [clamp for clamp in scene.clamps if clamp.min() < 0 or clamp.max() >= corners]
        if wrong:
            raise DataFileError(
                f"{scene.path}: 'fixed' has vertices from {wrong[0].min()} to {wrong[0].max()}, "
                f"but the mesh has those from 0 to {corners - 1}."
            )
        if pose.mesh is not None and self.data.order == 2:
            mesh = quadratic(mesh)
        clamps = tuple(_with_midpoints(mesh, clamp) for clamp in scene.clamps)
        if clamps:
            return mesh, clamps
        if self.settings.fixed is None:
            raise InputError(f"{scene.path} has no clamps, and fixed is null: give one of them.")
        return mesh, (vertices_at(mesh, self.settings.fixed),)


def _with_midpoints(mesh: Mesh, corners: IntArray) -> IntArray:
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
        name: Lens(torch.tensor(one.matrix, dtype=torch.float64))
        if one.file is None
        else Lens.read(folder / one.file)
        for name, one in data.lenses.items()
    }
