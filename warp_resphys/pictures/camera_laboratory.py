"""A simulated laboratory of pictures of a body of another material, before a camera elsewhere."""

from itertools import product

import numpy as np
import scipy.ndimage
import shapely
import torch
from PIL import Image

from ..data.camera import PlacedCamera, view_axes
from ..data.markers import bind_markers
from ..experiment.build import build_body, build_simulator
from ..io.arrays import BoolArray, FloatArray
from ..io.atomic import atomic_path
from ..io.resuming import StageContext
from ..io.safe_files import write_json
from ..settings.pictures import PictureData, PoseSettings, SimulatedCamera
from ..settings.stage_keys import StageSettings
from .outlines import ClosedSurface
from .seen import Photo, SeenPose
from .seen_poses import read_lenses, released_force, scene_file

_BODY, _BEHIND = (46, 96, 140), (24, 24, 26)  # red, green and blue of the pictures
_THIN = 1e-9  # px^2, of a triangle that is seen from the side
_CORRELATED = 2.0  # px, along an outline, of its noise


def frame_files(data: PictureData, pose: PoseSettings) -> list[dict[str, str]]:
    """Returns the files of every frame of a simulated pose, by their keys in camera.json."""
    assert data.simulated is not None
    keys = ["mask", *["depth"] * (data.simulated.depth is not None)]
    numbers = range(1 if pose.release is None else data.simulated.frames)
    return [
        {"image": f"{n:02d}.png", **{key: f"{n:02d}_{key}.png" for key in keys}} for n in numbers
    ]


def play_camera(context: StageContext) -> None:
    """Writes camera.json and of every frame of every pose a picture,
    a mask, and perhaps depths and tracked points.
    """
    settings: StageSettings = context.settings
    data, played = settings.data, settings.data.simulated
    assert played is not None
    material = settings.simulation.changed(**{**settings.simulation.values, **played.material})
    body = build_body(settings)
    surface = ClosedSurface.of(body.mesh)
    centre = torch.as_tensor(body.mesh.vertices[body.fixed_vertices].mean(0))
    corrections = PlacedCamera.corrections(played.corrections)
    for number, (name, pose) in enumerate(data.poses.items()):
        gravity = settings.gravity if pose.gravity is None else pose.gravity
        changed = {"gravity": gravity, "time_step": settings.time_step / played.substeps}
        simulator = build_simulator(settings.model_copy(update=changed), material, body)
        looking, files = looks(played, gravity), frame_files(data, pose)
        camera = PlacedCamera(read_lenses(data)[""], torch.as_tensor(looking), centre)
        row_time = data.lenses[""].row_time if played.row_time is None else played.row_time
        times = [n / played.frame_rate for n in range(len(files))]
        photos = tuple(
            Photo("", camera, time=time, row_time=row_time, rows=played.size[1]) for time in times
        )
        seen = SeenPose(
            name, simulator, surface, (), photos, release=released_force(name, pose, body.mesh)
        )
        shape = seen.shape(played.corrections)
        random = np.random.default_rng([settings.seed, number])
        path = scene_file(data, pose, context.run_dir)
        tracks = list[FloatArray]()
        frames = list[dict[str, object]]()
        for photo, names in zip(photos, files, strict=True):
            q = seen.vertices(photo, shape, played.corrections)
            pixels = camera.pixels(q, corrections).numpy()
            mask = noisy_mask(surface.region(pixels), played.size, played.noise, random)
            drawings = {
                "image": np.where(mask[..., None], _BODY, _BEHIND).astype(np.uint8),
                "mask": mask,
            }
            if played.depth is not None:
                deep = camera.seen_from(q, corrections)[:, 2].numpy()
                depth = depth_image(pixels[surface.triangles], deep[surface.triangles], played.size)
                noisy = np.where(
                    depth > 0.0, depth + played.depth * random.normal(size=depth.shape), 0.0
                )
                drawings["depth"] = np.rint(noisy / data.cloud.depth_unit).astype(np.uint16)
            for key, drawn in drawings.items():
                with atomic_path(path.parent / names[key]) as partial:
                    Image.fromarray(drawn).save(partial, format="png")
            frames.append({**names, "time": photo.time, "world_to_camera": looking.tolist()})
            if pose.points is not None:
                places = bind_markers(body.mesh, [*data.points.values()], [*data.points])(q[None])
                places = places[0]
                there = camera.pixels(places, corrections).numpy()
                tracks.append(there + played.noise * random.normal(size=there.shape))
        if pose.points is not None:
            heads = ["frame", *(f"{name}.{axis}" for name, axis in product(data.points, "xy"))]
            table = np.column_stack([np.arange(len(tracks)), np.reshape(tracks, (len(tracks), -1))])
            with atomic_path(path.parent / pose.points) as partial:
                np.savetxt(partial, table, "%.10g", ",", header=",".join(heads), comments="")
        write_json(path, {"name": name, "frames": frames})


def looks(played: SimulatedCamera, gravity: tuple[float, float, float]) -> FloatArray:
    """Returns world_to_camera (4, 4) of an upright camera at a place that looks at a point."""
    place = np.array(played.place)
    axes = view_axes(place - played.looks_at, -np.array(gravity)) * [[1.0], [-1.0], [-1.0]]
    return np.block([[axes, -(axes @ place)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def depth_image(corners: FloatArray, depths: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Returns the depth (H, W) of the foremost triangle at every pixel,
    zero where there is none [m].

    Args:
        corners: (F, 3, 2) pixels of triangles.
        depths: (F, 3) of their corners, of which the inverses are linear in the picture [m].
        size: width and height of the picture.
    """
    closeness = np.zeros((size[1], size[0]))  # 1/m
    for triangle, inverse in zip(corners, 1.0 / depths, strict=True):
        low = np.maximum(np.ceil(triangle.min(0)), 0).astype(int)
        high = np.minimum(np.floor(triangle.max(0)), np.array(size) - 1).astype(int)
        columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        edges = np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0]], 1)
        if not columns.size or abs(np.linalg.det(edges)) < _THIN:
            continue
        share = np.linalg.solve(
            edges, np.stack([columns.ravel(), rows.ravel()]) - triangle[0][:, None]
        )
        inside = ((share >= 0.0).all(0) & (share.sum(0) <= 1.0)).reshape(rows.shape)
        at = (inverse[0] + (inverse[1:] - inverse[0]) @ share).reshape(rows.shape)
        part = closeness[low[1] : high[1] + 1, low[0] : high[0] + 1]
        part[inside] = np.maximum(part, at)[inside]
    return np.divide(1.0, closeness, out=np.zeros_like(closeness), where=closeness > 0.0)


def noisy_mask(
    region: shapely.Geometry, size: tuple[int, int], noise: float, random: np.random.Generator
) -> BoolArray:
    """Returns a mask (H, W) of a region [px] whose border is moved across itself
    by correlated noise [px].
    """
    area = shapely.Polygon()
    for part in shapely.get_parts(region):
        holes = [hole for hole in part.interiors if shapely.polygons(hole).area > 1.0]
        outer, *inner = (
            shapely.make_valid(shapely.polygons(_moved(ring, noise, random)))
            for ring in (part.exterior, *holes)
        )
        area = shapely.union(area, shapely.difference(outer, shapely.union_all(inner)))
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    inside = shapely.contains_xy(area, columns.ravel(), rows.ravel())
    return np.asarray(inside).reshape(size[1], size[0])


def _moved(ring: shapely.LinearRing, noise: float, random: np.random.Generator) -> FloatArray:
    """A closed line (P, 2) with points a pixel apart, moved by noise."""
    count = max(int(ring.length), 8)
    points = shapely.get_coordinates(
        shapely.line_interpolate_point(ring, np.arange(count) * ring.length / count)
    )
    along = np.roll(points, -1, 0) - np.roll(points, 1, 0)
    across = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(
        np.linalg.norm(along, axis=1, keepdims=True), 1e-9
    )
    smooth = scipy.ndimage.gaussian_filter1d(random.normal(size=count), _CORRELATED, mode="wrap")
    moved = points + noise * (smooth / max(float(smooth.std()), 1e-12))[:, None] * across
    return np.concatenate([moved, moved[:1]])
