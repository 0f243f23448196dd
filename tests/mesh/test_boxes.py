"""Bodies of boxes: what they fill, that their cells fit, and boxes that make no body."""

import re

import numpy as np
import pytest

from warp_resphys.io.errors import MeshError
from warp_resphys.mesh.boxes import boxes_hexahedra
from warp_resphys.mesh.quality import cell_volumes
from warp_resphys.mesh.volume_mesh import boundary_triangles, check_mesh

PLATE, SIDES, FIN = (
    ((-0.005, -0.025, 0.0), (0.005, 0.025, 0.06)),
    ((-0.015, -0.015, 0.0), (0.015, 0.015, 0.06)),
    ((-0.005, -0.015, 0.06), (0.005, 0.015, 0.08)),
)


@pytest.mark.parametrize(("size", "nodes"), [(0.007, 8), (0.015, 20), (0.015, 27)])
def test_a_cross_with_a_fin_is_filled_without_cracks(size, nodes):
    mesh = boxes_hexahedra([PLATE, SIDES, FIN], size, nodes)
    check_mesh(mesh)
    assert mesh.element.nodes == nodes
    section = 0.01 * 0.05 + 2 * 0.01 * 0.03
    assert cell_volumes(mesh).sum() == pytest.approx(section * 0.06 + 0.01 * 0.03 * 0.02, rel=1e-12)
    around, (a, b, c) = 2 * (0.03 + 0.05), np.moveaxis(mesh.vertices[boundary_triangles(mesh)], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area == pytest.approx(2 * section + around * 0.06 + 2 * (0.01 + 0.03) * 0.02, rel=1e-9)
    corners = mesh.vertices[mesh.cells[:, :8]]
    assert (corners.max(1) - corners.min(1)).max() <= size + 1e-12


@pytest.mark.parametrize(
    ("boxes", "size", "sentence"),
    [
        ([], 0.01, "a body of boxes needs one box or more"),
        ([PLATE, (PLATE[1], PLATE[0])], 0.01, "box 2 reaches from [0.005, 0.025, 0.06] to [-0.005"),
        ([((0, 0, 0), (0.1, 0.0, 0.1))], 0.01, "box 1 reaches from [0.0, 0.0, 0.0] to [0.1, 0.0, 0.1] m: it has no"),
        ([PLATE], 0.0, "the size of cells must be a positive length in metres, not 0.0"),
        ([PLATE, ((0.1, 0, 0), (0.2, 0.1, 0.1))], 0.01, "the boxes do not form one body"),
    ],
)
def test_boxes_that_make_no_body(boxes, size, sentence):
    with pytest.raises(MeshError, match=re.escape(sentence)):
        boxes_hexahedra(boxes, size)
