"""A step of grippers in a grasp: two soft fingers with tendons close
on a soft ball on a table, and lift it.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch

from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.core.dynamics.solver_settings import SolverSettings
from warp_resphys.core.energies.contact.obstacle_contact import Contact
from warp_resphys.core.energies.contact.pairs import PairList, Surface
from warp_resphys.core.energies.contact.surface_contact import SurfaceContact
from warp_resphys.core.energies.contact.touching_bodies import HalfSpace
from warp_resphys.core.energies.launcher import Launcher
from warp_resphys.core.energies.materials import Corotated
from warp_resphys.core.energies.tendons import Tendons
from warp_resphys.core.fem.bodies import Body
from warp_resphys.core.fem.scene import Scene
from warp_resphys.core.mesh.boxes import box_hexahedra
from warp_resphys.core.mesh.selection import select_vertices
from warp_resphys.core.stepping.inputs import Inputs
from warp_resphys.environments.grippers import ball_mesh
from warp_resphys.experiment.build import choose_device

from .measuring import free_unknowns, now, solves, take_turns

LENGTH, SIDE = 0.08, 0.014  # of a finger [m]
RADIUS: Final = 0.012  # of the ball [m]
TABLE: Final = -0.083  # height of the table [m]
GAP: Final = 1.5e-3  # between a finger and the ball [m]
D: Final = 5e-4  # distance at which contact begins [m]
STIFFNESS: Final = 5e4  # [Pa]
FRICTION, SLIP_SPEED = 0.5, 5e-3  # 1, [m/s]
CLOSED, LIFTED = 0.2, 0.5  # times of a grasp [s]
RISE: Final = 0.03  # [m]
TIME_STEP: Final = 0.01  # [s]
TENSIONS: Final = (1.2, 1.8)  # of the first and the last gripper [N]; one alone has the largest
RUBBER: Final = Corotated(
    youngs_modulus=2.5e5, poissons_ratio=0.45, density=1070.0, stiffness_damping=4e-3
)
BATCHES: Final = {"cpu": (1, 16), "cuda": (1, 16, 256, 1024)}
STEPS: Final = round(LIFTED / TIME_STEP)


def finger(side: float, divisions: tuple[int, int, int]) -> Body:
    """Returns a finger that hangs beside the ball, with a tendon 3 mm below its inner face."""
    box, inner = box_hexahedra((SIDE, SIDE, LENGTH), divisions), RADIUS + GAP
    mesh = replace(
        box,
        vertices=box.vertices
        - [SIDE / 2, SIDE / 2, LENGTH]
        + [0.0, side * (inner + SIDE / 2), 0.0],
    )
    tendon = Tendons([[[0.0, side * (inner + 0.003), z] for z in np.linspace(0.0, -LENGTH, 11)]])
    return Body(mesh, fixed=select_vertices(mesh, z=0.0), energies=[tendon])


def grasp(
    arguments: argparse.Namespace, batch: int, contact: bool
) -> tuple[int, Callable[[], dict[str, float]]]:
    """Returns unknowns of a gripper, and a task: a batch of them closes on the ball and lifts it.

    The task returns the time of a step of all grippers, and how many hold the ball; without
    contact, fingers pass through it.
    """
    ball = ball_mesh(RADIUS, 4)
    ball = replace(ball, vertices=ball.vertices + [0.0, 0.0, TABLE + RADIUS + 0.9 * D])
    table = Contact(
        {"table": HalfSpace(position=(0.0, 0.0, TABLE))}, STIFFNESS, FRICTION, D, SLIP_SPEED
    )
    bodies = {
        name: finger(side, tuple(arguments.fingers))
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    bodies["ball"] = Body(ball, energies=[table] if contact else [])
    scene = Scene(bodies, SurfaceContact(STIFFNESS, FRICTION, D, SLIP_SPEED) if contact else None)
    solver = SolverSettings(relative_tolerance=1e-6, factors=arguments.factors)
    device = choose_device(arguments.device)
    simulator = Simulator(scene, RUBBER, TIME_STEP, solver=solver, device=device)
    tensions = simulator.tensor(np.linspace(TENSIONS[0 if batch > 1 else 1], TENSIONS[1], batch))
    times = TIME_STEP * simulator.tensor(1 + np.arange(STEPS))
    way = ((times - CLOSED) / (LIFTED - CLOSED)).clamp(0.0, 1.0)
    base = simulator.rest_positions[simulator.fixed].repeat(STEPS, 1, 1, 1)
    base[..., 2] += RISE * (0.5 - 0.5 * torch.cos(math.pi * way))[:, None, None]
    pull = Inputs(tendon_tension=((times / CLOSED).clamp_max(1.0)[:, None] * tensions)[..., None])
    fields = scene.inputs({"left": pull, "right": pull}).fields
    inputs = Inputs(fixed_positions=base.expand(-1, batch, -1, -1), **fields)
    start, of_ball = simulator.rest_state(batch), scene.vertex_slice("ball")

    @torch.no_grad()
    def lift() -> dict[str, float]:
        began = now(device)
        path = simulator.rollout(start, STEPS, inputs)
        seconds = (now(device) - began) / STEPS
        height = path.q[-1, :, of_ball, 2].mean(1) - start.q[:, of_ball, 2].mean(1)
        pairs = PairList(Launcher(batch, device), Surface.of(scene.mesh), D)
        crossings = sum(int(pairs.crossings(q)[0].sum()) for q in path.q[:: STEPS // 10].double())
        held = int((height > 0.9 * RISE).sum())
        return {
            "ms": 1e3 * seconds,
            "iterations": solves(path)["iterations"],
            "held": held,
            "crossings": crossings,
        }

    lift()  # compiles kernels
    return free_unknowns(simulator), lift


def measure_grippers(arguments: argparse.Namespace) -> dict[str, Any]:
    """Times a step of grippers, with contact and without."""
    rows = list[dict[str, Any]]()
    for batch in arguments.batches or BATCHES[choose_device(arguments.device).type]:
        (unknowns, lift), (_, without) = (
            grasp(arguments, batch, contact) for contact in (True, False)
        )
        (touching, free), _ = take_turns(f"{batch} grippers", [lift, without], arguments.repeats)
        ms = touching.pop("ms")
        head = {
            "grippers": batch,
            "unknowns": unknowns,
            "grasp_ms": ms,
            "steps_per_s": 1e3 * batch / ms,
        }
        rows.append(
            {
                **head,
                **touching,
                "without_contact_ms": free["ms"],
                "iterations_without": free["iterations"],
            }
        )
    return {f"a step of {1e3 * TIME_STEP:g} ms of all grippers": rows}
