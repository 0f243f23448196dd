"""Speed of a grasp: two soft fingers with tendons close on a soft ball on a table, and lift it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final

import numpy as np
import torch
from pydantic import Strict

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.contact import Contact
from ..energies.launcher import Launcher
from ..energies.materials import Corotated
from ..energies.obstacles import HalfSpace
from ..energies.pairs import PairList, Surface
from ..energies.surfaces import SurfaceContact
from ..energies.tendons import Tendons
from ..experiment.build import choose_device
from ..fem.body import Body
from ..fem.scene import Scene
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import Natural, Positive, Settings, Word, setting
from ..mesh.mesh import box_hexahedra, select_vertices
from ..robot.gripper import thing_mesh
from ..stepping.inputs import Inputs
from .beam import Divisions
from .benchmark import Batches
from .tables import Sheet, show
from .timing import now, yardstick_seconds

LENGTH, SIDE, RADIUS, TABLE, GAP = 0.08, 0.014, 0.012, -0.083, 1.5e-3  # [m]
D: Final = 5e-4  # distance at which contact begins [m]
STIFFNESS, FRICTION, SLIP_SPEED = 5e4, 0.5, 5e-3  # [Pa], 1, [m/s]
CLOSED, LIFTED, RISE = 0.2, 0.5, 0.03  # times [s] and height [m] of a grasp
RUBBER: Final = Corotated(youngs_modulus=2.5e5, poissons_ratio=0.45, density=1070.0, stiffness_damping=4e-3)


class GripperStudy(Settings):
    """The configuration ``benchmark_gripper``, which explains its keys."""

    fingers: Divisions
    ball: Natural
    batches: Batches
    tensions: Annotated[tuple[Positive, Positive], Strict(False)] = setting(unit="N")
    time_step: Positive = setting(unit="s")
    relative_tolerance: Positive
    factors: Word
    repeats: Natural
    device: Word


def finger(side: float, divisions: Divisions) -> Body:
    """A finger that hangs beside the ball, with a tendon 3 mm below its inner face."""
    box = box_hexahedra((SIDE, SIDE, LENGTH), divisions)
    inner = RADIUS + GAP
    mesh = replace(box, vertices=box.vertices - [SIDE / 2, SIDE / 2, LENGTH] + [0.0, side * (inner + SIDE / 2), 0.0])
    tendon = Tendons([[[0.0, side * (inner + 0.003), z] for z in np.linspace(0.0, -LENGTH, 11)]])
    return Body(mesh, fixed=select_vertices(mesh, z=0.0), energies=[tendon])


@dataclass(frozen=True)
class SoftGrasp:
    """Grippers that close on a ball and lift it, one for every tension; without contact the fingers pass through it."""

    scene: Scene
    simulator: Simulator
    tensions: torch.Tensor  # (B,) [N]
    contact: bool

    @staticmethod
    def of(study: GripperStudy, batch: int, device: torch.device, contact: bool = True) -> "SoftGrasp":
        """Grippers whose tensions are spread evenly."""
        ball = thing_mesh("ball", RADIUS, study.ball)
        ball = replace(ball, vertices=ball.vertices + [0.0, 0.0, TABLE + RADIUS + 0.9 * D])
        table = Contact({"table": HalfSpace(position=(0.0, 0.0, TABLE))}, STIFFNESS, FRICTION, D, SLIP_SPEED)
        bodies = {"left": finger(-1.0, study.fingers), "right": finger(1.0, study.fingers)}
        bodies["ball"] = Body(ball, energies=[table] if contact else [])
        scene = Scene(bodies, SurfaceContact(STIFFNESS, FRICTION, D, SLIP_SPEED) if contact else None)
        solver = SolverSettings(relative_tolerance=study.relative_tolerance, factors=study.factors)
        simulator = Simulator(scene, RUBBER, study.time_step, solver=solver, device=device)
        least, largest = study.tensions
        shares = np.linspace(0.0, 1.0, batch) if batch > 1 else np.ones(1)
        return SoftGrasp(scene, simulator, simulator.tensor(least + (largest - least) * shares), contact)

    @property
    def steps(self) -> int:
        """Steps until the ball is lifted."""
        return round(LIFTED / self.simulator.time_step)

    @cached_property
    def inputs(self) -> Inputs:
        """Tensions and places of the bases over time."""
        times = self.simulator.time_step * self.simulator.tensor(1 + np.arange(self.steps))
        way = ((times - CLOSED) / (LIFTED - CLOSED)).clamp(0.0, 1.0)
        base = self.simulator.rest_positions[self.simulator.fixed].repeat(self.steps, 1, 1, 1)
        base[..., 2] += RISE * (0.5 - 0.5 * torch.cos(math.pi * way))[:, None, None]
        pull = ((times / CLOSED).clamp_max(1.0)[:, None] * self.tensions)[..., None]
        own = self.scene.inputs({name: Inputs(tendon_tension=pull) for name in ("left", "right")})
        return Inputs(fixed_positions=base.expand(-1, len(self.tensions), -1, -1), **own.fields)

    @torch.no_grad()
    def measure(self) -> dict[str, Any]:
        """Lifts the ball once: seconds of a step of all grippers, and the outcome."""
        start, inputs = self.simulator.rest_state(len(self.tensions)), self.inputs
        device = start.q.device
        began = now(device)
        path = self.simulator.rollout(start, self.steps, inputs)
        seconds = (now(device) - began) / self.steps
        ball = self.scene.vertex_slice("ball")
        height = path.q[-1, :, ball, 2].mean(1) - start.q[:, ball, 2].mean(1)
        result: dict[str, Any] = {
            "seconds": seconds,
            "iterations": float(np.mean([report.iterations.double().mean().item() for report in path.reports])),
            "held": int((height > 0.9 * RISE).sum()),
        }
        if self.contact:
            pairs = PairList(Launcher(len(self.tensions), device), Surface.of(self.scene.mesh), D)
            result["crossings"] = sum(
                int(pairs.crossings(q)[0].sum()) for q in path.q[:: max(self.steps // 10, 1)].double()
            )
        return result


def gripper_study(study: GripperStudy, folder: Path) -> None:
    """Prints the times of a step of grippers, with and without contact, and writes gripper_study.json.

    Raises:
        InputError: an unknown device, or wrong settings.
    """
    device = choose_device(study.device)
    rows, yardsticks = [], [yardstick_seconds()]
    batches = study.batches.on(device.type)
    with Progress("grasps", len(batches) * 2 * (1 + study.repeats), "grasps") as progress:
        for batch in batches:
            grasps = [SoftGrasp.of(study, batch, device, contact) for contact in (True, False)]
            results: list[list[Mapping[str, Any]]] = [[], []]
            for turn in range(1 + study.repeats):
                for own, grasp in zip(results, grasps, strict=True):
                    result = grasp.measure()
                    own += [result] if turn else []  # the first one compiles kernels
                    progress.advance()
            yardsticks.append(yardstick_seconds())
            touching, free = (median(float(result["seconds"]) for result in own) for own in results)
            simulator = grasps[0].simulator
            rows.append(
                {
                    "batch": batch,
                    "unknowns": 3 * (simulator.body.n_vertices - len(simulator.fixed)),
                    "grasp_ms": 1e3 * touching,
                    "free_ms": 1e3 * free,
                    "rate": batch / touching,
                    "share": free / touching,
                    **{name: results[0][-1][name] for name in ("iterations", "held", "crossings")},
                    "free_iterations": results[1][-1]["iterations"],
                }
            )
            write_json(
                folder / "gripper_study.json",
                {"hardware": hardware(), "yardstick_s": median(yardsticks), "study": study.plain(), "rows": rows},
            )
    columns = (
        "grippers {batch} | unknowns {unknowns} | grasp [ms] {grasp_ms:.4g} | without contact [ms] {free_ms:.4g} | "
        "steps/s {rate:.4g} | speed, of that without contact {share:.0%} | iterations {iterations:.1f} | "
        "without contact {free_iterations:.1f} | hold the ball {held} | crossings {crossings}"
    )
    title = f"A step of {1e3 * study.time_step:g} ms of all grippers"
    show(Sheet.of(title, columns, rows), f"Yardstick: {1e3 * median(yardsticks):.3g} ms.\n")
