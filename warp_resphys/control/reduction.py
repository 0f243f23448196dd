"""Makes a reduced model of a robot: equilibria, vibrations about them and motions, sampled within its inputs' range."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from scipy.stats import qmc

from ..io.errors import ConvergenceError
from ..learning.networks import Coder
from ..robot.robot import Robot
from ..robot.state import RobotState
from ..stepping.state import State
from .polynomials import Polynomial, solve_ridge
from .reduced import STATIC_ORDER, TANGENT_ORDER, USUAL_ORDER, ReducedModel, ReducedState
from .reduced_force import ReducedForce
from .sampling import Motions, OnProgress, Sampling, Source, Tangent, check_reducible, driven_input

FloatArray = NDArray[np.float64]

_LEAST_SETTLED: Final = 0.9  # of the equilibria
_WINDOW: Final = 0.3  # s, in which a motion is foretold to tell the error


class _Statics(NamedTuple):
    """S equilibria."""

    q: torch.Tensor  # (S, N, 3) [m]
    y: FloatArray  # (S, 3 M) what is observed [m]
    u: FloatArray  # (S, n) inputs as shares
    outputs: FloatArray | None  # (S, c) of the network


def reduce(robot: Robot, sampling: Sampling, on_progress: OnProgress = lambda steps: None) -> ReducedModel:
    """The reduced model of a robot.

    Args:
        robot: a simulator, with or without a learned force, that one input drives.
        sampling: how much is sampled.
        on_progress: told how many more of ``sampling.total`` are done.

    Raises:
        InputError: see `sampling.check_reducible` and `sampling.driven_input`.
        ConvergenceError: no equilibrium is found for inputs within the range of the trials, by the robot or by a model.
    """
    check_reducible(robot)
    source = Source(robot, driven_input(robot))
    motions = source.motions(sampling, on_progress)
    statics = _equilibria(source, sampling, on_progress)
    tangents = []
    for row in range(min(sampling.tangents, len(statics.u))):
        outputs = None if statics.outputs is None else statics.outputs[row]
        tangents.append(source.tangent(statics.q[row : row + 1], statics.u[row], max(sampling.modes), outputs))
        on_progress(1)
    on_progress(sampling.tangents - len(tangents))
    counts = {"asked": sampling.equilibria, "equilibria": len(statics.u), "tangents": len(tangents)}
    best, tried, failure = None, dict[str, float](), None
    for modes in sampling.modes:
        slowest = [each.slowest(modes) for each in tangents]
        try:
            made = _fitted(source, slowest, statics, motions, sampling.motions)
        except ConvergenceError as error:
            failure = error
            continue
        tried[str(modes)] = made.quality["window_relative"]
        if best is None or made.quality["window_error_mm"] < best.quality["window_error_mm"]:
            best = made
    if best is None:
        assert failure is not None
        raise failure
    return replace(best, quality={**best.quality, **counts, "motions": sampling.motions, "tried": tried})


def _fitted(
    source: Source, tangents: Sequence[Tangent], statics: _Statics, motions: Motions, first: int
) -> ReducedModel:
    """A model in as many coordinates as there are vibrations, fitted to the first motions and tried on the others.

    Raises:
        ConvergenceError: it comes to rest nowhere, or diverges.
    """
    made, z_statics, z, rates = _assembled(source, tangents, statics, motions)
    made = _with_output(
        made,
        (z_statics, statics.u, statics.y),
        (
            z[1:, :first].reshape(-1, made.modes),
            motions.acting[:, :first].reshape(-1, source.parts),
            motions.y[1:, :first].reshape(-1, motions.y.shape[2]),
        ),
    )
    frequency = np.sqrt(np.abs(np.linalg.eigvals(made.stiffness(statics.u[:1])[0]))) / (2.0 * np.pi)
    quality: dict[str, Any] = _errors(made, motions, z, rates, first)
    if not np.isfinite(quality["window_error_mm"]):
        raise ConvergenceError(f"the reduced model of {made.modes} modes diverges.", statics.q, None)
    return replace(made, quality={**quality, "modes": made.modes, "frequencies_hz": np.sort(frequency).tolist()})


def _equilibria(source: Source, sampling: Sampling, on_progress: OnProgress) -> _Statics:
    """Those under a low-discrepancy sequence of inputs, none at first.

    Raises:
        ConvergenceError: the robot rests under too few of them.
    """
    asked = sampling.equilibria
    unit = qmc.Sobol(source.parts, seed=sampling.seed).random(2 ** int(np.ceil(np.log2(max(asked, 2)))))[:asked]
    unit[0] = 0.0
    found = []
    with torch.no_grad():
        for some in np.array_split(unit, -(-asked // sampling.batch)):
            found.append(source.equilibria(some))
            on_progress(len(some))
        q, u = torch.cat([each[0] for each in found]), np.concatenate([each[1] for each in found])
        y = source.robot.observe(RobotState(State(q, torch.zeros_like(q)))).flatten(1).double().cpu().numpy()
    if len(u) < _LEAST_SETTLED * asked:
        raise ConvergenceError(
            f"the robot comes to rest under {len(u)} of {asked} inputs within its range: its learned force is too "
            "large for a reduced model.",
            q,
            None,
        )
    outputs = [each[2] for each in found if each[2] is not None]
    return _Statics(q, y, u, np.concatenate(outputs) if outputs else None)


def _assembled(
    source: Source, tangents: Sequence[Tangent], statics: _Statics, motions: Motions
) -> tuple[ReducedModel, FloatArray, FloatArray, FloatArray]:
    """The model without what is observed; coordinates (S, r) of the equilibria and (T + 1, B, r) of motions; rates.

    What the network's outputs at an equilibrium have beside the usual ones is taken from it by the model's own linear
    response, so that z_0 and p are as smooth as the body, however rough the network is.
    """
    known, unit = statics.u[: len(tangents)], statics.u
    shapes = torch.stack([each.shapes for each in tangents])  # (S', 3 N, r)
    projector = source.mass[:, None] * _common(shapes, source.mass)
    turned = torch.einsum("dr,sdk->srk", projector, shapes).cpu().numpy()
    back = np.linalg.inv(turned)
    z_statics = ((statics.q - source.rest).flatten(1).double() @ projector).cpu().numpy()
    z, rates = (
        torch.einsum("tbd,dr->tbr", each.flatten(2).double(), projector).cpu().numpy()
        for each in (motions.q - source.rest.float(), motions.v)
    )

    def tangent(values: FloatArray) -> Polynomial:
        return Polynomial.fitted(known, values, TANGENT_ORDER)

    stiffness = tangent(turned @ np.stack([each.stiffness for each in tangents]) @ back)
    damping = tangent(turned @ np.stack([each.damping for each in tangents]) @ back)
    z_usual, force = z_statics, None
    if statics.outputs is not None and source.learned is not None:
        network = source.learned.network
        push = tangent(turned @ np.stack([each.push for each in tangents if each.push is not None]))
        usual = Polynomial.fitted(unit, statics.outputs, USUAL_ORDER)
        moved = np.linalg.solve(stiffness(unit), push(unit) @ (statics.outputs - usual(unit))[..., None])[..., 0]
        z_usual = z_statics - moved
        both = [_modes_seen(coder, shapes, back) for coder in (network.position, network.velocity)]
        seen = tangent(np.stack([scipy.linalg.block_diag(*pair) for pair in zip(*both, strict=True)]))
        places = network.position.encode((statics.q - network.rest.to(statics.q)).double()).cpu().numpy()
        places = np.pad(places, ((0, 0), (0, both[1].shape[1])))  # The rates are zero.
        places = places - (seen(unit)[..., : shapes.shape[2]] @ moved[..., None])[..., 0]
        at_rest = Polynomial.fitted(unit, places, STATIC_ORDER)
        force = ReducedForce(network, source.learned.range_, at_rest, seen, *source.told(), usual, push)
    modes, labels = shapes.shape[2], source.robot.labels
    model = ReducedModel(
        source.robot.time_step,
        source.robot.simulator.integrator,
        labels,
        source.input.name,
        source.scale,
        source.delay,
        source.rise,
        source.filters,
        Polynomial.fitted(unit, z_usual, STATIC_ORDER),
        Polynomial(np.zeros((1, 3 * len(labels))), 0),
        stiffness,
        damping,
        tangent(np.stack([each.shown for each in tangents]) @ back),
        np.zeros((modes, modes, 3 * len(labels))),
        force,
    )
    return model, z_statics, z, rates


def _modes_seen(coder: Coder, shapes: torch.Tensor, back: FloatArray) -> FloatArray:
    """(S, m, r) the standardised modes of a coder by the coordinates; m is 0 for a network that sees none."""
    if coder.basis is None or not coder.size:
        return np.zeros((len(back), 0, back.shape[1]))
    basis = (coder.basis / coder.scale).to(shapes)
    return np.asarray(torch.einsum("dm,sdk->smk", basis, shapes).cpu().numpy() @ back)


def _common(shapes: torch.Tensor, mass: torch.Tensor) -> torch.Tensor:
    """(3 N, r) columns Psi, orthonormal in the mass, that span vibrations (S, 3 N, r) best."""
    root = mass.sqrt()[:, None]
    columns = (root * shapes).permute(1, 0, 2).flatten(1)
    found = torch.linalg.svd(columns, full_matrices=False)[0][:, : shapes.shape[2]]
    return torch.where(root > 0.0, found / root.clamp_min(1e-300), 0.0)


def _with_output(model: ReducedModel, rests: tuple[FloatArray, ...], motions: tuple[FloatArray, ...]) -> ReducedModel:
    """The same with y_0, of equilibria, and H, of motions.

    Both are coordinates (S, r), inputs (S, n) and what was observed (S, 3 M) [m]. In fast motions more modes take part
    than the model has: y_0, fitted to these too, would make up for them and be wrong at rest.
    """

    def left(z: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        off = z - model.static(u)
        return off, y - (model.shown(u) @ off[..., None])[..., 0]

    observed = Polynomial.fitted(rests[1], left(*rests)[1], model.static.order)
    off, rest = left(*motions)
    first, second = np.triu_indices(model.modes)
    curved = np.zeros((model.modes, model.modes, rest.shape[1]))
    curved[first, second] = 0.5 * solve_ridge(off[:, first] * off[:, second], rest - observed(motions[1]))
    return replace(model, observed=observed, curved=curved + curved.swapaxes(0, 1))


def _errors(model: ReducedModel, motions: Motions, z: FloatArray, rates: FloatArray, first: int) -> dict[str, float]:
    """How far the model is from the robot, over windows and over whole motions, from one on [mm]."""
    steps, chosen = round(_WINDOW / model.time_step), slice(first, None)
    z, rates, y, acting = (each[:, chosen] for each in (z, rates, motions.y, motions.acting))
    commands = motions.commands[:, chosen]
    memories = [model.response.still(np.zeros(commands.shape[1:]))]
    for now in commands:
        memories.append(model.response(memories[-1], now[None])[2])
    off, moved, looks = [], [], np.ones(z.shape[1], dtype=np.bool_)
    for at in range(2, len(commands) - steps, max(steps // 3, 1)):
        before = np.stack([z[at - 1], rates[at - 1]])
        start = ReducedState(z[at], rates[at], acting[at - 1], memories[at], before, looks)
        found, true = model.move(start, commands[at : at + steps] * model.scale).y, y[at + 1 : at + steps + 1]
        off.append(_distances(found, true).mean())
        moved.append(_distances(np.broadcast_to(y[at], true.shape), true).mean())
    whole = model.move(model.rest(count=z.shape[1]), commands * model.scale).y
    return {
        "window_s": _WINDOW,
        "window_error_mm": float(np.mean(off)),
        "window_motion_mm": float(np.mean(moved)),
        "window_relative": float(np.mean(off) / np.mean(moved)),
        "whole_error_mm": float(_distances(whole, y[1:]).mean()),
    }


def _distances(left: FloatArray, right: FloatArray) -> FloatArray:
    """(P, M) distances of points (P, 3 M), or with more axes [mm]."""
    return np.asarray(1e3 * np.linalg.norm(left.reshape(-1, 3) - right.reshape(-1, 3), axis=1))
