"""Pictures of a body that is released: rows at their own times, derivatives, and the parameters that come back."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch

import warp_resphys as wr
from warp_resphys.data.camera import Lens
from warp_resphys.io.errors import InputError
from warp_resphys.learning.bounds import Bounds, Prior
from warp_resphys.learning.identification import ParameterSearch
from warp_resphys.pictures.camera import PlacedCamera
from warp_resphys.pictures.misfit import PictureMisfit
from warp_resphys.pictures.motion import ReleasedForce, at_own_times
from warp_resphys.pictures.outlines import ClosedSurface, Outline
from warp_resphys.pictures.seen import Photo, SeenPose

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(4, 1, 1), nodes=20)
LENS = Lens(torch.tensor([[700.0, 0.0, 160.0], [0.0, 700.0, 120.0], [0.0, 0.0, 1.0]], dtype=torch.float64))
LOOKS = torch.tensor(  # from the side: x right, z up
    [[1.0, 0.0, 0.0, -0.05], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64
)
CLAMP, TIP = (wr.select_vertices(MESH, x=x) for x in (0.0, 0.1))
CAMERA = PlacedCamera(LENS, LOOKS, torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64))
POINTS = wr.bind_markers(MESH, [[0.1, 0.0, 0.01], [0.06, 0.0, 0.01], [0.08, 0.0, 0.02]], ["a", "b", "c"])
SIZE = (240, 320)
ROW_TIME, RATE = 6e-5, 60.0  # s, Hz: the rows take 14 ms
RANGES = {
    "youngs_modulus": Bounds(3e4, 1e6, True),
    "density": Bounds(500.0, 2000.0),
    "stiffness_damping": Bounds(0.0, 0.02),
    "release_delay": Bounds(-0.03, 0.03, prior=Prior(0.0, 0.01)),
    "release_force_3": Bounds(-0.1, 0.1, prior=Prior(0.0, 0.01)),
    "camera_shift_3": Bounds(-0.02, 0.02, prior=Prior(0.0, 0.01)),
}
TRUTH = {
    "youngs_modulus": 1.2e5,
    "density": 1100.0,
    "stiffness_damping": 4e-3,
    "release_delay": 0.004,
    "release_force_3": 0.01,
    "camera_shift_3": 0.003,
}
FIRST = {**TRUTH, "youngs_modulus": 1.5e5, "density": 1000.0, "stiffness_damping": 2e-3, "release_delay": 0.0}


def released(frames=24, row_time=ROW_TIME, outlines=False):
    """A beam that is let go at 0.05 s, with tracked points and perhaps outlines in every picture."""
    body = wr.Body(MESH, fixed=CLAMP)
    simulator = wr.Simulator(
        body, wr.Corotated(2e5, 0.45), time_step=1.0 / 240.0, gravity=(0.0, 0.0, -9.81), integrator="bdf2"
    )
    surface = ClosedSurface.of_mesh(MESH)
    photos = tuple(Photo(f"{n}", CAMERA, time=n / RATE, row_time=row_time) for n in range(frames))
    force = ReleasedForce(TIP, (0.0, 0.0, 0.1), 0.05)
    pose = SeenPose("beam", simulator, surface, (CLAMP,), photos, points=POINTS, release=force)
    shape, corrections, measured = pose.shape(TRUTH), PlacedCamera.corrections(TRUTH), []
    for photo in photos:
        q = pose.vertices(photo, shape, TRUTH)
        outline, pixels = None, CAMERA.pixels(POINTS(q[None])[0], corrections).numpy()
        if outlines:
            region = surface.region(CAMERA.pixels(q, corrections).numpy())
            rows, columns = np.indices(SIZE)
            inside = shapely.contains_xy(region, columns.ravel(), rows.ravel()).reshape(SIZE)
            outline = Outline.of_mask(np.asarray(inside))
        measured.append(replace(photo, tracked=pixels, outline=outline))
    return replace(pose, photos=tuple(measured))


@pytest.fixture(scope="module")
def seen():
    return released()
