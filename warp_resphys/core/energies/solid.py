"""Energy of a solid: elasticity, and viscosity (Kelvin-Voigt and generalised Maxwell)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import scipy.sparse
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...io.errors import InputError
from ...kernels import elasticity as kernels
from ...kernels import lanes
from ..fem.bodies import Body
from ..fem.integration_points import Discretisation, Points, SolidPoints
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from ..stepping.state import Mass
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from .launcher import Launcher, struct_of
from .materials import Material
from .term import Kernel, PointSet, Slope, Values
from .viscosity import GreenStrain, StrainTerm, Viscosity

VISCOUS_STRAIN: Final = "viscous_strain"
# Values of a step (`energies.viscosity`).
VISCOUS: Final = ("viscosity", "strain_offset", "dilation_offset")


def device_matrix(
    matrix: scipy.sparse.sparray, device: torch.device, dtype: torch.dtype
) -> torch.Tensor:
    """Converts a SciPy matrix to a torch COO matrix on a device."""
    coo = matrix.tocoo()
    indices = torch.as_tensor(np.stack([coo.row, coo.col]).astype(np.int64))
    tensor = torch.sparse_coo_tensor(
        indices, torch.as_tensor(coo.data), coo.shape, check_invariants=False
    )
    return tensor.to(device=device, dtype=dtype).coalesce()


def spread(operator: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Returns the product (1 or B, rows) of a sparse (rows, M) operator
    with (1 or B, 1 or M) element values.

    Raises:
        InputError: values for another number of elements.
    """
    m = operator.shape[1]
    if values.shape[1] not in (1, m):
        raise InputError(
            f"a material parameter has {values.shape[1]} values for {m} elements: give one "
            f"value, one an element ({m}), or one an environment with shape (B, 1)."
        )
    return torch.sparse.mm(operator, values.expand(-1, m).mT).mT


@dataclass(frozen=True)
class Solid(Energy):
    """The energy of a material in a body or in a region of it.

    Values of a step are ``stiffness`` (B, P, T), the moduli times the points' volumes [J], and
    those of `energies.viscosity`: ``viscosity`` (B, 2), c and d; ``strain_offset`` (B, P, 3, 3), W;
    ``dilation_offset`` (B, P), w. Memory is ``viscous_strain`` (B, K, P, 3, 3), the strain in each
    Prony branch.

    Args:
        discretisation: discretisation of the body, or of some of its cells.
        material: the material.
        cells: (M,) indices of these cells; None: all cells.
    """

    discretisation: Discretisation
    material: Material
    cells: NDArray[np.int64] | None = None

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        return tuple(self.material.parameters.values())

    @property
    @override
    def defaults(self) -> Mapping[str, Parameter]:
        return self.material.values

    @property
    @override
    def count(self) -> int:
        return len(self.discretisation.element_volumes)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return ()  # Cells have no names.

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        return self.discretisation.point_sets

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "SolidTerm":
        shares = [_shares(points) for points in self.discretisation.point_sets]
        columns = [
            np.stack([by_rule[rule].sum(axis=1) for rule in self.material.rules], 1)
            for by_rule in shares
        ]
        return SolidTerm(launcher, sets, self.material, np.concatenate(columns))

    @override
    def bind(self, site: EnergySite) -> "BoundSolid":
        return BoundSolid(self, site)

    def kernel(self, device: torch.device) -> Any:
        """Returns a kernel of the module that evaluates the material on a device."""
        law = self.material.law
        several = any(points.points_per_cell > 1 for points in self.discretisation.point_sets)
        if device.type == "cpu" and several and law.has_lanes:
            return lanes.cell_step(law)
        return kernels.solid_kernels(law).local_step


def solids_of(body: Body, material: Material | Mapping[str, Material]) -> list[tuple[Solid, str]]:
    """Returns the solid of a body, or one solid per region with a material,
    each with the prefix of its names.

    Args:
        body: the body; its rigid parts have no material.
        material: material of the whole body, or materials by region.

    Raises:
        InputError: a cell outside the rigid parts belongs to no region with a material, or to
            several.
    """
    if isinstance(material, Material):
        cells = body.soft_cells
        if cells is not None and not len(cells):
            return []
        return [
            (
                Solid(
                    body.discretisation if cells is None else body.discretised(cells),
                    material,
                    cells,
                ),
                "",
            )
        ]
    regions = {name: body.mesh.region(name) for name in material}
    assigned = [*regions.values(), *map(body.mesh.region, body.rigid), np.zeros(0, dtype=np.int64)]
    owners = np.bincount(np.concatenate(assigned), minlength=len(body.mesh.cells))
    if (owners != 1).any():
        without, several = int((owners == 0).sum()), int((owners > 1).sum())
        raise InputError(
            f"the regions with a material ({', '.join(regions) or 'none'}) and the rigid parts "
            f"leave {without} of {len(owners)} cells without one, and give {several} more than "
            "one: each cell needs one."
        )
    return [
        (Solid(body.discretised(cells), material[name], cells), f"{name}_")
        for name, cells in regions.items()
    ]


def _shares(points: SolidPoints) -> dict[str, scipy.sparse.csr_array]:
    """Returns (P, M) matrices from cells to points, by the rule of a modulus:
    volumes [m^3], or weights of a mean.
    """
    total = points.shape_volume + points.volume_volume
    mean = scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / total.sum(axis=1)) @ total)
    return {"shape": points.shape_volume, "volume": points.volume_volume, "mean": mean}


class BoundSolid(BoundEnergy):
    """A solid in a simulator: stiffness, mass, and viscous strain."""

    def __init__(self, solid: Solid, site: EnergySite) -> None:
        super().__init__(solid, site)
        self._solid = solid
        like, sets = site.rest_positions, solid.discretisation.point_sets
        shares = [_shares(s) for s in sets]
        self._shares = {
            rule: device_matrix(
                scipy.sparse.vstack([by_rule[rule] for by_rule in shares]), like.device, like.dtype
            )
            for rule in set(solid.material.rules)
        }
        cells = slice(None) if solid.cells is None else solid.cells
        self._mass_volume, self._load_volume = (
            device_matrix(matrix[:, cells], like.device, like.dtype)
            for matrix in (site.mass_volume, site.load_volume)
        )
        shape = (len(solid.material.prony), sum(s.n_points for s in sets), 3, 3)
        self.memory = (Memory(VISCOUS_STRAIN, "strain", shape, "branch"),) if shape[0] else ()

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        material = self._solid.material
        rules = zip(
            material.rules, torch.broadcast_tensors(*material.moduli(parameters)), strict=True
        )
        damping = torch.cat(torch.broadcast_tensors(*material.viscosity(parameters)), 1)
        ratio = time = None
        if material.prony:
            branches = zip(*material.group("prony", parameters), strict=True)
            ratio, time = (torch.cat(torch.broadcast_tensors(*branch), 1) for branch in branches)
            if not (ratio.requires_grad or bool((ratio > 0).any())):
                ratio = time = None
        damped = damping.requires_grad or bool((damping > 0).any())
        return {
            "stiffness": torch.stack([spread(self._shares[rule], m) for rule, m in rules], dim=-1),
            "damping": damping if damped else None,
            "prony_ratio": ratio,
            "prony_time": time,
        }

    @override
    def mass(self, parameters: Mapping[str, torch.Tensor]) -> Mass:
        inertia, weight = (
            spread(volume, parameters["density"])
            for volume in (self._mass_volume, self._load_volume)
        )
        return Mass(inertia, weight, parameters["mass_damping"])

    def _viscosity(self, values: Values) -> Viscosity:
        damping = values["damping"]
        ratio, time = values["prony_ratio"], values["prony_time"]
        zero = self.site.rest_positions.new_zeros(1, 2)
        return Viscosity(zero if damping is None else damping, damping is not None, ratio, time)

    def _values(self, *values: torch.Tensor | None) -> dict[str, torch.Tensor | None]:
        return dict(zip(VISCOUS, values, strict=True))

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        carried = step.state.memory.get(VISCOUS_STRAIN)
        viscosity, strain = self._viscosity(step.values), partial(GreenStrain.apply, step.term)
        return self._values(
            *viscosity.step_values(strain, step.state.q, carried, step.stage, self.site.time_step)
        )

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        return self._values(self.site.rest_positions.new_zeros(batch, 2), None, None)

    @override
    def end_step(
        self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        viscosity = self._viscosity(step.values)
        if viscosity.ratio is None:
            return {}
        strain = partial(GreenStrain.apply, step.term)
        carried = step.state.memory.get(VISCOUS_STRAIN)
        return {
            VISCOUS_STRAIN: viscosity.relax(strain, step.state.q, carried, q, self.site.time_step)
        }


class SolidTerm(StrainTerm):
    """Kernels of a solid, whose points have the volumes ``carried`` (P, T)
    for each modulus of the material [m^3].
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        material: Material,
        carried: NDArray[np.float64],
    ) -> None:
        points, moduli = sum(s.n_points for s in sets), len(material.rules)
        shapes = ((points, moduli), (2,), (points, 3, 3), (points,))
        super().__init__(launcher, sets, dict(zip(("stiffness", *VISCOUS), shapes, strict=True)))
        self._law = law = material.law
        self._kernels, self._moduli = kernels.solid_kernels(law), moduli
        self._carried = carried
        self._lanes = dict[PointSet, Any]()
        self._curvature = torch.as_tensor(
            material.curvature, device=launcher.device, dtype=torch.float64
        )
        stiff = self._curvature > 0.0
        # a slice copies nothing
        self._stiff: torch.Tensor | slice = slice(None) if bool(stiff.all()) else stiff

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        at_points = {
            name: self.values[name][:, s.in_energy] for name in ("stiffness", *VISCOUS[1:])
        }
        values = struct_of(self._kernels.Values, viscosity=self.values["viscosity"], **at_points)
        return [s.points, values, positions]

    @override
    def step(self, s: PointSet, positions: Any) -> Kernel:
        cells = self.lane_cells(s)
        if cells is None:
            return super().step(s, positions)
        return Kernel(
            lanes.cell_step(self._law), [*self._arguments(s, positions), cells], by_cells=True
        )

    @override
    def tangent(self, s: PointSet, positions: Any) -> Kernel:
        cells = self.lane_cells(s)
        if cells is None:
            return super().tangent(s, positions)
        return Kernel(
            lanes.cell_tangent(self._law), [*self._arguments(s, positions), cells], by_cells=True
        )

    def lane_cells(self, s: PointSet) -> Any:
        """Returns the `kernels.lanes.LaneCells` of a set for kernels
        with one thread per cell, or None without.
        """
        if self.launcher.by_cells or not self._law.has_lanes:
            return None
        if s not in self._lanes:
            self._lanes[s] = self._lane_arrays(s)
        return self._lanes[s]

    def _lane_arrays(self, s: PointSet) -> Any:
        """Returns these, or None where cells have less than two points
        without a volume term before the others.
        """
        carried = self._carried[s.in_energy].reshape(s.cells, s.points_per_cell, self._moduli)
        with_volume = (carried[..., 1:] != 0.0).any((0, 2))
        count = int(np.argmax(with_volume)) if with_volume.any() else s.points_per_cell
        if count < 2:
            return None
        gradients = s.source.gradients
        width, nodes = lanes.WIDTH, s.nodes_per_cell
        groups = -(-count // width)
        chosen = np.minimum(np.arange(groups * width), count - 1)
        # (C, Q, K, 3) to (C, G, K, 3, points of a group)
        together = (
            gradients[:, chosen].reshape(s.cells, groups, width, nodes, 3).transpose(0, 1, 3, 4, 2)
        )
        by_nodes = np.pad(gradients.reshape(-1, nodes, 3), ((0, 0), (0, -nodes % width), (0, 0)))
        by_nodes = by_nodes.reshape(s.n_points, -1, width, 3).swapaxes(2, 3)
        arrays = {"together": together, "by_nodes": by_nodes}
        uploaded = {
            name: self.launcher.upload(array, lanes.lanes) for name, array in arrays.items()
        }
        return struct_of(lanes.LaneCells, **uploaded, shape_points=count)

    @override
    def curvature(self) -> torch.Tensor:
        return self.values["stiffness"] @ self._curvature

    @override
    def total_stiffness(self) -> torch.Tensor | None:
        return self.values["stiffness"][..., self._stiff].sum((1, 2))

    @override
    def _slopes(self) -> list[Slope]:
        n = self.n_points
        shapes = {
            "stiffness": (n, self._moduli),
            "viscosity": (n, 2),
            "strain_offset": (n, 3, 3),
            "dilation_offset": (n,),
        }
        kinds = (self._law.values, wp.vec2d, wp.mat33d, wp.float64)
        return [Slope(*item, kind) for item, kind in zip(shapes.items(), kinds, strict=True)]

    @override
    def _adjoint_inputs(self, s: PointSet, positions: Any, direction: Any) -> list[Any]:
        carried = self.launcher.upload(self._carried[s.in_energy], self._law.values)
        return [*self._arguments(s, positions), carried, direction]
