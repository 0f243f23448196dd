"""Values that look like a mistake, as units, nearly flat cells
and slow sizes: warnings, and errors.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray

from ...io.errors import InputError, warn
from ..energies.contact.obstacle_contact import Contact
from ..energies.contact.touching_bodies import HalfSpace
from ..energies.materials import Material
from ..fem.bodies import Body
from ..fem.integration_points import volume_points
from ..mesh.quality import scaled_jacobian
from ..mesh.readers import LONGEST_DIAGONAL, SHORTEST_DIAGONAL
from ..mesh.volume_mesh import Mesh

SOFTEST: Final = 1e3  # Pa, of gels
# Pa, stiffer than rubbers and softer than the plastics that hard parts are made of
UNLIKELY: Final = (1e8, 1e9)
# kg/m^3, of g/cm^3, kg/mm^3 and t/mm^3 that were taken for it, and heavier than metals; 0.001 makes
# a body massless
DENSITIES: Final = ((0.5, 10.0), (1e-10, 1e-5), (2.5e4, np.inf))
STRONGEST: Final = 100.0  # m/s^2
FLAT_CELL: Final = 0.02  # scaled Jacobian
INERTIA_ERROR: Final = 0.15  # of the rotary inertia
MANY_UNKNOWNS: Final = 60_000  # steps take seconds on a core (docs/gpu.md)
_LARGEST_STRAIN: Final = 0.3  # rho g L / E above which a wrong unit is assumed


def warn_of_implausible(
    body: Body, materials: Mapping[str, Material], gravity: Sequence[float], on_cpu: bool = True
) -> None:
    """Issues a `ResphysWarning` for every value of a simulator that looks like a mistake.

    Args:
        body: a body, or a `fem.scene.Scene`.
        materials: by name of the region or body; an empty name for a single material.
        gravity: acceleration (3,) [m/s^2].
        on_cpu: whether it is simulated on the CPU.
    """
    for name, member, _ in body.members:
        known = f"the body {name!r}" if name else "the body"
        _warn_of_mesh(member.mesh, known)
        _warn_of_inertia(member, known)
    for name, material in materials.items():
        _warn_of_material(material, f" of {name}" if name else "")
    size = float(np.linalg.norm(gravity))
    if size > STRONGEST:
        warn(
            f"gravity is {size:g} m/s^2: give it in m/s^2, "
            "not in mm/s^2 or in g, as in (0, 0, -9.81)."
        )
    unknowns = 3 * (body.n_vertices - len(body.fixed_vertices))
    if on_cpu and unknowns > MANY_UNKNOWNS:
        warn(
            f"the simulator has {unknowns:,} unknowns, and a step of it takes seconds on a CPU: "
            "take larger cells for a first look, or device='cuda'."
        )


def _warn_of_mesh(mesh: Mesh, name: str) -> None:
    across = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    if not SHORTEST_DIAGONAL <= across <= LONGEST_DIAGONAL:
        warn(
            f"{name} is {across:g} m across: lengths are in m, so check the unit of its mesh "
            "(units in Python, mesh.units in a configuration)."
        )
    worst, value = _worst_cell(mesh)
    if value < FLAT_CELL:
        x, y, z = 1e3 * mesh.vertices[mesh.cells[worst]].mean(axis=0)
        warn(
            f"cell {worst} of {name} around ({x:.4g}, {y:.4g}, {z:.4g}) mm is nearly flat (its "
            f"scaled Jacobian is {value:.2g}; 1 is ideal, 0 is flat): steps may be slow or fail "
            "there, so mesh the body anew."
        )


def _warn_of_inertia(body: Body, name: str) -> None:
    """Warns of a body that turns freely and whose mass,
    which lies on the vertices, has a wrong rotary inertia.

    By uniform density: 1 + 2 / n^2 times that of a cube of n linear cells along an edge. Rigid
    parts are exact, and a body that lies on a floor does not turn over.
    """
    soft = np.arange(len(body.mesh.cells)) if body.soft_cells is None else body.soft_cells
    if len(body.fixed_vertices) or body.symmetry or not len(soft) or _lies_on_floor(body):
        return
    places, volumes = volume_points(body.mesh, np.arange(len(body.mesh.cells)))
    centre = volumes @ places / volumes.sum()
    exact = _inertia(places - centre, volumes)
    lumped = _inertia(
        body.vertices - centre, np.asarray(body.mass_volume[:, soft].sum(axis=1)).ravel()
    )
    places, volumes = volume_points(body.mesh, soft)
    ratios = 1.0 + scipy.linalg.eigh(
        lumped - _inertia(places - centre, volumes), exact, eigvals_only=True
    )
    ratio = float(ratios[np.abs(ratios - 1.0).argmax()])
    if abs(ratio - 1.0) > INERTIA_ERROR:
        warn(
            f"{name}, which nothing holds, has {ratio:.3g} times its true rotary inertia, "
            "because its mass lies on the vertices of few cells: take more cells, quadratic "
            "hexahedra by quadratic(mesh), or a rigid body, which is exact."
        )


def _lies_on_floor(body: Body) -> bool:
    """Whether an undeformed body is within the distance of contact of a half-space."""
    contacts = [energy for energy in body.energies if isinstance(energy, Contact)]
    floors = [
        (contact, floor)
        for contact in contacts
        for floor in contact.obstacles.values()
        if isinstance(floor, HalfSpace)
    ]
    return any(
        float(((body.vertices - f.position) @ f.turn[:, 2]).min()) < contact.distance
        for contact, f in floors
    )


def _inertia(arms: NDArray[np.float64], masses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the inertia tensor (3, 3) of masses (P,) at places (P, 3) about the origin."""
    second = np.einsum("p,pi,pj->ij", masses, arms, arms)
    return np.asarray(np.trace(second) * np.eye(3) - second)


@lru_cache(maxsize=16)
def _worst_cell(mesh: Mesh) -> tuple[int, float]:
    """Number and quality of the cell with the smallest scaled Jacobian."""
    quality = scaled_jacobian(mesh)
    return int(quality.argmin()), float(quality.min())


def _warn_of_material(material: Material, of: str) -> None:
    stiffness, density = small_strain_stiffness(material), mean_of(material.values["density"])
    if 0.0 < stiffness < SOFTEST or UNLIKELY[0] < stiffness < UNLIKELY[1]:
        kind = "softer than a gel" if stiffness < SOFTEST else "stiffer than any rubber"
        warn(
            f"Young's modulus{of} is {stiffness:.3g} Pa, {kind}: give moduli in Pa, as in 3e5 "
            "for a soft silicone."
        )
    if any(lower < density < upper for lower, upper in DENSITIES):
        kind = "heavier than any metal" if density > DENSITIES[-1][0] else "lighter than a foam"
        warn(
            f"density{of} is {density:.3g} kg/m^3, {kind}: give it in kg/m^3, as in 1070 for "
            "silicone, not in g/cm^3."
        )


def check_weight(body: Body, material: Material, gravity: Sequence[float]) -> None:
    """Refuses a body with very large strains under its own weight, which indicate a wrong unit.

    A body of length L under its weight has strains of about rho g L / E: one percent for an arm of
    silicone.

    Raises:
        InputError: the strain is too large, or the material resists no change of shape.
    """
    length = float(np.linalg.norm(np.ptp(np.asarray(body.mesh.vertices), axis=0)))
    parameters = material.values
    density, stiffness = mean_of(parameters["density"]), small_strain_stiffness(material)
    if stiffness <= 0.0:
        raise InputError(
            "the material resists no change of shape: give it a coefficient of shear, such as c10."
        )
    strain = density * float(np.linalg.norm(gravity)) * length / stiffness
    if strain > _LARGEST_STRAIN:
        raise InputError(
            f"the mesh is {length:.3g} m across: with E = {1e-3 * stiffness:.3g} kPa its own "
            f"weight would strain it by {100.0 * strain:.0f} %; is its unit millimetres "
            f"(mesh.units=mm), or that of {next(iter(parameters))} not Pa?"
        )


def small_strain_stiffness(material: Material) -> float:
    """Mean Young's modulus of a material at small strains [Pa].

    Three shear moduli if that is no parameter.
    """
    parameters = {
        name: torch.as_tensor(value, dtype=torch.float64) for name, value in material.values.items()
    }
    if "youngs_modulus" in parameters:
        return mean_of(parameters["youngs_modulus"])
    terms = zip(material.moduli(parameters), material.curvature, material.rules, strict=True)
    return 1.5 * sum(
        mean_of(modulus) * factor for modulus, factor, rule in terms if rule == "shape"
    )


def mean_of(value: Any) -> float:
    """Mean of the values of a parameter."""
    return float(torch.as_tensor(value, dtype=torch.float64).detach().mean())
