"""Points without identity: distances from bodies, derivatives,
outliers, a scan of unknown pose, and two lenses.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

import warp_resphys as wr
from support.slopes import differences
from warp_resphys.core.mesh.surface import closest_of
from warp_resphys.data.camera import PLACES, Lens, PlacedCamera
from warp_resphys.pictures import ClosedSurface, Cloud, Photo, PictureMisfit, SeenPose
from warp_resphys.pictures.camera_laboratory import depth_image
from warp_resphys.settings.learning import Bounds, Prior

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1), nodes=20)
CLAMP = wr.select_vertices(MESH, x=0.0)
SURFACE = ClosedSurface.of(MESH)
REST = torch.as_tensor(MESH.vertices)
CENTRE = MESH.vertices[CLAMP].mean(0)
SCANNER = PlacedCamera(None, torch.eye(4), CENTRE)
LENS = Lens(
    torch.tensor([[700.0, 0.0, 160.0], [0.0, 700.0, 120.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
)
ABOVE = torch.tensor(  # looks down: x right, y towards the viewer
    [[1.0, 0.0, 0.0, -0.05], [0.0, -1.0, 0.0, 0.01], [0.0, 0.0, -1.0, 0.3], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
CAMERA = PlacedCamera(LENS, ABOVE, CENTRE)
PLAIN = PlacedCamera.corrections({})
MODULUS = {"youngs_modulus": Bounds(lower=3e4, upper=1e6, logarithmic=True)}
TRUTH = {"youngs_modulus": 1.2e5}


def bounds_of(*names, prior=None):
    """Ranges of shifts and turns."""
    return {
        name: Bounds(lower=-0.06, upper=0.06)
        if "shift" in name
        else Bounds(lower=-0.5, upper=0.5, prior=prior)
        for name in names
    }


@pytest.fixture(scope="module")
def beam():
    """A hanging beam without a picture of it, and its vertices with the true modulus."""
    simulator = wr.Simulator(
        wr.Body(MESH, fixed=CLAMP), wr.Corotated(2e5, 0.45), gravity=(0.0, 0.0, -9.81)
    )
    pose = SeenPose("beam", simulator, SURFACE, (CLAMP,), (Photo("0", SCANNER),))
    return pose, pose.shape(TRUTH)


def scan(q, noise, count=1000, seed=0):
    """Points on the whole surface of a body, with noise."""
    points, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(q, SURFACE.triangles, process=False), count, seed=seed
    )
    return points + noise * np.random.default_rng(seed).normal(size=points.shape)


def depths(q, camera=CAMERA, noise=0.0, corrections=PLAIN):
    """A depth image of a body."""
    pixels = camera.pixels(q, corrections).numpy()
    deep = camera.seen_from(q, corrections)[:, 2].numpy()
    image = depth_image(pixels[SURFACE.triangles], deep[SURFACE.triangles], (320, 240))
    return np.where(
        image > 0.0, image + noise * np.random.default_rng(1).normal(size=image.shape), 0.0
    )


def with_cloud(pose, cloud, camera=SCANNER, count=1000):
    photo = Photo("scan", camera, cloud=cloud.around(camera, MESH, CLAMP, count))
    return replace(pose, photos=(photo,))


def test_a_depth_image_has_the_depths_of_a_box():
    """The upper face is 0.28 m below the camera, and fills the pixels that a pinhole sees it at."""
    image = depths(REST)
    rows, columns = np.nonzero(image)
    assert image[rows, columns] == pytest.approx(0.28, abs=1e-12)
    # Whole numbers, so that the pixels of the border may be seen or not.
    half = np.array([0.05, 0.01]) * 700.0 / 0.28
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    assert low == pytest.approx((160.0, 120.0) - half, abs=1.01)
    assert high == pytest.approx((160.0, 120.0) + half, abs=1.01)
    # The box turned about its own centre, before the camera.
    around = torch.eye(4, dtype=torch.float64)
    around[:3, :3] = torch.as_tensor(Rotation.from_euler("xy", (0.4, 0.5)).as_matrix())
    around[:3, 3] = REST.mean(0) - around[:3, :3] @ REST.mean(0)
    oblique = PlacedCamera(LENS, ABOVE @ around, CENTRE)
    cloud = Cloud.of_depth(depths(REST, oblique))
    assert len(cloud.measured) > 1000
    places = oblique.located(torch.as_tensor(cloud.measured), PLAIN).numpy()
    outside = np.maximum(np.maximum(-places, places - (0.1, 0.02, 0.02)), 0.0)
    assert np.linalg.norm(outside, axis=1).max() < 1e-9
    assert np.minimum(places, (0.1, 0.02, 0.02) - places).min(1).max() < 1e-9


def test_only_the_visible_side_is_compared():
    """Points below the middle of the box are closer to its lower face,
    which the camera does not see.
    """
    places = np.array([[0.05, 0.01, 0.004], [0.07, 0.012, 0.024]])
    pixels = CAMERA.pixels(torch.as_tensor(places), PLAIN).numpy()
    measured = np.column_stack([pixels, 0.3 - places[:, 2]])
    seen = Cloud(measured, measured * (1.0, 1.0, 0.0)).distances(
        CAMERA, PLAIN, SURFACE.triangles, REST
    )
    assert seen.places == pytest.approx(places, abs=1e-12)
    assert seen.distances == pytest.approx([-0.016, 0.004], abs=1e-12)
    assert seen.directions == pytest.approx(np.array([[0.0, 0.0, 1.0]] * 2), abs=1e-9)
    blind = Cloud(measured).distances(CAMERA, PLAIN, SURFACE.triangles, REST)
    assert blind.distances == pytest.approx([-0.004, 0.004], abs=1e-12)
    shares = (MESH.vertices[seen.triangles] * seen.shares[..., None]).sum(1)
    assert shares == pytest.approx(places * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.02), abs=1e-12)


def test_closest_points_do_not_depend_on_how_many_triangles_are_tried():
    """Long triangles beside short ones, of which the closest has a far centre.

    Against all triangles, one by one.
    """
    body = trimesh.creation.box((1.0, 0.02, 0.02))
    body = trimesh.util.concatenate(
        [body, trimesh.creation.icosphere(3, 0.05).apply_translation((0.4, 0.0, 0.2))]
    )
    points = np.random.default_rng(0).uniform((-0.6, -0.1, -0.1), (0.6, 0.1, 0.3), (60, 3))
    corners = body.vertices[body.faces]
    towards = np.random.default_rng(1).normal(size=points.shape)
    for directions in (None, towards):
        result = closest_of(np.asarray(body.faces), np.asarray(body.vertices), points, directions)
        for number, (point, distance) in enumerate(zip(points, result.distances, strict=True)):
            faces = (
                corners
                if directions is None
                else corners[body.face_normals @ directions[number] > 0.0]
            )
            every = trimesh.triangles.closest_point(faces, np.broadcast_to(point, (len(faces), 3)))
            assert abs(distance) == pytest.approx(
                np.linalg.norm(every - point, axis=1).min(), abs=1e-12
            )


@pytest.mark.parametrize("kind", ["scan", "depth"])
def test_derivatives_of_clouds_are_those_of_differences(beam, kind):
    """Derivatives of all residuals, but of a few points
    whose closest triangle is another one a moment later.
    """
    pose, q = beam
    if kind == "scan":
        own = with_cloud(pose, Cloud(scan(q, 1e-3)), count=300)
        names = PLACES
    else:
        own = with_cloud(pose, Cloud.of_depth(depths(q, noise=1e-3)), CAMERA, count=300)
        names = (*PLACES, "focal_factor", "principal_point_1", "principal_point_2")
    ranges = {**MODULUS, **bounds_of(*PLACES)}
    for name in names[len(PLACES) :]:
        ranges[name] = (
            Bounds(lower=0.9, upper=1.1)
            if name == "focal_factor"
            else Bounds(lower=-20.0, upper=20.0)
        )
    values = {**dict.fromkeys(ranges, 0.003), "youngs_modulus": 1.4e5}
    misfit = PictureMisfit([own], ranges)
    unit = misfit.to_unit(values | ({"focal_factor": 1.01} if kind == "depth" else {}))
    jacobian = misfit.linearise(unit).trials[0].slopes
    slopes = differences(
        lambda x: misfit.linearise(x, derivatives=False).trials[0].rows[:, 0], unit, 1e-5
    )
    for column, numeric in enumerate(slopes):
        away = np.abs(jacobian[:, column] - numeric) / np.abs(numeric).max()
        # That of the modulus is a one-sided difference of equilibria.
        assert np.quantile(away, 0.97) < 2e-3


def test_a_turned_scan_with_outliers(beam):
    """Modulus, place and turn of a scan whose axes are 15 degrees and 3 cm away,
    with a millimetre of noise.
    """
    (pose, q), outliers = beam, 0.1
    random = np.random.default_rng(3)
    points = scan(q, 1e-3, 2000)
    wrong = random.random(len(points)) < outliers
    low, high = q.numpy().min(0) - 0.03, q.numpy().max(0) + 0.03
    points[wrong] = random.uniform(low, high, (int(wrong.sum()), 3))
    turn = Rotation.from_rotvec((0.1, -0.2, 0.15))
    shift = np.array([0.01, -0.02, 0.015])
    own = with_cloud(pose, Cloud(turn.apply(points) + shift))
    ranges = {**MODULUS, **bounds_of(*PLACES, prior=Prior(mean=0.0, deviation=0.1))}
    first = {**dict.fromkeys(ranges, 0.0), "youngs_modulus": 3e5}
    result = wr.learning.search_parameters(PictureMisfit([own], ranges), [first], 40)
    deviation = result.uncertainty.deviation["youngs_modulus"]
    assert deviation < 0.15 * TRUTH["youngs_modulus"]
    assert abs(result.parameters["youngs_modulus"] - TRUTH["youngs_modulus"]) < 3.0 * deviation
    turned = Rotation.from_rotvec([result.parameters[name] for name in PLACES[3:]])
    assert (turned * turn.inv()).magnitude() < 0.05
    at_clamp = [result.parameters[name] for name in PLACES[:3]]
    assert at_clamp == pytest.approx(turn.apply(CENTRE) + shift - CENTRE, abs=2e-3)
    assert (
        own.difference(own.photos[0], own.shape(result.parameters), result.parameters)["cloud_mm"]
        < 1.0
    )
    undeformed = replace(own, deforms=False)
    assert undeformed.difference(own.photos[0], REST, result.parameters)["cloud_mm"] > 4.0


def test_background_and_isolated_points_are_left_out():
    random = np.random.default_rng(0)
    body = scan(REST, 0.0, 900)
    wall = random.uniform((-1.0, 0.4, -1.0), (1.0, 0.41, 1.0), (5000, 3))
    stray = random.uniform(-0.1, 0.1, (30, 3)) + (0.05, 0.0, 0.0)
    stray = stray[np.abs(stray - (0.05, 0.01, 0.01)).max(1) > 0.055]
    kept = Cloud(np.concatenate([body, wall, stray])).around(SCANNER, MESH, CLAMP, 10_000).measured
    assert 800 <= len(kept) <= 905
    assert kept[:, 1].max() < 0.1
    assert 90 <= len(Cloud(body).around(SCANNER, MESH, CLAMP, 100).measured) <= 100
    assert np.diff(kept[:, 0]).min() > -1e-3  # along the beam, or the other way round
    for wrong in (1e3 * body, 1e-3 * body):
        with pytest.raises(wr.InputError, match=r"check the unit \(data.cloud.units of a scan"):
            Cloud(wrong).around(SCANNER, MESH, CLAMP, 100)
