"""The change of the deflection by quadratic cells is estimated from the equilibrium of linear ones, and warned of."""

import re
import warnings

import numpy as np
import pytest

from support.clamped import clamped
from warp_resphys import Corotated, Inputs, Mesh, Scene, Simulator, box_hexahedra, box_tetrahedra, quadratic
from warp_resphys.io.errors import ResphysWarning

SIZE = (0.1, 0.03, 0.03)
NUMBER = re.compile(r"deform by (about|at least) (\d+) % (more|less)")


def sag(mesh, material, **options):
    """Mean sag of the mass under its weight [m], and the warnings."""
    simulator = Simulator(clamped(mesh), material, **options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        q = simulator.static_equilibrium().q[0].numpy()
    mass = simulator.prepare().load_mass[0].numpy()
    return float(mass @ (mesh.vertices - q)[:, 2] / mass.sum()), [str(warning.message) for warning in caught]


def estimated(words):
    """The relative change that a warning names."""
    _, percent, sign = NUMBER.search(words).groups()
    return 0.01 * float(percent) * (1.0 if sign == "more" else -1.0)


def layered(divisions, thickness=1e-3):
    """A soft bar with a stiff layer of one cell below."""
    box = box_hexahedra((0.1, 0.02, 1.0), (*divisions[:2], divisions[2] + 1))
    heights = np.append(0.0, np.linspace(thickness, 0.02, divisions[2] + 1))
    vertices = box.vertices.copy()
    vertices[:, 2] = np.interp(box.vertices[:, 2], np.linspace(0.0, 1.0, len(heights)), heights)
    layer = vertices[box.cells].mean(1)[:, 2] < thickness
    return Mesh(vertices, box.cells, {"layer": np.flatnonzero(layer), "soft": np.flatnonzero(~layer)})


LAYERS = {"layer": Corotated(1e7, 0.3), "soft": Corotated(1e5, 0.45)}


@pytest.mark.parametrize(
    ("mesh", "material", "least"),
    [
        (layered((10, 2, 3)), LAYERS, 0.6),
        (layered((5, 2, 3)), LAYERS, 0.3),
        (box_hexahedra(SIZE, (6, 1, 1)), Corotated(264e3, 0.45), 0.9),
        (box_hexahedra(SIZE, (20, 1, 1)), Corotated(264e3, 0.499), 0.8),
        (box_hexahedra(SIZE, (4, 2, 2)), Corotated(264e3, 0.45), 0.5),
    ],
)
def test_the_estimate_is_what_quadratic_cells_change(mesh, material, least):
    """Or a share of it where that is large."""
    linear, words = sag(mesh, material)
    finer, silent = sag(quadratic(mesh), material)
    assert not silent
    change = finer / linear - 1.0
    assert abs(change) > 0.07
    assert least < estimated(words[0]) / change < 1.15
    assert ("region 'layer' of one cell" in words[0]) == (material is LAYERS)


@pytest.mark.parametrize("poissons_ratio", [0.3, 0.45, 0.499])
def test_linear_tetrahedra_are_too_stiff(poissons_ratio):
    """By more than the estimate if they lock."""
    mesh, material = box_tetrahedra(SIZE, (10, 2, 2)), Corotated(264e3, poissons_ratio)
    linear, (words,) = sag(mesh, material)
    change = sag(quadratic(mesh), material)[0] / linear - 1.0
    assert 0.2 < estimated(words) < change
    assert "linear tetrahedra" in words
    assert "at least" in words


@pytest.mark.parametrize(
    ("mesh", "material"),
    [
        (box_hexahedra(SIZE, (12, 4, 4)), Corotated(264e3, 0.499)),
        (box_hexahedra(SIZE, (10, 3, 3)), Corotated(264e3, 0.45)),
        (quadratic(box_tetrahedra(SIZE, (4, 1, 1))), Corotated(264e3, 0.499)),
        (layered((40, 2, 4)), LAYERS),
    ],
)
def test_good_meshes_are_not_warned_of(mesh, material):
    assert not sag(mesh, material)[1]
    assert not sag(mesh, material, gravity=(0.0, 0.0, 0.0))[1]  # without any strain


def test_a_body_of_a_scene_is_named_and_warned_of_once():
    """In the first of its equilibria that shows it, here under a force."""
    scene = Scene({n: clamped(box_hexahedra(SIZE, d)) for n, d in (("coarse", (4, 2, 2)), ("fine", (12, 4, 4)))})
    simulator = Simulator(scene, Corotated(264e3, 0.45), gravity=(0.0, 0.0, 0.0))
    force = np.zeros((1, scene.n_vertices, 3))
    force[:, np.isclose(scene.vertices[:, 0], 0.1), 2] = 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResphysWarning)
        simulator.static_equilibrium()
    with pytest.warns(ResphysWarning, match="linear hexahedra of the body 'coarse' are too coarse") as caught:
        simulator.static_equilibrium(Inputs(force))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResphysWarning)
        simulator.static_equilibrium(Inputs(2.0 * force))
