"""The cross-sections of pneumatic arms."""

from math import pi

import numpy as np
import pytest

from warp_resphys.io.errors import MeshError
from warp_resphys.mesh.arm import ArmGeometry
from warp_resphys.mesh.arm_section import SOLID, Piece, Section, section_grids, section_quadrilaterals


def area(points):
    """Area of polygons (..., N) of complex corners, counter-clockwise."""
    return 0.5 * (points.conj() * np.roll(points, -1, axis=-1)).imag.sum(-1)


def test_an_arc_runs_at_the_distance_of_its_ends_from_its_centre():
    arc = Piece(2.0 + 1.0j, 1.0 + 2.0j, centre=1.0 + 1.0j)  # a quarter of the unit circle about 1 + i
    points = arc.points(np.linspace(0.0, 1.0, 1001))
    np.testing.assert_allclose(np.abs(points - arc.centre), 1.0, rtol=1e-12)
    assert arc.turn == pytest.approx(pi / 2.0)
    assert arc.area == pytest.approx(area(np.concatenate([[0.0], points])), rel=1e-6)
    assert Piece(2.0 + 1.0j, 1.0 + 2.0j, None).area == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("profile", "outline"), [("half_disc", "lobed"), ("disc", "round"), ("sector", "round"), ("disc", "lobed")]
)
def test_quadrilaterals_fill_the_solid_and_each_chamber_once(profile, outline):
    section: Section = ArmGeometry(profile=profile, outline=outline).section(0.025)
    divisions = section.divisions(0.003)
    grids, chambers = section_grids(section, divisions)
    places, quads = section_quadrilaterals(grids)
    points = np.concatenate([grid.ravel() for grid in grids])[places]
    areas = [area(points[corners]) for corners in quads]
    assert min(own.min() for own in areas) > 0.0
    for chamber in range(section.count):
        own = sum(part.sum() for part, number in zip(areas, chambers, strict=True) if number == chamber)
        assert own == pytest.approx(area(section.chamber_polygon(divisions)), rel=1e-9)
    assert set(chambers) == {SOLID, *range(section.count)}
    assert sum(part.sum() for part in areas) == pytest.approx(area(section.body_polygon(divisions)), rel=1e-9)


def test_chambers_that_do_not_fit():
    with pytest.raises(MeshError, match="where the arm's radius is"):
        ArmGeometry(wall=0.02).section(0.015).check()
