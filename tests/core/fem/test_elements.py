"""Shape functions, rules, volumes, and patch tests of every element kind."""

import math

import numpy as np
import pytest

from warp_resphys import (
    Body,
    Inputs,
    Mesh,
    Simulator,
    SolverSettings,
    box_hexahedra,
    box_tetrahedra,
    quadratic,
)
from warp_resphys.core.energies.catalogue import MATERIALS
from warp_resphys.core.fem.integration_points import discretise, physical_gradients
from warp_resphys.core.mesh.elements import (
    BY_NODES,
    ELEMENTS,
    FACES,
    conical_simplex,
    degree_two_tetrahedron,
    gauss_box,
)
from warp_resphys.core.mesh.volume_mesh import surface_vertices
from warp_resphys.io.errors import InputError

SIZE, DIVISIONS = (0.03, 0.02, 0.02), (3, 2, 2)
SHAPES = {name: element.shape for name, element in ELEMENTS.items()}
SHAPES |= {f"face of {nodes}": face.shape for nodes, face in FACES.items()}


def distorted(mesh, amount=0.12):
    """A mesh with every vertex, also on the boundary, moved by up to a fraction of an element."""
    cell = SIZE[0] / DIVISIONS[0]
    rng = np.random.default_rng(0)
    return Mesh(mesh.vertices + amount * cell * rng.uniform(-1, 1, mesh.vertices.shape), mesh.cells)


HEXAHEDRA, TETRAHEDRA = box_hexahedra(SIZE, DIVISIONS), box_tetrahedra(SIZE, DIVISIONS)
MESHES = {
    "hexahedra": HEXAHEDRA,
    "distorted hexahedra": distorted(HEXAHEDRA),
    "distorted tetrahedra": distorted(TETRAHEDRA),
    "distorted 10-node tetrahedra": quadratic(distorted(TETRAHEDRA)),
    "curved 10-node tetrahedra": distorted(quadratic(TETRAHEDRA), 0.03),
    "distorted 20-node hexahedra": quadratic(distorted(HEXAHEDRA), "hexahedron20"),
    "distorted 27-node hexahedra": quadratic(distorted(HEXAHEDRA)),
    "curved 27-node hexahedra": distorted(quadratic(HEXAHEDRA), 0.03),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_shape_functions_are_a_nodal_partition_of_unity(kind):
    shape = SHAPES[kind]
    nodes = shape.nodes
    np.testing.assert_allclose(shape(nodes)[0], np.eye(len(nodes)), atol=1e-14)
    points = np.random.default_rng(0).uniform(0, 0.3, (5, nodes.shape[1]))
    values, gradients = shape(points)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(gradients.sum(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose(values @ nodes, points, atol=1e-14)


@pytest.mark.parametrize("kind", SHAPES)
def test_shape_gradients_equal_differences(kind):
    shape = SHAPES[kind]
    dimension = shape.nodes.shape[1]
    points, step = np.random.default_rng(1).uniform(0, 0.3, (5, dimension)), 1e-6
    for axis, offset in enumerate(step * np.eye(dimension)):
        difference = (shape(points + offset)[0] - shape(points - offset)[0]) / (2 * step)
        np.testing.assert_allclose(shape(points)[1][..., axis], difference, atol=1e-9)


@pytest.mark.parametrize("nodes", FACES)
def test_rules_of_faces_integrate_linear_fields(nodes):
    """So that every corner of a flat face has the same share of a pressure, a drag or an area."""
    face = FACES[nodes]
    points, weights = face.rule(2)
    values, area = face.shape(points)[0][:, : face.corners], 0.5 if face.corners == 3 else 4.0
    if nodes == face.corners:
        np.testing.assert_allclose(weights @ values, area / face.corners, rtol=1e-13)
    np.testing.assert_allclose(
        weights @ points, area * face.shape.nodes[: face.corners].mean(axis=0), atol=1e-14
    )


@pytest.mark.parametrize(
    ("rule", "degree"),
    [(degree_two_tetrahedron(), 2), (conical_simplex(4), 5)],
    ids=["4 points", "64 points"],
)
def test_rules_of_the_tetrahedron_are_exact(rule, degree):
    points, weights = rule
    for powers in np.ndindex(degree + 1, degree + 1, degree + 1):
        if sum(powers) <= degree:
            exact = math.prod(map(math.factorial, powers)) / math.factorial(sum(powers) + 3)
            np.testing.assert_allclose(weights @ (points**powers).prod(axis=1), exact, rtol=1e-13)


@pytest.mark.parametrize("integration", ["centre", "full"])
@pytest.mark.parametrize("name", MESHES)
def test_volumes_and_masses_sum_to_the_total(name, integration):
    mesh = MESHES[name]
    d = discretise(mesh, integration)
    total = np.prod(SIZE)
    if "curved" in name:
        total = d.element_volumes.sum()
    elif "hexahedra" in name:
        points, weights = gauss_box(4)  # which are exact for plane edges
        total = (
            physical_gradients(mesh.vertices, mesh.cells, mesh.element.shape(points)[1])[1]
            @ weights
        ).sum()
    elif "tetrahedra" in name:
        corners = mesh.vertices[mesh.cells[:, :4]]
        total = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6
    np.testing.assert_allclose(d.element_volumes.sum(), total, rtol=1e-12)
    for term in ("shape_volume", "volume_volume"):
        carried = sum(getattr(points, term).sum(axis=0) for points in d.point_sets)
        np.testing.assert_allclose(carried, d.element_volumes, rtol=1e-12)
    for operator in (d.load_volume, d.lumped_volume):
        np.testing.assert_allclose(operator.sum(axis=0), d.element_volumes, rtol=1e-12)
    assert d.lumped_volume.data.min() > 0.0


@pytest.mark.parametrize("integration", ["centre", "full"])
@pytest.mark.parametrize("name", MESHES)
def test_every_point_sees_a_linear_map_exactly(name, integration):
    mesh, f = MESHES[name], np.eye(3) + 0.3 * np.random.default_rng(2).normal(size=(3, 3))
    for points in discretise(mesh, integration).point_sets:
        moved = (mesh.vertices @ f.T)[points.nodes]
        np.testing.assert_allclose(
            np.einsum("cki,cqkj->cqij", moved, points.gradients),
            np.broadcast_to(f, (*points.gradients.shape[:2], 3, 3)),
            atol=1e-12,
        )


def test_vertex_patch_averages_the_gradients_of_its_cells_by_volume():
    mesh = MESHES["distorted tetrahedra"]
    moved = mesh.vertices + 0.001 * np.random.default_rng(3).normal(size=mesh.vertices.shape)
    cells, patches = discretise(mesh).point_sets
    of_cells = np.einsum("cki,cqkj->cqij", moved[cells.nodes], cells.gradients)[:, 0]
    of_patches = np.einsum("cki,cqkj->cqij", moved[patches.nodes], patches.gradients)[:, 0]
    volumes = discretise(mesh).element_volumes
    for vertex in range(len(mesh.vertices)):
        around = (mesh.cells == vertex).any(axis=1)
        mean = np.average(of_cells[around], axis=0, weights=volumes[around])
        np.testing.assert_allclose(of_patches[vertex], mean, atol=1e-12)


PATCH_MESHES = [name for name in MESHES if "curved" not in name]
# Curved edges reproduce linear maps at every point, but the quadratures do not integrate the
# products of their rational gradients, so that the patch test holds for straight-sided cells.


@pytest.mark.parametrize("element", ELEMENTS.values(), ids=ELEMENTS)
def test_faces_look_outwards_and_lie_on_the_cell(element):
    """Their corners run counter-clockwise seen from outside.

    The other nodes are in the middle of edges and faces.
    """
    nodes = element.shape.nodes
    for face in element.faces:
        corners = nodes[face[: element.face.corners]]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ (corners.mean(axis=0) - nodes.mean(axis=0)) > 0.0
        values, _ = FACES[element.face.corners].shape(element.face.shape.nodes)
        np.testing.assert_allclose(values @ corners, nodes[face], atol=1e-14)
    assert BY_NODES[element.nodes] is element


@pytest.mark.parametrize(
    ("model", "integration"), [("corotated", "centre"), ("stable_neo_hookean", "full")]
)
@pytest.mark.parametrize("name", PATCH_MESHES)
def test_patch(name, model, integration):
    """A linear displacement of the boundary extends linearly to the interior."""
    mesh = MESHES[name]
    boundary = surface_vertices(mesh)
    material = MATERIALS[model](1e5, 0.45, density=1000.0)
    settings = SolverSettings(name="newton", relative_tolerance=1e-12, absolute_tolerance=1e-12)
    body = Body(mesh, fixed=boundary, volume_integration=integration)
    simulator = Simulator(body, material, gravity=(0.0, 0.0, 0.0), solver=settings)
    f = np.eye(3) + 0.05 * np.random.default_rng(4).normal(size=(3, 3))
    expected = simulator.tensor(mesh.vertices @ f.T)[None]
    q = simulator.static_equilibrium(Inputs(fixed_positions=expected[:, simulator.fixed])).q
    assert len(boundary) < len(mesh.vertices)
    assert float((q - expected).abs().max()) <= 1e-10


def test_unknown_integration_is_refused():
    with pytest.raises(InputError, match="volume_integration is"):
        discretise(MESHES["hexahedra"], "reduced")
