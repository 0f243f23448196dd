"""Pictures of a body that is released: rows at their own times,
derivatives, and the parameters that come back.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.refusals import refuses
from support.slopes import differences
from warp_resphys.pictures import (
    ClosedSurface,
    Cloud,
    Lens,
    Outline,
    Photo,
    PictureMisfit,
    PlacedCamera,
    SeenPose,
)
from warp_resphys.pictures.camera_laboratory import noisy_mask
from warp_resphys.pictures.released_force import ReleasedForce, at_row_times
from warp_resphys.settings.learning import Bounds, Prior

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(4, 1, 1), nodes=20)
LENS = Lens(
    torch.tensor([[700.0, 0.0, 160.0], [0.0, 700.0, 120.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
)
LOOKS = torch.tensor(  # from the side: x right, z up
    [[1.0, 0.0, 0.0, -0.05], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
CLAMP, TIP = (wr.select_vertices(MESH, x=x) for x in (0.0, 0.1))
CAMERA = PlacedCamera(LENS, LOOKS, torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64))
POINTS = wr.bind_markers(
    MESH, [[0.1, 0.0, 0.01], [0.06, 0.0, 0.01], [0.08, 0.0, 0.02]], ["a", "b", "c"]
)
SIZE = (240, 320)
ROW_TIME, RATE = 6e-5, 60.0  # s, Hz: the rows take 14 ms
RANGES = {
    "youngs_modulus": Bounds(lower=3e4, upper=1e6, logarithmic=True),
    "density": Bounds(lower=500.0, upper=2000.0),
    "stiffness_damping": Bounds(lower=0.0, upper=0.02),
    "release_delay": Bounds(lower=-0.03, upper=0.03, prior=Prior(mean=0.0, deviation=0.01)),
    "release_force_3": Bounds(lower=-0.1, upper=0.1, prior=Prior(mean=0.0, deviation=0.01)),
    "camera_shift_3": Bounds(lower=-0.02, upper=0.02, prior=Prior(mean=0.0, deviation=0.01)),
}
TRUTH = {
    "youngs_modulus": 1.2e5,
    "density": 1100.0,
    "stiffness_damping": 4e-3,
    "release_delay": 0.004,
    "release_force_3": 0.01,
    "camera_shift_3": 0.003,
}
FIRST = {
    **TRUTH,
    "youngs_modulus": 1.5e5,
    "density": 1000.0,
    "stiffness_damping": 2e-3,
    "release_delay": 0.0,
}


def released(frames=18, row_time=ROW_TIME, outlines=False):
    """A beam that is released at 0.05 s, with tracked points
    and perhaps outlines in every picture.
    """
    body = wr.Body(MESH, fixed=CLAMP)
    simulator = wr.Simulator(
        body,
        wr.Corotated(2e5, 0.45),
        time_step=1.0 / 240.0,
        gravity=(0.0, 0.0, -9.81),
        integrator="bdf2",
    )
    surface = ClosedSurface.of(MESH)
    photos = tuple(Photo(f"{n}", CAMERA, time=n / RATE, row_time=row_time) for n in range(frames))
    force = ReleasedForce(TIP, (0.0, 0.0, 0.1), 0.05)
    pose = SeenPose("beam", simulator, surface, (CLAMP,), photos, points=POINTS, release=force)
    shape, corrections, measured = pose.shape(TRUTH), PlacedCamera.corrections(TRUTH), []
    for photo in photos:
        q = pose.vertices(photo, shape, TRUTH)
        outline, pixels = None, CAMERA.pixels(POINTS(q[None])[0], corrections).numpy()
        if outlines:
            region = surface.region(CAMERA.pixels(q, corrections).numpy())
            outline = Outline.of_mask(noisy_mask(region, SIZE[::-1], 0.0, np.random.default_rng(0)))
        measured.append(replace(photo, tracked=pixels, outline=outline))
    return replace(pose, photos=tuple(measured))


@pytest.fixture(scope="module")
def seen():
    return released()


def test_rows_are_exposed_at_their_own_times():
    """Points that fall, z = z0 + v t + a t^2 / 2, in closed form:
    a row is the root of a quadratic equation.
    """
    step, begin, scale = 0.01, 0.083, 700.0 / 0.3
    heights, speeds, fall = np.array([0.0, 0.02, -0.01]), np.array([0.3, -0.5, 0.1]), -9.81
    s = step * np.arange(30)[:, None]
    z = heights + speeds * s + 0.5 * fall * s**2
    series = torch.as_tensor(np.stack([np.tile([0.01, 0.05, 0.09], (30, 1)), 0.0 * z, z], 2))[None]
    neutral = PlacedCamera.corrections({})

    def pixels(points):
        return CAMERA.pixels(points, neutral)

    places, velocities = at_row_times(series, begin, ROW_TIME, step, pixels)
    rows = pixels(places[0])[:, 1].numpy()
    r = ROW_TIME
    for row, velocity, z0, v in zip(rows, velocities.numpy(), heights, speeds, strict=True):
        at_begin = z0 + v * begin + 0.5 * fall * begin**2
        equation = (
            -0.5 * scale * fall * r**2,
            -scale * (v + fall * begin) * r - 1.0,
            120.0 - scale * at_begin,
        )
        exact = min(np.roots(equation), key=lambda root: abs(root - row))
        assert row == pytest.approx(exact, abs=1e-4)
        assert velocity == pytest.approx([0.0, 0.0, v + fall * (begin + r * exact)], abs=1e-6)
    at_once = pixels(at_row_times(series, begin, 0.0, step, pixels)[0][0])[:, 1].numpy()
    assert (np.abs(at_once - rows) > 3.0).all()
    resting, still = at_row_times(series, -0.05, ROW_TIME, step, pixels)  # before the release
    assert torch.equal(resting[0], series[0, 0])
    assert not still.any()


def with_depths(pose):
    """The pose seen by a depth camera alone: points of its side, 2 mm before it."""
    shape, corrections, photos = pose.shape(TRUTH), PlacedCamera.corrections(TRUTH), []
    side = np.flatnonzero((MESH.vertices[:, 1] == 0.0) & (MESH.vertices[:, 0] > 0.03))
    for photo in pose.photos:
        q = pose.vertices(photo, shape, TRUTH)[side]
        deep = CAMERA.seen_from(q, corrections)[:, 2:] - 0.002
        measured = torch.cat([CAMERA.pixels(q, corrections), deep], 1).numpy()
        photos.append(
            replace(photo, tracked=None, cloud=Cloud(measured, measured * (1.0, 1.0, 0.0)))
        )
    return replace(pose, photos=tuple(photos))


@pytest.mark.parametrize(
    ("kind", "tolerance"), [("points", 3e-3), ("outlines", 0.05), ("depths", 0.05)]
)
def test_derivatives_are_those_of_differences(kind, tolerance):
    """By physical parameters, release and camera, where rows have times of their own."""
    own = released(6, outlines=kind == "outlines")
    if kind == "outlines":
        own = replace(own, photos=tuple(replace(photo, tracked=None) for photo in own.photos))
    if kind == "depths":
        own = with_depths(own)
    misfit = PictureMisfit([own], RANGES)
    unit = misfit.to_unit({**FIRST, "camera_shift_3": 0.001})
    gradient = np.array(
        differences(lambda x: misfit.linearise(x, derivatives=False).loss, unit, 1e-3)
    )
    assert misfit.linearise(unit).gradient == pytest.approx(
        gradient, rel=tolerance, abs=tolerance * gradient.max()
    )


def test_what_cannot_be_released_is_named(seen):
    refuses(
        wr.InputError,
        "no vertex carries the force",
        ReleasedForce,
        np.array([], dtype=int),
        (0.0, 0.0, 1.0),
    )
    refuses(
        wr.InputError, "give three numbers and a time", ReleasedForce, TIP, (0.0, 0.0, math.nan)
    )
    scan = Photo("scan", PlacedCamera(None, LOOKS, CAMERA.centre))
    refuses(wr.InputError, "beam moves, and a scan shows no time", replace, seen, photos=(scan,))
    with pytest.raises(wr.InputError, match="no parameter 'clamp_turn' to identify"):
        PictureMisfit([seen], {"clamp_turn": Bounds(lower=0.0, upper=1.0)})
