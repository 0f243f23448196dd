r"""Rigid parts as affine bodies, and inertia of dependent vertices.

A rigid part, a region of the mesh, is controlled by four of its vertices r_c (`fem.coordinates`)
and has a single deformation gradient F (Lan et al., Affine Body Dynamics, 2022). The energy
kappa V |F - R(F)|^2 keeps F close to a rotation. The inertial energy of the part is

    1 / 2 integral rho |x - y|^2 dV = rho / 2 sum_p |sum_c L_cp (r_c - y_c)|^2,
    L L^T = integral w w^T dV,

with the barycentric coordinates w: mass and inertia tensor of the cells are exact, and for a
rotation F the motion is that of a rigid body.
"""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...kernels import vertex_rotations as kernels
from ...kernels.axial import INERTIA
from ..fem.bodies import Body
from ..fem.coordinates import barycentric, weighted_sum
from ..fem.integration_points import Points, SolidPoints, volume_points
from ..fem.rigid_region import Rigid
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, parameter
from ..stepping.state import Mass
from .base import BoundEnergy, Energy, EnergySite, EnergyStep
from .launcher import Launcher
from .materials import Corotated
from .pointwise import one_part_each
from .solid import VISCOUS, SolidTerm
from .term import LawTerm, PartPoints, PointLaw, PointSet


@dataclass(frozen=True)
class _OnOwnPoints(Energy):
    """An energy on one set of points that is given and does not depend on the mesh."""

    part_points: Points

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        return (self.part_points,)


@dataclass(frozen=True)
class PointInertia(_OnOwnPoints):
    """Inertia of points.

    Values of a step are ``inertia`` (B, P) [N/m] and ``target`` (B, P, 3) [m].
    """

    part_points: PartPoints  # a part each

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        count = self.part_points.n_points
        shapes = {"target": (count, 3), "inertia": (count,)}
        law = PointLaw(INERTIA, stiffness=lambda v: v["inertia"])
        return LawTerm(launcher, sets, law, shapes, count)

    @override
    def bind(self, site: EnergySite) -> "BoundInertia":
        return BoundInertia(self, site)


class BoundInertia(BoundEnergy):
    """Inertia of dependent vertices in a simulator, which sets the values of a step."""

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        (points,) = self.site.points
        zeros = self.site.rest_positions.new_zeros(batch, points.n_points)
        return {"inertia": zeros, "target": zeros[..., None].expand(-1, -1, 3)}


@dataclass(frozen=True)
class RigidInertia(PointInertia):
    """Inertia and weight of a rigid part, with the parameter ``density`` [kg/m^3]."""

    cells: NDArray[np.int64]  # (m,)
    density: Parameter = parameter(MISSING, "density", "kg/m^3")

    @override
    def bind(self, site: EnergySite) -> "BoundRigidInertia":
        return BoundRigidInertia(self, site)


class BoundRigidInertia(BoundInertia):
    """The mass of a rigid part in a simulator."""

    def __init__(self, part: RigidInertia, site: EnergySite) -> None:
        super().__init__(part, site)
        self._controls = torch.as_tensor(site.points[0].nodes[0], device=site.rest_positions.device)
        self._factor = site.tensor(part.part_points.gradients[0, :, :, 0])  # (P, 4) L^T
        volume = site.load_volume[:, part.cells].sum(axis=1)
        self._volume = site.tensor(volume)  # (N,) volume whose weight acts at each vertex [m^3]

    @override
    def mass(self, parameters: Mapping[str, torch.Tensor]) -> Mass:
        weight = parameters["density"] * self._volume
        return Mass(torch.zeros_like(weight), weight, weight.new_zeros(1, 1))

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        inertia = step.value("density") / step.stage.step**2
        target = weighted_sum(self._factor, step.stage.target[:, self._controls, None].unbind(1))
        return {"inertia": inertia.expand(step.state.batch, len(self._factor)), "target": target}


@dataclass(frozen=True)
class Rigidity(_OnOwnPoints):
    """The energy kappa V |F - R(F)|^2 that keeps a part's deformation gradient close to a
    rotation.
    """

    part_points: SolidPoints  # a single point with the volume of the part
    stiffness: float  # kappa [Pa]
    centre: NDArray[np.float64]  # (4,) weights of the control vertices in the centre of mass

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "RigidityTerm":
        return RigidityTerm(launcher, sets, self)

    @override
    def bind(self, site: EnergySite) -> "BoundRigidity":
        return BoundRigidity(self, site)


class RigidityTerm(SolidTerm):
    """Kernels of the rigidity of a part.

    A solve begins where the deformation gradient of the part is a rotation: by inertia alone its
    vertices go straight on, and the part grows, which the stiff energy takes many iterations to
    undo.
    """

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], energy: Rigidity) -> None:
        volume = float(energy.part_points.shape_volume.sum())
        super().__init__(launcher, sets, Corotated(), np.array([[volume, 0.0]]))
        # Places (4, 3) of which the deformation gradient is the identity, about the centre of mass.
        corners = np.linalg.pinv(energy.part_points.gradients[0, 0]).T
        arms = corners - energy.centre @ corners
        self._centre = launcher.upload(energy.centre[None], wp.float64)
        self._arms = launcher.upload(arms[None], wp.vec3d)

    @override
    def improve_start(self, positions: Any) -> None:
        (s,), batch = self.sets, self.launcher
        inputs = [s.points, self._centre, self._arms]
        batch.run(kernels.straighten, (batch.batch, 1), inputs, [positions])


class BoundRigidity(BoundEnergy):
    """The rigidity of a part in a simulator."""

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        del parameters
        rigidity = self.energy
        assert isinstance(rigidity, Rigidity)
        scale = rigidity.stiffness * float(rigidity.part_points.shape_volume.sum())
        return {"stiffness": self.site.tensor([[[scale, 0.0]]])}

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        no_viscosity = self.site.rest_positions.new_zeros(batch, 2)
        return dict(zip(VISCOUS, (no_viscosity, None, None), strict=True))

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        return self.at_rest(step.state.batch)


def rigid_energies(body: Body, name: str, part: Rigid) -> list[Energy]:
    """Returns rigidity and inertia of a rigid part."""
    cells, controls = body.mesh.region(name), body.controls[name]
    corners = body.mesh.vertices[controls]
    # The gradients of barycentric coordinates do not depend on the orientation of the corners.
    gradients = np.linalg.inv(np.vstack([corners.T, np.ones(4)]))[:, :3]
    places, volumes = volume_points(body.mesh, cells)
    w, volume = barycentric(corners, places), float(volumes.sum())
    moments = np.einsum("p,pa,pb->ab", volumes, w, w)
    carried = scipy.sparse.csr_array(np.array([[volume]]))
    point = SolidPoints(
        controls[None], gradients[None, None], carried, scipy.sparse.csr_array((1, 1))
    )
    operators = np.asarray(np.linalg.cholesky(moments).T[None, :, :, None], dtype=np.float64)
    inertia = RigidInertia(one_part_each(Points(controls[None], operators)), cells, part.density)
    return [Rigidity(point, part.stiffness, moments.sum(0) / volume), inertia]
