"""Which element to take: static sag of the beam under its own weight and time of a step, by element and refinement."""

from pathlib import Path
from typing import Annotated

import warp as wp
from pydantic import Field

from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..fem.elements import VolumeIntegration
from ..io.settings import Natural, Some
from ..mesh.mesh import select_vertices
from ..stepping.inputs import Inputs
from .beam import ELEMENT_NAMES, BeamStudy, Divisions, beam_mesh, clamped
from .tables import Sheet, show
from .timing import step_time


class ElementStudy(BeamStudy):
    """The configuration ``benchmark_elements``, which explains its keys."""

    divisions: Divisions
    integrations: Some[VolumeIntegration]
    finest: Annotated[int, Field(ge=1, le=4)]
    steps: Natural


def element_study(study: ElementStudy, folder: Path) -> None:
    """Prints the table."""
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for refinement in range(1, study.finest + 1):
        for element, name in ELEMENT_NAMES.items():
            # Quadratic elements are twice as large as linear ones.
            linear = element in ("hexahedron8", "tetrahedron4")
            divisions = [refinement * (n if linear else (n + 1) // 2) for n in study.divisions]
            mesh = beam_mesh(element, study.size, divisions)
            for integration in study.integrations:
                body = clamped(mesh, volume_integration=integration)
                simulators = [Simulator(body, Corotated(study.youngs_modulus, nu)) for nu in study.poissons_ratios]
                sags = [f"{sag_mm(simulator):.3f}" for simulator in simulators]
                falling = [Inputs()] * study.steps  # from its straight shape
                cost = step_time(simulators[-1], simulators[-1].rest_state(), falling, study.repeats)
                rows.append([name, integration, str(len(mesh.vertices)), *sags, f"{cost['step_ms']:.2f}"])
    ratios = [f"nu {ratio:g}" for ratio in study.poissons_ratios]
    title = f"Static sag in mm, E {study.youngs_modulus / 1e3:g} kPa; time of a step, {ratios[-1]}"
    show(Sheet(title, ["element", "volume term", "vertices", *ratios, "step (ms)"], rows))


def sag_mm(simulator: Simulator) -> float:
    """Mean vertical displacement of the free face at rest under gravity [mm]."""
    mesh = simulator.body.mesh
    q = simulator.static_equilibrium().q[0].cpu().numpy()
    return float(1e3 * (q - mesh.vertices)[select_vertices(mesh, x=mesh.vertices[:, 0].max()), 2].mean())
