"""Which element to take: static sag of the beam under its own weight and time of a step, by element and refinement."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..experiment.schema import at_most, check
from ..fem.body import Body
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .command import show, table_of

_FINEST = 4


def element_study(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the table.

    Raises:
        InputError: a value that cannot be used.
    """
    check("finest", config["finest"], at_most(_FINEST))
    wp.config.log_level = wp.LOG_WARNING
    ratios = list(config["poissons_ratios"])
    rows = []
    for refinement in range(1, config["finest"] + 1):
        for element, mesh in _meshes(config["size"], config["divisions"], refinement).items():
            for integration in config["integrations"]:
                body = Body(mesh, fixed=select_vertices(mesh, x=0.0), volume_integration=integration)
                simulators = [Simulator(body, Corotated(config["youngs_modulus"], ratio)) for ratio in ratios]
                sags = [f"{sag_mm(simulator):.3f}" for simulator in simulators]
                falling = [Inputs()] * config["steps"]  # from its straight shape
                cost = step_time(simulators[-1], simulators[-1].rest_state(), falling, config["repeats"])
                rows.append([element, integration, str(len(mesh.vertices)), *sags, f"{cost['step_ms']:.2f}"])
    title = f"Static sag in mm, E {config['youngs_modulus'] / 1e3:g} kPa; what a step costs, nu {ratios[-1]:g}"
    headings = ["element", "volume term", "vertices", *(f"nu {ratio:g}" for ratio in ratios), "step (ms)"]
    show(table_of(title, headings, rows))


def sag_mm(simulator: Simulator) -> float:
    """Mean vertical displacement of the free face at rest under gravity [mm]."""
    mesh = simulator.body.mesh
    q = simulator.static_equilibrium().q[0].cpu().numpy()
    return float(1e3 * (q - mesh.vertices)[select_vertices(mesh, x=mesh.vertices[:, 0].max()), 2].mean())


def step_time(simulator: Simulator, start: State, inputs: Sequence[Inputs], repeats: int) -> dict[str, float]:
    """Milliseconds of a processor, and solver iterations, of a step, in the mean over a roll-out.

    Milliseconds are the median over repetitions of each step.

    Args:
        simulator: that steps.
        start: of the roll-out.
        inputs: of each step.
        repeats: of the roll-out, after a first one that is not timed.
    """
    times = np.empty((1 + repeats, len(inputs)))  # [ms]
    iterations = []
    prepared = simulator.prepare()
    with torch.no_grad():
        for row in times:
            state = start
            for step, each in enumerate(inputs):
                began = time.process_time()
                state, report = simulator.step(state, each, prepared)
                row[step] = 1e3 * (time.process_time() - began)
                iterations.append(float(report.iterations[0]))
    return {"step_ms": float(np.median(times[1:], axis=0).mean()), "iterations": float(np.mean(iterations))}


def _meshes(size: Sequence[float], divisions: Sequence[int], refinement: int) -> dict[str, Mesh]:
    """A box of every kind of element; quadratic ones are twice as large as linear ones."""
    half = [refinement * ((n + 1) // 2) for n in divisions]
    divisions = [refinement * n for n in divisions]
    return {
        "8-node hexahedra": box_hexahedra(size, divisions),
        "20-node hexahedra": box_hexahedra(size, half, nodes=20),
        "27-node hexahedra": box_hexahedra(size, half, nodes=27),
        "4-node tetrahedra": box_tetrahedra(size, divisions),
        "10-node tetrahedra": box_tetrahedra(size, half, order=2),
    }
