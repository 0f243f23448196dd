"""Estimated error of the deflection of a body of linear cells, from one equilibrium.

The strain E of linear cells jumps between neighbours. With the smooth strain S, whose values at the
vertices are means over the cells around them, the error of the energy is about the sum of
c V |E - S|^2 (Zienkiewicz and Zhu 1987), with the stiffness c of the material, and the deflection
under given loads grows by the same share of the sum of c V |E|^2. Cells that are long beside the
thickness of a body or of a stiff layer shear instead of bending, and tetrahedra lock. 8-node
hexahedra whose volume term is integrated at the centre miss the energy of volume changes that vary
in a cell, nu c V (tr E - mean)^2, and are too soft where there is a single one through the
thickness.

The first estimate is low where it is large. Both are verified against quadratic cells in
``tests/dynamics/test_mesh_error.py``.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.sparse
import torch

from ...io.arrays import FloatArray
from ...io.errors import warn
from ..energies.base import PlacedEnergy
from ..energies.solid import Solid
from ..energies.term import Values
from ..fem.bodies import Body
from ..mesh.elements import BY_NODES
from ..mesh.quality import is_one_cell_thick
from .plausibility import mean_of

NOTICED: Final = 0.07  # change of the deflection
_CHECKED: Final = 4  # equilibria of a simulator, as the first one is often that of its weight alone
_LEAST: Final = 1e-7  # strain, below which rounding dominates
_INCOMPRESSIBLE: Final = 0.5  # Poisson's ratio of materials without this parameter


class CellCheck:
    """Warns once of cells that are too coarse for one
    of the first equilibria of a simulator (`warn_of_cells`).

    Args:
        body: a body, or a `fem.scene.Scene`.
        placed: energies of its simulator.
    """

    def __init__(self, body: Body, placed: Sequence[PlacedEnergy]) -> None:
        self._body, self._placed = body, placed
        self._left = _CHECKED

    def __call__(self, q: torch.Tensor, values: Sequence[Values]) -> None:
        """Checks positions (B, N, 3) of equilibria [m], with values of every energy by name."""
        if self._left:
            at = q[0].detach().double().cpu().numpy()
            self._left = (
                0 if warn_of_cells(self._body, self._placed, at, values) else self._left - 1
            )


def warn_of_cells(
    body: Body, placed: Sequence[PlacedEnergy], q: FloatArray, values: Sequence[Values]
) -> bool:
    """Issues a `ResphysWarning` for each body whose deflection other cells would change by more
    than 7 %.

    Args:
        body: a body, or a `fem.scene.Scene`.
        placed: energies of its simulator.
        q: (N, 3) positions of an equilibrium [m].
        values: values of every energy by name (`stepping.state.Constants`).

    Returns:
        Whether there is such a body.
    """
    warned = False
    solids = [
        (item, item.energy, known)
        for item, known in zip(placed, values, strict=True)
        if isinstance(item.energy, Solid)
    ]
    for name, member, first in body.members:
        if member.mesh.element.parents:
            continue
        at, regions = q[first : first + member.n_vertices], dict[str, FloatArray]()
        for item, solid, known in solids:
            stiffness = known["stiffness"]
            if item.first == first and item.body is member and stiffness is not None:
                region = item.prefix.removeprefix(f"{name}_" if name else "").removesuffix("_")
                regions[region] = _energies(solid, at, stiffness[0].detach().double().cpu().numpy())
        energies = sum(regions.values(), np.zeros(4))
        if not energies[0] > _LEAST**2 * energies[3]:
            continue
        change = _change(energies)
        if abs(change) < NOTICED:
            continue
        simplex = member.mesh.element.is_simplex
        kind, order = (
            ("tetrahedra", " (in a configuration, mesh.order=2)") if simplex else ("hexahedra", "")
        )
        by = (
            f"at least {100.0 * change:.0f} % more"
            if change > 0.0
            else f"about {-100.0 * change:.0f} % less"
        )
        thin = [
            region
            for region in regions
            if region and is_one_cell_thick(member.mesh, member.mesh.region(region))
        ]
        where = f", with its region {thin[0]!r} of one cell through the thickness," if thin else ""
        warn(
            f"the linear {kind} of {f'the body {name!r}' if name else 'the body'}{where} are too "
            f"coarse for its equilibrium: with finer or quadratic ones it would deform by {by} "
            "(estimated from jumps of the strain between cells); take smaller cells, or "
            f"quadratic(mesh){order}."
        )
        warned = True
    return warned


def _change(energies: FloatArray) -> float:
    """Returns the relative change of the deflection from the energies of `_energies`."""
    whole, jumps, missing, _ = energies
    return float((1.0 + jumps / whole) / (1.0 + missing / whole) - 1.0)


def _energies(solid: Solid, q: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Returns c V |E|^2, c V |E - S|^2, nu c V (tr E - mean)^2 and c V,
    summed over a solid of linear cells (4,) [J].

    Args:
        solid: the solid.
        q: (N, 3) positions [m].
        stiffness: (P, T) its value of that name [J].
    """
    points = solid.discretisation.point_sets[0]
    nodes, element = points.nodes, BY_NODES[points.nodes.shape[1]]
    count = len(element.rule[1])
    gradients, cells = points.gradients[:, :count], len(nodes)
    f = np.einsum("cki,cqkj->cqij", q[nodes], gradients)
    strain = 0.5 * (np.einsum("cqki,cqkj->cqij", f, f) - np.eye(3))  # (C, Q, 3, 3)
    weights = (stiffness[: points.n_points] @ np.array(solid.material.curvature)).reshape(
        cells, -1
    )[:, :count]
    values, _ = element.shape(element.rule[0])  # (Q, K)
    # From points to nodes.
    outwards = np.ones((nodes.shape[1], 1)) if count == 1 else np.linalg.inv(values)
    at_nodes = np.einsum("kq,cqij->ckij", outwards, strain)
    volumes = solid.discretisation.element_volumes.repeat(nodes.shape[1])
    around = scipy.sparse.csr_array(
        (volumes, (nodes.ravel(), np.arange(nodes.size))), (len(q), nodes.size)
    )
    means = (
        around
        @ at_nodes.reshape(nodes.size, 9)
        / np.maximum(around.sum(axis=1), np.finfo(float).tiny)[:, None]
    )
    jumps = at_nodes - means.reshape(-1, 3, 3)[nodes]
    if count == 1:  # the mean square of a linear function over a tetrahedron
        square = (
            0.05 * (np.square(jumps.sum(1)).sum((1, 2)) + np.square(jumps).sum((1, 2, 3)))[:, None]
        )
    else:
        square = np.square(np.einsum("qk,ckij->cqij", values, jumps)).sum((2, 3))
    trace = np.trace(strain, axis1=2, axis2=3)
    centred = points.points_per_cell > count > 1
    poissons_ratio = (
        mean_of(solid.material.values.get("poissons_ratio", _INCOMPRESSIBLE)) if centred else 0.0
    )
    varying = poissons_ratio * np.square(trace - trace.mean(1, keepdims=True))
    return np.array(
        [(weights * part).sum() for part in (np.square(strain).sum((2, 3)), square, varying, 1.0)]
    )
