"""A step of a roll-out with the reaction of its clamp,
over the same step without, for a beam and for SoPrA's arm.

Both alternate, and costs are medians over pairs. Kernels and the solver's copy of the gradient at
fixed vertices, less than 0.1 % of a step, are in both.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import torch

from warp_resphys.core.dynamics import time_step
from warp_resphys.core.dynamics.energy_set import EnergySet
from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.settings.run import RunSettings

from .measuring import free_unknowns, now, take_turns
from .steps import loaded, run_settings

BODIES: Final[Mapping[str, Sequence[str]]] = {"beam": (), "arm": ("experiment=sopra",)}


def measure_reactions(arguments: argparse.Namespace) -> dict[str, Any]:
    """Times a step of every body with and without its reaction.

    Returns:
        Of every body, medians of a step with the reaction [ms]: without gradients (plain), of the
        forward pass with them, of it and the backward pass of a loss on the last state (gradient),
        and of the backward pass of a loss on the reactions too; what the reaction adds to the first
        three [%]; and the time of the yardstick.
    """
    rows, yardsticks = list[dict[str, Any]](), list[float]()
    for name in arguments.bodies:
        settings = run_settings(arguments, *BODIES[name])
        simulator = build_simulator(settings, settings.simulation, build_body(settings))
        task = _pair(settings, simulator, arguments.steps)
        task()
        ((times,), yardstick) = take_turns(name, [task], arguments.repeats)
        head = {
            "body": name,
            "unknowns": free_unknowns(simulator),
            "fixed_vertices": len(simulator.fixed),
        }
        rows.append({**head, **times})
        yardsticks.append(yardstick)
    return {"a step with the reaction": rows, "yardstick_ms": float(np.median(yardsticks))}


def _pair(
    settings: RunSettings, simulator: Simulator, steps: int
) -> Callable[[], dict[str, float]]:
    """A task that makes roll-outs with and without the reaction, in an order that alternates."""
    start, inputs = loaded(simulator, 1, steps)
    modulus, numbers = "youngs_modulus", count()
    device, stiffness = start.q.device, simulator.tensor([settings.simulation.values[modulus]])

    def timed() -> dict[str, float]:
        began = now(device)
        with torch.no_grad():
            simulator.rollout(start, steps, inputs)
        plain, leaf = now(device) - began, stiffness.clone().requires_grad_()
        began = now(device)
        motion = simulator.rollout(start, steps, inputs, {modulus: leaf})
        forward = now(device) - began
        loss = motion.q[-1].square().sum() + motion.v[-1].square().sum()
        began = now(device)
        torch.autograd.grad(loss, leaf, retain_graph=True)
        times = {
            "plain_ms": plain,
            "forward_ms": forward,
            "gradient_ms": forward + now(device) - began,
        }
        if motion.reaction is not None:
            began = now(device)
            torch.autograd.grad(loss + motion.reaction.forces.square().sum(), leaf)
            times["backward_of_reactions_ms"] = now(device) - began
        return {name: 1e3 * seconds / steps for name, seconds in times.items()}

    def without() -> dict[str, float]:
        with (
            patch.object(time_step, "reaction_of", lambda *_: None),
            patch.object(EnergySet, "loads_at_fixed", lambda *_: None),
        ):
            return timed()

    def both() -> dict[str, float]:
        if next(numbers) % 2:
            less, whole = without(), timed()
        else:
            whole, less = timed(), without()
        costs = {
            f"{name.removesuffix('_ms')}_cost_percent": 100.0 * (whole[name] / less[name] - 1.0)
            for name in less
        }
        return {**whole, **costs}

    return both
