"""Outlines of masks and of bodies, compared with closed forms."""

import numpy as np
import pytest
import torch
import trimesh

from support.refusals import refuses
from warp_resphys.io.errors import InputError
from warp_resphys.pictures.outlines import ClosedSurface, Outline, visibility

RADIUS, MIDDLE = 40.3, np.array([101.2, 79.6])  # px
SIZE = (160, 200)


def disc(radius=RADIUS, middle=MIDDLE, size=SIZE):
    rows, columns = np.indices(size)
    return (columns - middle[0]) ** 2 + (rows - middle[1]) ** 2 <= radius**2


def around(radius, count=200):
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return MIDDLE + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def test_outline_of_a_disc():
    outline = Outline.of_mask(disc())
    away = np.linalg.norm(outline.points - MIDDLE, axis=1)
    assert abs(away - RADIUS).max() < 0.6
    assert abs(away.mean() - RADIUS) < 0.1
    assert outline.region.area == pytest.approx(np.pi * RADIUS**2, rel=5e-3)
    assert len(outline.points) == pytest.approx(np.pi * RADIUS, rel=0.02)  # 2 px apart
    for radius in (0.5 * RADIUS, 0.95 * RADIUS, 1.05 * RADIUS, 1.4 * RADIUS):
        distance, gradient = outline.signed(around(radius))
        assert abs(distance - (radius - RADIUS)).max() < 0.6
        outwards = (around(radius) - MIDDLE) / radius
        assert (gradient * outwards).sum(1).min() > 0.9


def test_borders_of_the_picture_are_no_outline_and_a_mask_without_a_body_is_refused():
    cut = Outline.of_mask(disc(middle=np.array([101.2, 5.0])))
    assert cut.points[:, 1].min() > 1.0
    assert len(cut.points) < 0.75 * np.pi * RADIUS
    assert cut.region.area == pytest.approx(disc(middle=np.array([101.2, 5.0])).sum(), rel=0.02)
    refuses(InputError, "shows nothing of the body", Outline.of_mask, np.zeros(SIZE, dtype=bool))


def seen(mesh, focal=800.0, depth=5.0):
    """Pixels of a body before a pinhole camera."""
    away = mesh.vertices + np.array([0.0, 0.0, depth])
    return focal * away[:, :2] / away[:, 2:]


def test_silhouette_of_a_sphere():
    """A sphere of radius 1 is seen under the angle whose sine is 1 / distance."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    surface = ClosedSurface.of(np.asarray(sphere.faces))
    rim = surface.silhouette(seen(sphere))
    radius = 800.0 / np.sqrt(5.0**2 - 1.0)
    away = np.linalg.norm(rim.pixels, axis=1)
    assert away == pytest.approx(radius, rel=3e-3)
    assert rim.lengths.sum() == pytest.approx(2.0 * np.pi * radius, rel=0.02)
    outwards = (rim.pixels * rim.outward).sum(1) / away
    assert outwards.min() > 0.8
    points = rim.points(torch.as_tensor(sphere.vertices)).numpy()
    away = points + np.array([0.0, 0.0, 5.0])
    assert 800.0 * away[:, :2] / away[:, 2:] == pytest.approx(rim.pixels, abs=0.05)


def test_what_the_body_covers_is_no_outline_and_what_a_clamp_hides_does_not_count():
    """A small box before a large one: its own edges are inside,
    and the outline is that of the large one.
    """
    large, small = (trimesh.creation.box((size, size, 0.2)) for size in (2.0, 0.5))
    small.apply_translation((0.1, 0.0, -1.0))
    both = trimesh.util.concatenate([large, small])
    rim = ClosedSurface.of(np.asarray(both.faces)).silhouette(seen(both))
    half = 800.0 / 4.9
    assert np.abs(rim.pixels).max(1) == pytest.approx(half, abs=1e-6)
    assert rim.lengths.sum() == pytest.approx(8.0 * half, rel=1e-6)
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    points = np.array([[5.0, 5.0], [13.0, 5.0], [16.0, 5.0], [19.0, 5.0], [30.0, 5.0]])
    assert visibility(points, corners, 6.0) == pytest.approx([0.0, 0.0, 0.0, 0.5, 1.0])
    assert visibility(points, np.zeros((0, 2)), 6.0) == pytest.approx(1.0)


def test_closest_points_of_a_silhouette():
    box = trimesh.creation.box((2.0, 2.0, 0.2))
    half = 800.0 / 4.9
    rim = ClosedSurface.of(np.asarray(box.faces)).silhouette(seen(box))
    points = np.array(
        [[half + 7.0, 10.0], [half - 5.0, 10.0], [0.0, -half - 0.3], [half + 3.0, half + 4.0]]
    )
    index, distance, gradient = rim.closest(points)
    assert distance == pytest.approx([7.0, -5.0, 0.3, 5.0], abs=0.3)
    assert gradient[:3] == pytest.approx(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, -1.0]]), abs=0.06)
    assert gradient[3] == pytest.approx([0.6, 0.8], abs=0.1)
    assert rim.pixels[index[0]] == pytest.approx([half, 10.0], abs=0.5)


def test_a_surface_is_closed_and_before_the_camera():
    box = trimesh.creation.box((2.0, 2.0, 0.2))
    refuses(InputError, "not closed", ClosedSurface.of, np.asarray(box.faces)[1:])
    pixels = seen(box)
    pixels[3] = np.nan
    refuses(
        InputError, "behind the camera", ClosedSurface.of(np.asarray(box.faces)).silhouette, pixels
    )
