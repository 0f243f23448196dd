"""Warnings of sizes, units and cells that look like a mistake,
and of cells by what quadratic ones would change.
"""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import (
    Body,
    Contact,
    HalfSpace,
    Inputs,
    Mesh,
    ResphysWarning,
    Rigid,
    Scene,
    Simulator,
    quadratic,
)
from warp_resphys.core.dynamics.plausibility import small_strain_stiffness
from warp_resphys.core.energies.convex_material import ConvexMaterial
from warp_resphys.core.energies.materials import Corotated, StableNeoHookean
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra


def beam(scale=1.0, mesh=None):
    """A beam of 0.1 m, times a factor."""
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)) if mesh is None else mesh
    return Body(
        Mesh(scale * mesh.vertices, mesh.cells), fixed=np.flatnonzero(mesh.vertices[:, 0] == 0.0)
    )


@pytest.mark.parametrize(
    ("body", "changes", "words"),
    [
        (beam(1e3), {}, r"the body is 10\d\.\d+ m across: .*mesh\.units"),
        (beam(1e-3), {}, r"the body is 0\.00010\d+ m across: .*units"),
        (beam(), {"material": Corotated(0.2)}, r"Young's modulus is 0\.2 Pa, softer than a gel"),
        (
            beam(),
            {"material": StableNeoHookean(2e8)},
            r"Young's modulus is 2e\+08 Pa, stiffer than any rubber",
        ),
        (
            beam(),
            {"material": Corotated(density=1.0)},
            r"density is 1 kg/m\^3, lighter than a foam",
        ),
        (beam(), {"gravity": (0.0, 0.0, -9810.0)}, r"gravity is 9810 m/s\^2: .*mm/s\^2"),
    ],
)
def test_a_wrong_unit_is_one_warning(body, changes, words):
    """A warning names the value and the unit that is expected,
    at the line that makes the simulator.
    """
    with pytest.warns(ResphysWarning, match=words) as caught:
        Simulator(body, **changes)
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_a_nearly_flat_cell_is_named_with_its_place():
    """A tetrahedron that is flattened to a sliver is found among others."""
    mesh = box_tetrahedra((0.1, 0.03, 0.03), (4, 2, 2))
    inner = int(np.argmin(np.linalg.norm(mesh.vertices - (0.05, 0.015, 0.015), axis=1)))
    cell = mesh.cells[np.flatnonzero((mesh.cells == inner).any(1))[0]]
    others = mesh.vertices[cell[cell != inner]]
    towards = others.mean(0) - mesh.vertices[inner]
    normal = np.cross(others[1] - others[0], others[2] - others[0])
    normal /= np.linalg.norm(normal)
    vertices = mesh.vertices.copy()
    vertices[inner] += 0.995 * (towards @ normal) * normal
    with pytest.warns(
        ResphysWarning, match=r"cell \d+ of the body around \(.*\) mm is nearly flat"
    ) as caught:
        Simulator(beam(mesh=Mesh(vertices, mesh.cells)))
    number = int(str(caught[0].message).split()[1])
    assert inner in mesh.cells[number]


def test_the_warnings_are_silenced_by_their_class():
    """A filter of the class is enough, and a plausible body warns of nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulator(beam())
        Simulator(beam(), Corotated(2e9, 0.3))  # a plate of plastic
        warnings.simplefilter("ignore", ResphysWarning)
        Simulator(beam(1e3), Corotated(0.2))


@pytest.mark.parametrize(
    ("mesh", "ratio"),
    [(box_hexahedra((0.04, 0.03, 0.02), (n, n, n)), 1.0 + 2.0 / n**2) for n in (1, 2, 3, 4)]
    + [(box_hexahedra((0.1, 0.03, 0.03), (10, 3, 3)), 1.0 + 2.0 / 9.0)]  # about its length
    + [(quadratic(box_hexahedra((0.04, 0.03, 0.02), (1, 1, 1))), 1.0)],
)
def test_a_free_body_of_few_cells_turns_too_slowly(mesh, ratio):
    """Its moment of inertia is m (a^2 + b^2) / 12, and more
    where its mass lies on the corners of linear cells.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Simulator(Body(mesh))
        Simulator(Body(mesh, fixed=[0]))
        Simulator(Body(mesh, energies=[Contact({"floor": HalfSpace(position=(0.0, 0.0, -9e-4))})]))
    if ratio < 1.15:
        assert not caught
        return
    (warning,) = caught
    assert f"the body, which nothing holds, has {ratio:.3g} times its true rotary inertia" in str(
        warning.message
    )


@pytest.mark.parametrize("divisions", [1, 2, 3])
def test_a_rigid_body_has_the_rotary_inertia_of_its_shape(divisions):
    """Of m (a^2 + b^2) / 12 for a box, whatever its cells: a torque about z, for a short time."""
    size, torque, step, steps = (0.06, 0.03, 0.02), 1e-3, 1e-4, 5
    body = Body.rigid_body(box_hexahedra(size, (divisions,) * 3), Rigid(density=1000.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulator = Simulator(body, {}, step, gravity=(0.0, 0.0, 0.0))
    arms = simulator.rest_positions - simulator.rest_positions.mean(0)
    turn = torch.stack([-arms[:, 1], arms[:, 0], 0.0 * arms[:, 0]], 1)
    weights = turn / turn.square().sum()
    motion = simulator.rollout(simulator.rest_state(), steps, Inputs(torque * weights[None]))
    rate = float((motion.v[-1, 0] * weights).sum())  # rad/s
    expected = 1000.0 * np.prod(size) * (size[0] ** 2 + size[1] ** 2) / 12.0
    assert torque * step * steps / rate == pytest.approx(expected, rel=1e-4)


def test_stiffness_at_small_strains():
    """Three times the shear modulus, where a law has no Young's modulus:
    G = 2 (c10 + c01) + Ogden's moduli.
    """
    law = ConvexMaterial(c10=20e3, c01=5e3, ogden={4: 30e3})
    assert small_strain_stiffness(law) == pytest.approx(3.0 * (2.0 * 25e3 + 30e3))
    assert small_strain_stiffness(replace(Corotated(), youngs_modulus=3e5)) == 3e5


SIZE = (0.1, 0.03, 0.03)
NUMBER = re.compile(r"deform by (about|at least) (\d+) % (more|less)")


def sag(mesh, material, **options):
    """Mean sag of the mass under its weight [m], and the warnings."""
    simulator = Simulator(clamped(mesh), material, **options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        q = simulator.static_equilibrium().q[0].numpy()
    mass = simulator.prepare().load_mass[0].numpy()
    return float(mass @ (mesh.vertices - q)[:, 2] / mass.sum()), [
        str(warning.message) for warning in caught
    ]


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
    return Mesh(
        vertices, box.cells, {"layer": np.flatnonzero(layer), "soft": np.flatnonzero(~layer)}
    )


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
    scene = Scene(
        {
            n: clamped(box_hexahedra(SIZE, d))
            for n, d in (("coarse", (4, 2, 2)), ("fine", (12, 4, 4)))
        }
    )
    simulator = Simulator(scene, Corotated(264e3, 0.45), gravity=(0.0, 0.0, 0.0))
    force = np.zeros((1, scene.n_vertices, 3))
    force[:, np.isclose(scene.vertices[:, 0], 0.1), 2] = 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResphysWarning)
        simulator.static_equilibrium()
    with pytest.warns(
        ResphysWarning, match="linear hexahedra of the body 'coarse' are too coarse"
    ) as caught:
        simulator.static_equilibrium(Inputs(force))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResphysWarning)
        simulator.static_equilibrium(Inputs(2.0 * force))
