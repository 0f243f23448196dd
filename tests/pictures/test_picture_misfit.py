"""Parameters of bodies at rest from simulated pictures: derivatives,
Young's modulus, obstacles, and a turned clamp.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.refusals import refuses
from support.slopes import differences
from warp_resphys.learning import Bounds, Prior, search_parameters
from warp_resphys.pictures import ClosedSurface, Lens, Outline, PlacedCamera
from warp_resphys.pictures.camera_laboratory import noisy_mask
from warp_resphys.pictures.picture_misfit import PictureMisfit, values_of
from warp_resphys.pictures.seen import Photo, SeenPose, distance_of

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1), nodes=20)
LENS = Lens(
    torch.tensor([[700.0, 0.0, 160.0], [0.0, 700.0, 120.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
)
LOOKS = torch.tensor(  # from the side: x right, z up
    [[1.0, 0.0, 0.0, -0.05], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
CAMERA = PlacedCamera(LENS, LOOKS, torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64))
POINTS = wr.bind_markers(
    MESH, [[0.1, 0.0, 0.01], [0.06, 0.0, 0.01], [0.08, 0.0, 0.02]], ["a", "b", "c"]
)
SIZE = (240, 320)
RANGES = {
    "youngs_modulus": Bounds(lower=3e4, upper=1e6, logarithmic=True),
    "camera_shift_1": Bounds(lower=-0.02, upper=0.02, prior=Prior(mean=0.0, deviation=0.01)),
    "camera_turn_2": Bounds(lower=-0.2, upper=0.2, prior=Prior(mean=0.0, deviation=0.05)),
    "focal_factor": Bounds(lower=0.9, upper=1.1, prior=Prior(mean=1.0, deviation=0.02)),
}
TRUTH = {
    "youngs_modulus": 1.2e5,
    "camera_shift_1": 0.003,
    "camera_turn_2": 0.02,
    "focal_factor": 1.01,
}
FIRST = {"youngs_modulus": 3e5, "camera_shift_1": 0.0, "camera_turn_2": 0.0, "focal_factor": 1.0}


def pose(outline=True, tracked=False, name="beam", both_ends=False):
    ends = (wr.select_vertices(MESH, x=0.0), wr.select_vertices(MESH, x=0.1))[: 1 + both_ends]
    body = wr.Body(MESH, fixed=np.concatenate(ends))
    simulator = wr.Simulator(body, wr.Corotated(2e5, 0.45), gravity=(0.0, 0.0, -9.81))
    surface = ClosedSurface.of(MESH)
    plain = SeenPose(name, simulator, surface, ends, (Photo("0", CAMERA),), points=POINTS)
    q = plain.shape(TRUTH)
    corrections = PlacedCamera.corrections(TRUTH)
    region = surface.region(CAMERA.pixels(q, corrections).numpy())
    mask = noisy_mask(region, SIZE[::-1], 0.0, np.random.default_rng(0))
    pixels = CAMERA.pixels(POINTS(q[None])[0], corrections).numpy()
    photo = Photo(
        "0", CAMERA, Outline.of_mask(mask) if outline else None, pixels if tracked else None
    )
    return replace(plain, photos=(photo,)), mask


@pytest.fixture(scope="module")
def seen():
    return pose(tracked=True)[0]


def test_derivatives_are_those_of_differences(seen):
    """Of the residuals of tracked points, and of the loss of outlines,
    whose closest points differ everywhere.
    """
    for own, tolerance in (
        (replace(seen, photos=(replace(seen.photos[0], outline=None),)), 1e-3),
        (seen, 0.03),
    ):
        misfit = PictureMisfit([own], RANGES)
        unit = misfit.to_unit({**FIRST, "youngs_modulus": 1.6e5, "camera_shift_1": 0.001})
        linear = misfit.linearise(unit)
        gradient = differences(
            lambda x, misfit=misfit: misfit.linearise(x, derivatives=False).loss, unit, 1e-3
        )
        assert linear.gradient == pytest.approx(
            gradient, rel=tolerance, abs=tolerance * np.abs(gradient).max()
        )


@pytest.mark.parametrize("kind", ["outline", "points"])
def test_parameters_come_back(seen, kind):
    photo = replace(
        seen.photos[0], **({"tracked": None} if kind == "outline" else {"outline": None})
    )
    # Six exact coordinates determine four parameters, without priors.
    ranges = (
        RANGES
        if kind == "outline"
        else {name: range_.changed(prior=None) for name, range_ in RANGES.items()}
    )
    result = search_parameters(
        PictureMisfit([replace(seen, photos=(photo,))], ranges), [FIRST], 40, tolerance=1e-12
    )
    limit = 0.1 if kind == "outline" else 1e-3  # a mask has whole pixels
    assert result.parameters["youngs_modulus"] == pytest.approx(TRUTH["youngs_modulus"], rel=limit)
    assert result.uncertainty.deviation["youngs_modulus"] < 0.2 * TRUTH["youngs_modulus"]
    own = replace(seen, photos=(photo,))
    q = own.shape(result.parameters)
    difference = own.difference(photo, q, result.parameters)
    assert distance_of(difference) < 0.25
    undeformed = replace(own, deforms=False)
    off = undeformed.difference(photo, undeformed.shape({}), {})
    assert distance_of(off) > 10.0 * distance_of(difference)
    if kind == "outline":
        assert difference["overlap"] > 0.97
        assert difference["outline_px"] == pytest.approx(
            difference["outline_mm"] * 0.7 / 0.31, rel=0.1
        )


def test_a_body_beside_the_picture_is_named_and_a_step_that_moves_it_there_has_failed(seen):
    seen, _ = pose()
    with pytest.raises(wr.InputError, match="0 does not show the simulated body where it is drawn"):
        seen.difference(seen.photos[0], seen.shape(TRUTH), {"camera_shift_1": 0.5})
    photo = replace(seen.photos[0], tracked=None)
    misfit = PictureMisfit(
        [replace(seen, photos=(photo,))], {"camera_shift_1": Bounds(lower=-0.6, upper=0.6)}, TRUTH
    )
    with pytest.raises(wr.InputError, match="does not show the simulated body"):
        misfit.linearise(misfit.to_unit({"camera_shift_1": 0.5}))
    assert misfit.linearise(misfit.to_unit({"camera_shift_1": 0.003})) is not None
    assert misfit.linearise(misfit.to_unit({"camera_shift_1": 0.5})) is None
    again = PictureMisfit(
        [replace(seen, photos=(photo,))], {"camera_shift_1": Bounds(lower=-0.6, upper=0.6)}, TRUTH
    )
    points = np.stack([again.to_unit({"camera_shift_1": shift}) for shift in (0.5, 0.003)])
    assert np.isfinite(again.losses_or_infinite(points)).tolist() == [False, True]


def test_values_belong_to_all_to_a_material_or_to_a_pose(seen):
    own = replace(seen, material="soft")
    values = {"a": 1.0, "a@soft": 2.0, "a@beam": 3.0, "b": 1.0, "b@soft": 2.0, "c@other": 5.0}
    assert values_of(own, values) == {"a": 3.0, "b": 2.0}
    assert values_of(own, {"a": 1.0, "a@left": 2.0, "a@right": 3.0}, "left") == {"a": 2.0}
    with pytest.raises(wr.InputError, match="nobody is neither a pose, a material nor a lens"):
        PictureMisfit([own], {"youngs_modulus@nobody": RANGES["youngs_modulus"]})
    with pytest.raises(wr.InputError, match="no parameter 'colour' to identify: choose from"):
        PictureMisfit([own], {"colour": RANGES["youngs_modulus"]})
    refuses(wr.InputError, "nothing to identify", PictureMisfit, [own], {})
    misfit = PictureMisfit([own], {"youngs_modulus@soft": RANGES["youngs_modulus"]}, TRUTH)
    assert misfit.linearise(misfit.to_unit({"youngs_modulus@soft": 1.2e5})).loss < 0.2


def test_a_turned_clamp_twists_the_body():
    """Half of the turn arrives in the middle, whether it is turned at once or from a near shape.

    An axis keeps.
    """
    seen, _ = pose(both_ends=True)
    q = seen.shape({"clamp_turn": math.pi, "clamp_shift": 0.004})
    rest = seen.simulator.rest_state(1).q[0]
    end = wr.select_vertices(MESH, x=0.1)
    turned = rest[end] * torch.tensor([1.0, -1.0, -1.0]) + torch.tensor([0.004, 0.02, 0.02])
    assert torch.allclose(q[end], turned, atol=1e-9)
    middle = torch.as_tensor(np.flatnonzero(np.abs(MESH.vertices[:, 0] - 0.05) < 0.0101))
    away, before = (x[middle][:, 1:] - x[middle][:, 1:].mean(0) for x in (q, rest))
    angle = torch.atan2(
        (before[:, 0] * away[:, 1] - before[:, 1] * away[:, 0]).sum(), (before * away).sum()
    )
    assert math.degrees(float(angle)) == pytest.approx(90.0, abs=3.0)
    near = seen.shape({"clamp_turn": math.pi - 0.3})
    again = seen.shape(
        {"clamp_turn": math.pi, "clamp_shift": 0.004}, ({"clamp_turn": math.pi - 0.3}, near)
    )
    assert torch.allclose(again, q, atol=1e-7)


def test_a_pose_has_pictures_and_places_of_its_points(seen):
    refuses(wr.InputError, "has no picture", replace, seen, photos=())
    refuses(wr.InputError, "places on the body are not known", replace, seen, points=None)


@pytest.mark.slow
def test_deviations_are_those_of_repeated_pictures():
    """Of outlines with a pixel of noise, whose two directions see the same noise."""
    seen, _ = pose()
    region = seen.surface.region(
        CAMERA.pixels(seen.shape(TRUTH), PlacedCamera.corrections(TRUTH)).numpy()
    )
    ranges = {
        "youngs_modulus": RANGES["youngs_modulus"],
        "camera_shift_1": Bounds(lower=-0.02, upper=0.02),
    }
    known = {name: value for name, value in TRUTH.items() if name not in ranges}
    first, found, said = {name: TRUTH[name] for name in ranges}, [], []
    for seed in range(12):
        mask = noisy_mask(region, SIZE[::-1], 1.0, np.random.default_rng(seed))
        own = replace(seen, photos=(replace(seen.photos[0], outline=Outline.of_mask(mask)),))
        result = search_parameters(PictureMisfit([own], ranges, known), [first], 8)
        found.append(np.log(result.parameters["youngs_modulus"]))
        said.append(
            result.uncertainty.deviation["youngs_modulus"] / result.parameters["youngs_modulus"]
        )
    assert 0.5 < np.std(found, ddof=1) / np.mean(said) < 1.4
    assert abs(np.mean(found) - np.log(TRUTH["youngs_modulus"])) < 0.02
    # Copies of a picture, or others of the body at rest by the same camera, say no more than one.
    thrice = replace(own, photos=3 * own.photos)
    again = search_parameters(PictureMisfit([thrice], ranges, known), [first], 8)
    assert again.parameters["youngs_modulus"] == pytest.approx(
        result.parameters["youngs_modulus"], rel=1e-6
    )
    assert again.uncertainty.deviation["youngs_modulus"] == pytest.approx(
        result.uncertainty.deviation["youngs_modulus"], rel=0.02
    )
