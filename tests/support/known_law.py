"""Motions of a small beam of a known law, for the identification of the law from them."""

from collections.abc import Mapping, Sequence

import torch

from warp_resphys import Body, Inputs, Simulator, SolverSettings, box_hexahedra, make_material, select_vertices
from warp_resphys.learning.law import KnownMotion

MESH = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))
TIP = select_vertices(MESH, x=0.08)
STIFF = {"c10": 3e4, "bulk_1": 3e6}  # Pa, of the weight
_BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
_TIGHT = SolverSettings("newton", relative_tolerance=1e-12)


def beam(constants: Mapping[str, float], integrator: str = "implicit_euler") -> Simulator:
    """A beam of a law, all of whose constants are given."""
    material = make_material("law", **constants)
    return Simulator(_BODY, material, time_step=0.005, solver=_TIGHT, integrator=integrator)


def pulled(pulls: Sequence[Sequence[float]]) -> torch.Tensor:
    """(B, N, 3) nodal forces of pulls (B, 3) at the tip [N]."""
    force = torch.zeros(len(pulls), len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP] = torch.tensor(pulls, dtype=torch.float64)[:, None] / len(TIP)
    return force


def released(sim: Simulator, pulls: Sequence[Sequence[float]], steps: int = 12) -> KnownMotion:
    """Motions of beams that are released from pulls (B, 3) at the tip [N]."""
    with torch.no_grad():
        held = sim.static_equilibrium(Inputs(external_force=pulled(pulls)))
        return KnownMotion(sim.rollout(held, steps).q, held.v)
