"""A step of an experiment's body, forward and backward: by solver,
material and batch, or by linear solver and size.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, Final

import numpy as np
import torch

from warp_resphys.core.dynamics.assembly import HessianAssembly
from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.core.linalg.threads import threads_for
from warp_resphys.core.stepping.inputs import Inputs
from warp_resphys.core.stepping.state import State
from warp_resphys.experiment.build import build_body, build_simulator, choose_device, finer
from warp_resphys.io.machine import peak_memory_gib
from warp_resphys.io.settings import parse
from warp_resphys.overrides import composed
from warp_resphys.settings.run import RunSettings

from .measuring import free_unknowns, median_ms, now, solves, take_turns

Rows = list[dict[str, Any]]
MATERIALS: Final[Mapping[str, Mapping[str, Any]]] = {
    "0.45": {"poissons_ratio": 0.45, "youngs_modulus": 215e3},
    "0.499": {"poissons_ratio": 0.499, "youngs_modulus": 264e3},
    "configured": {},
}
BATCHES: Final[Mapping[str, Sequence[int]]] = {"cpu": (1, 4, 16), "cuda": (1, 16, 256, 1024, 4096)}
FLOOR: Final = (
    "obstacles.floor={shape: half_space, position: [0.0, 0.0, -0.004]}",
    "contact.friction=0.3",
)
STEPS: Final = "a step of the whole batch"
_DEFAULTS: Final = ("solver.relative_tolerance=1e-6", "solver.max_iterations=20000")
_MODULUS: Final = "youngs_modulus"
_TIP_MASS: Final = 0.1  # [kg]
PRESSURE: Final = 2e4  # [Pa]


def task_of(
    settings: RunSettings,
    solver: str,
    material: str,
    batch: int,
    steps: int,
    straight: bool = False,
    pressure: float = PRESSURE,
) -> tuple[Simulator, Callable[[], dict[str, float]]]:
    """Returns the simulator of an experiment's body, and a task,
    which has run once and compiled kernels.

    The task times a step of the whole batch without gradients (plain; cpu: processor time of all
    threads), with them, and in the backward pass. The gradient is that of the sum of squares of the
    last state, with respect to the first state, a force on every vertex at every step, and Young's
    modulus.

    Args:
        settings: of a run.
        solver: its name.
        material: a key of `MATERIALS`.
        batch: number of environments.
        steps: of a roll-out.
        straight: whether the body starts from its shape at rest.
        pressure: largest one in chambers [Pa].
    """
    settings = settings.changed(solver=settings.solver.changed(name=solver))
    law = settings.simulation.changed(**MATERIALS[material])
    simulator = build_simulator(settings, law, build_body(settings))
    start, inputs = simulator.rest_state(batch), Inputs()
    if not straight:
        start, inputs = loaded(
            simulator, batch, steps, -1.0 if settings.obstacles else 1.0, pressure
        )
    parameters = (
        {_MODULUS: simulator.tensor([law.values[_MODULUS]])} if _MODULUS in law.values else {}
    )
    device = start.q.device

    def measure(steps: int = steps, inputs: Inputs = inputs) -> dict[str, float]:
        began, worked = now(device), time.process_time()
        with torch.no_grad():
            path = simulator.rollout(start, steps, inputs, parameters)
        plain, worked = now(device) - began, time.process_time() - worked
        q, v = (tensor.detach().clone().requires_grad_() for tensor in (start.q, start.v))
        force = q.new_zeros(steps, *q.shape).requires_grad_()
        moduli = {name: value.clone().requires_grad_() for name, value in parameters.items()}
        began = now(device)
        path = simulator.rollout(State(q, v), steps, inputs.replace(external_force=force), moduli)
        forward = now(device) - began
        loss = path.q[-1].square().sum() + path.v[-1].square().sum()
        began = now(device)
        torch.autograd.grad(loss, [q, v, force, *moduli.values()])
        backward = now(device) - began
        times = {
            "plain_ms": plain,
            "cpu_ms": worked,
            "forward_ms": forward,
            "backward_ms": backward,
        }
        speed = {"steps_per_s": batch * steps / plain, **solves(path)}
        return {**{name: 1e3 * seconds / steps for name, seconds in times.items()}, **speed}

    measure(2, Inputs(**{key: value[:2] for key, value in inputs.fields.items()}))
    return simulator, measure


def loaded(
    simulator: Simulator, batch: int, steps: int, sign: float = 1.0, largest: float = PRESSURE
) -> tuple[State, Inputs]:
    """Returns start and inputs of a roll-out: let go under a weight or,
    with chambers, at rest before pressures rise.

    The weight hangs at the end that is farthest from the fixed vertices along the body; it is
    lighter in each further environment, and lifts the end where ``sign`` is negative.
    """
    chambers = simulator.counts.get("pressure", 0)
    shares = simulator.tensor(np.arange(batch) / batch)
    if chambers:
        phase = simulator.tensor(np.arange(steps)[:, None, None] / steps)
        shift = simulator.tensor(np.arange(chambers) / chambers) + shares[:, None]
        pressure = 0.5 * largest * (1.0 - torch.cos(2.0 * torch.pi * (phase + shift)))  # (T, B, n)
        return simulator.static_equilibrium(Inputs(pressure=pressure[0])).detach(), Inputs(
            pressure=pressure
        )
    rest = simulator.rest_positions
    along = rest[:, int((rest.amax(0) - rest.amin(0)).argmax())]
    distance = (along - along[simulator.fixed].mean()).abs()
    tip = (distance > (1.0 - 1e-9) * distance.max()).to(rest.dtype)
    masses = sign * _TIP_MASS * (1.0 - 0.5 * shares)
    force = masses[:, None, None] * (tip / tip.sum())[:, None] * simulator.tensor(simulator.gravity)
    return simulator.static_equilibrium(Inputs(force)).detach(), Inputs()


def run_settings(arguments: argparse.Namespace, *overrides: str) -> RunSettings:
    """Returns the settings of a run, as the command line composes them."""
    overrides = (
        *_DEFAULTS,
        *arguments.settings,
        *overrides,
        f"device={choose_device(arguments.device)}",
    )
    return parse(RunSettings, composed("config", overrides))


def measure_steps(arguments: argparse.Namespace) -> dict[str, Any]:
    """Times steps and their parts."""
    device = choose_device(arguments.device)
    settings = run_settings(arguments, *(FLOOR if arguments.floor else ()))
    cases = [
        *product(arguments.solvers, arguments.materials, arguments.batches or BATCHES[device.type])
    ]
    simulators, tasks = zip(
        *(task_of(settings, *case, arguments.steps, pressure=arguments.pressure) for case in cases),
        strict=True,
    )
    measured, yardstick = take_turns("steps", tasks, arguments.repeats)
    steps, parts = Rows(), Rows()
    for (solver, material, batch), simulator, times in zip(
        cases, simulators, measured, strict=True
    ):
        head: dict[str, Any] = {"solver": solver, "material": material, "batch": batch}
        relative = {"yardsticks": (times["forward_ms"] + times["backward_ms"]) / yardstick}
        steps.append({**head, "unknowns": free_unknowns(simulator), **times, **relative})
        parts.append({**head, **part_times(simulator, batch, arguments.repeats)})
    return {"yardstick_ms": yardstick, STEPS: steps, "parts of an iteration": parts}


def part_times(simulator: Simulator, batch: int, repeats: int) -> dict[str, Any]:
    """Returns the median times of the parts of an iteration [ms]
    in the last state of a batch, of its first shard.
    """
    workspace = simulator.workspace(batch).parts[0][1]
    potential = workspace.potential
    linear = workspace.linear_solver(simulator.settings.linear_solver, simulator.dtype)
    assemble = HessianAssembly(potential, linear, workspace.pattern)
    potential.update_tangent()
    values = assemble().to(simulator.dtype, copy=True)
    factor = linear.factor(values.clone())
    right = torch.ones(potential.batch, linear.n, 1, device=potential.device, dtype=simulator.dtype)
    parts: dict[str, Callable[[], object]] = {
        "local_step": potential.evaluate,
        "tangent": potential.update_tangent,
        "assembly": assemble,
        "factor": lambda: linear.factor(values.clone()),
        "solve": lambda: factor.solve(right),
    }
    with threads_for(linear.n):  # as in a step
        times = {
            f"{name}_ms": median_ms(part, 5 * repeats, potential.device)
            for name, part in parts.items()
        }
    return {"linear_solver": type(linear).__name__, **times}


def measure_sizes(arguments: argparse.Namespace) -> dict[str, Any]:
    """Times a body that starts straight, by linear solver and size, one case after the other."""
    rows = Rows()
    for material, linear, refinement in product(
        arguments.materials, arguments.linear_solvers, arguments.refinements
    ):
        settings = run_settings(arguments, f"solver.linear_solver={linear}")
        if refinement != 1.0:
            settings = settings.changed(mesh=finer(settings.mesh, refinement))
        simulator, task = task_of(settings, "quasi_newton", material, 1, 2, straight=True)
        head = {"material": material, "linear_solver": linear, "unknowns": free_unknowns(simulator)}
        ((times,), _) = take_turns(f"{linear} {refinement:g}", [task], arguments.repeats)
        rows.append({**head, **times, "memory_gib": peak_memory_gib()})  # of this process, so far
    return {"a step by size": rows}
