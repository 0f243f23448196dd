"""Fits a reduced model to a robot: to equilibria, vibrations about them,
and motions, sampled in its input range.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import scipy.linalg
import torch
from numpy.typing import ArrayLike

from ..core.stepping.state import State
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, DataFileError
from ..io.progress import Progress
from ..io.safe_files import to_plain
from ..learning.residuals.coders import Coder
from ..robot.construction import Plain
from ..robot.robot import Robot
from ..settings.control import ReductionSettings
from .control_files import read_reduced, reduced_file, write_reduced
from .polynomials import Polynomial, SquaredPolynomial, best_order, solve_ridge
from .reduced_force import ReducedForce
from .reduced_model import ReducedModel, ReducedState
from .sampling import Motions, OnProgress, Source, Tangent, check_reducible, driven_input

log = logging.getLogger(__name__)

_MUCH: Final = 0.1  # error of a model over the motion, above which a warning is logged
STATIC_ORDER: Final = 3  # at least, as are those of the tangents
TANGENT_ORDER: Final = 2
USUAL_ORDER: Final = 1
_BATCH: Final = 32  # equilibria that are computed at once
_LEAST_SETTLED: Final = 0.9  # share of the sampled inputs that must have an equilibrium
_WINDOW: Final = 0.3  # length of the predictions that measure the error [s]


class _Statics(NamedTuple):
    """S equilibria."""

    q: torch.Tensor  # (S, N, 3) [m]
    y: FloatArray  # (S, 3 M) observed points [m]
    commands: FloatArray  # (S, n) in the unit of the input
    u: FloatArray  # (S, n) inputs in units of the scale
    outputs: FloatArray | None  # (S, c) of the network


def reduced_of(robot: Robot) -> ReducedModel:
    """Returns the reduced model of a robot, from its run's folder.

    It is computed and kept there the first time.

    That of a robot with other parameters than its run has identified is not kept. A twin and
    environments use it.

    Raises:
        InputError: the robot cannot be reduced.
        ConvergenceError: it has no equilibrium for inputs in the range of its trials.
    """
    check_reducible(robot)
    path = None if robot.folder is None else robot.folder / reduced_file(robot.description.model)
    model = None
    if path is not None and path.exists():
        with suppress(DataFileError):  # Of an earlier version, or damaged.
            model = read_reduced(path, robot.description.learned)
    if model is None or model.robot != fingerprint(robot):
        samples = ReductionSettings()
        with Progress("reduced model", samples.total, "samples") as progress:
            model = reduce(robot, samples, on_progress=progress.advance)
        identified = robot.with_parameters(**robot.description.parameters)
        if path is not None and model.robot == fingerprint(identified):
            try:
                write_reduced(path, model)
            except DataFileError as error:
                log.warning("The reduced model is not kept for the next time: %s", error)
    off, moved = model.quality["window_error_mm"], model.quality["window_motion_mm"]
    if off > _MUCH * moved:
        log.warning(
            "The reduced model is %.2g mm off in motions of %.2g mm: "
            "compare it with the full simulator.",
            off,
            moved,
        )
    return model


def reduce(
    robot: Robot,
    samples: ReductionSettings,
    seed: int = 0,
    on_progress: OnProgress = lambda steps: None,
) -> ReducedModel:
    """Fits the reduced model of a robot.

    Args:
        robot: a simulator, with or without a learned force, driven by one input.
        samples: amount of samples.
        seed: of the random inputs.
        on_progress: called with the number of further samples done, of ``samples.total``.

    Raises:
        InputError: the robot cannot be reduced, or is not driven by exactly one input.
        ConvergenceError: the robot or the reduced model has no equilibrium for inputs in the range
            of the trials.
    """
    check_reducible(robot)
    source = Source(robot, driven_input(robot))
    motions = source.motions(samples, seed, on_progress)
    statics = _equilibria(source, samples.equilibria, seed, on_progress)
    tangents = []
    for row in range(min(samples.tangents, len(statics.u))):
        outputs = None if statics.outputs is None else statics.outputs[row]
        tangents.append(
            source.tangent(
                statics.q[row : row + 1], statics.commands[row], max(samples.modes), outputs
            )
        )
        on_progress(1)
    on_progress(samples.tangents - len(tangents))
    counts = {"asked": samples.equilibria, "equilibria": len(statics.u), "tangents": len(tangents)}
    models, failures = [], []
    for modes in samples.modes:
        slowest = [tangent.slowest(modes) for tangent in tangents]
        try:
            models.append(_fitted(source, slowest, statics, motions, samples.motions))
        except ConvergenceError as error:
            failures.append(error)
    if not models:
        raise failures[-1]
    best = min(models, key=lambda model: model.quality["window_error_mm"])
    best = replace(best, robot=fingerprint(robot))
    tried = {str(model.modes): model.quality["window_relative"] for model in models}
    return replace(
        best, quality={**best.quality, **counts, "motions": samples.motions, "tried": tried}
    )


def fingerprint(robot: Robot) -> str:
    """Returns a digest of everything that a robot's reduced model depends on,
    except the amount of samples.
    """
    about, learned = robot.description, robot.description.learned
    arrays: dict[str, ArrayLike] = {
        name: value.numpy(force=True) for name, value in robot.parameters.items()
    }
    arrays |= {"mesh": about.mesh.vertices, "cells": about.mesh.cells}
    arrays |= {} if about.bound is None else {"bound": about.bound.numpy(force=True)}
    if learned is not None:
        arrays |= {
            name: value.numpy(force=True) for name, value in learned.network.state_dict().items()
        }
    of_simulator = Plain({})
    plain = [*about.made_of(of_simulator), about.seen, about.placement, robot.labels]
    arrays |= {name: tensor.numpy() for name, tensor in of_simulator.tensors.items()}
    plain += [{name: network.plain()} for name, network in about.actuator.items()]
    made = hashlib.sha256(
        json.dumps(to_plain([*plain, robot.simulator.integrator, robot.time_step])).encode()
    )
    for name, array in sorted(arrays.items()):
        made.update(name.encode() + np.ascontiguousarray(array, dtype=np.float32).tobytes())
    return made.hexdigest()


def _fitted(
    source: Source, tangents: Sequence[Tangent], statics: _Statics, motions: Motions, first: int
) -> ReducedModel:
    """Fits a model with a coordinate for each vibration to the first motions,
    and measures its error on the others.

    Raises:
        ConvergenceError: the model has no equilibrium, or diverges.
    """
    model, z_statics, z, rates = _assembled(source, tangents, statics, motions)
    model = _with_output(
        model,
        (z_statics, statics.u, statics.y),
        (
            z[1:, :first].reshape(-1, model.modes),
            motions.acting[:, :first].reshape(-1, len(source.moving)),
            motions.y[1:, :first].reshape(-1, motions.y.shape[2]),
        ),
    )
    frequency = np.sqrt(np.abs(np.linalg.eigvals(model.stiffness(statics.u[:1])[0]))) / (
        2.0 * np.pi
    )
    quality: dict[str, Any] = _errors(model, motions, z, rates, first)
    if not np.isfinite(quality["window_error_mm"]):
        raise ConvergenceError(
            f"the reduced model of {model.modes} modes diverges.", statics.q, None
        )
    return replace(
        model,
        quality={**quality, "modes": model.modes, "frequencies_hz": np.sort(frequency).tolist()},
    )


def _equilibria(source: Source, asked: int, seed: int, on_progress: OnProgress) -> _Statics:
    """Equilibria under a low-discrepancy sequence of inputs, the first of which is zero.

    Raises:
        ConvergenceError: the robot has an equilibrium under too few of the inputs.
    """
    from scipy.stats import qmc

    unit = qmc.Sobol(source.parts, seed=seed).random(2 ** int(np.ceil(np.log2(max(asked, 2)))))
    unit = unit[:asked]
    commands = source.commands(unit)
    commands[0] = np.clip(0.0, *source.commands(np.array([[0.0], [1.0]])))
    batches = []
    with torch.no_grad():
        for some in np.array_split(commands, -(-asked // _BATCH)):
            batches.append(source.equilibria(some))
            on_progress(len(some))
        q = torch.cat([batch[0] for batch in batches])
        commands = np.concatenate([batch[1] for batch in batches])
        y = source.robot.observe(State(q, torch.zeros_like(q))).flatten(1).double().cpu().numpy()
    if len(commands) < _LEAST_SETTLED * asked:
        raise ConvergenceError(
            f"the robot has an equilibrium under {len(commands)} of {asked} inputs in its range: "
            "its learned force is too large for a reduced model.",
            q,
            None,
        )
    outputs = [batch[2] for batch in batches if batch[2] is not None]
    return _Statics(
        q, y, commands, source.acting(commands), np.concatenate(outputs) if outputs else None
    )


class _Subspace(NamedTuple):
    """The coordinates of a model, and those of its samples."""

    basis: torch.Tensor  # Psi, (3 N, r)
    shapes: torch.Tensor  # (S', 3 N, r) vibrations about S' of the equilibria
    turned: FloatArray  # T, (S', r, r) of these
    statics: FloatArray  # (S, r) of the equilibria
    z: FloatArray  # (T + 1, B, r) of the motions
    rates: FloatArray  # (T + 1, B, r) [1/s]


def _subspace(
    source: Source, tangents: Sequence[Tangent], statics: _Statics, motions: Motions
) -> _Subspace:
    """Returns the common subspace of vibrations, and the samples in its coordinates."""
    shapes = torch.stack([tangent.shapes for tangent in tangents])
    basis = _common(shapes, source.mass)
    projector = source.mass[:, None] * basis
    turns = np.linalg.svd(torch.einsum("dr,sdk->srk", projector, shapes).cpu().numpy())
    z_statics = ((statics.q - source.rest).flatten(1).double() @ projector).cpu().numpy()
    z, rates = (
        torch.einsum("tbd,dr->tbr", field.flatten(2).double(), projector).cpu().numpy()
        for field in (motions.q - source.rest.float(), motions.v)
    )
    # T is nearly orthogonal, but singular where a vibration leaves the subspace.
    return _Subspace(basis, shapes, turns.U @ turns.Vh, z_statics, z, rates)


def _assembled(
    source: Source, tangents: Sequence[Tangent], statics: _Statics, motions: Motions
) -> tuple[ReducedModel, FloatArray, FloatArray, FloatArray]:
    """Fits the dynamics of the model, without y_0 and H.

    Returns:
        The model, coordinates (S, r) of the equilibria, and coordinates and rates (T + 1, B, r) of
        the motions.
    """
    space, u = _subspace(source, tangents, statics, motions), statics.u
    turned, known = space.turned, u[: len(tangents)]
    stiff = turned @ np.stack([tangent.stiffness for tangent in tangents]) @ turned.mT
    order = best_order(u, statics.y, STATIC_ORDER)
    tangent_order = best_order(known, stiff, TANGENT_ORDER)

    def fitted(values: FloatArray) -> Polynomial:
        return Polynomial.fitted(known, values, tangent_order)

    def squared(values: FloatArray) -> SquaredPolynomial:
        """Fits matrices (S', ..., r, r) of the vibrations."""
        turn = turned.reshape(
            len(tangents), *np.ones(values.ndim - 3, dtype=int), *turned.shape[1:]
        )
        return SquaredPolynomial.fitted(
            known, turn @ values @ turn.mT, max(tangent_order, STATIC_ORDER)
        )

    stiffness = fitted(stiff)
    force, moved = _reduced_force(source, tangents, statics, space, stiffness, order, fitted)
    static, psi = Polynomial.fitted(u, space.statics - moved, order), space.basis.cpu().numpy()
    shape = (statics.q - source.rest).flatten(1).double().cpu().numpy() - (
        space.statics - static(u)
    ) @ psi.T
    modes, points = psi.shape[1], 3 * len(source.robot.labels)
    model = ReducedModel(
        source.robot.time_step,
        source.robot.simulator.integrator,
        source.robot.labels,
        source.input.name,
        source.scale,
        source.range,
        source.acts,
        source.filters,
        source.times,
        static,
        Polynomial(np.zeros((1, points)), 0),
        stiffness,
        squared(np.stack([tangent.damping for tangent in tangents])),
        fitted(np.stack([tangent.shown for tangent in tangents]) @ turned.mT),
        squared(np.stack([tangent.branches for tangent in tangents])),
        Polynomial.fitted(u, shape, order),
        psi,
        np.zeros((modes, modes, points)),
        force,
    )
    return model, space.statics, space.z, space.rates


def _reduced_force(
    source: Source,
    tangents: Sequence[Tangent],
    statics: _Statics,
    space: _Subspace,
    stiffness: Polynomial,
    order: int,
    fitted: Callable[[FloatArray], Polynomial],
) -> tuple[ReducedForce | None, FloatArray]:
    """Returns the learned force of a model, and by how much (S, r) the deviation
    of its outputs moves the equilibria.

    This deviation from c_0 is subtracted through the model's linear response, so that z_0 and p are
    smooth functions of the inputs even if the network is not.
    """
    if statics.outputs is None or source.learned is None:
        return None, np.zeros_like(space.statics)
    u, back = statics.u, space.turned.mT
    network = source.learned.network
    push = fitted(
        space.turned @ np.stack([tangent.push for tangent in tangents if tangent.push is not None])
    )
    usual = Polynomial.fitted(u, statics.outputs, USUAL_ORDER)
    off = push(u) @ (statics.outputs - usual(u))[..., None]
    moved: FloatArray = np.asarray(np.linalg.solve(stiffness(u), off)[..., 0], dtype=np.float64)
    both = [
        _modes_seen(coder, space.shapes, back) for coder in (network.position, network.velocity)
    ]
    seen = fitted(np.stack([scipy.linalg.block_diag(*pair) for pair in zip(*both, strict=True)]))
    places = (
        network.position.encode((statics.q - network.rest.to(statics.q)).double()).cpu().numpy()
    )
    places = np.pad(places, ((0, 0), (0, both[1].shape[1])))  # The rates are zero.
    places = places - (seen(u)[..., : moved.shape[1]] @ moved[..., None])[..., 0]
    at_rest = Polynomial.fitted(u, places, order)
    return ReducedForce(
        network, source.learned.range_, at_rest, seen, *source.conditions(), usual, push
    ), moved


def _modes_seen(coder: Coder, shapes: torch.Tensor, back: FloatArray) -> FloatArray:
    """Standardised modes of a coder as functions of the coordinates, (S, m, r).

    M is 0 without modes.
    """
    if coder.basis is None or not coder.size:
        return np.zeros((len(back), 0, back.shape[1]))
    basis = (coder.basis / coder.scale).to(shapes)
    return np.asarray(torch.einsum("dm,sdk->smk", basis, shapes).cpu().numpy() @ back)


def _common(shapes: torch.Tensor, mass: torch.Tensor) -> torch.Tensor:
    """Basis Psi (3 N, r), orthonormal in the mass, of the best common subspace
    of vibrations (S, 3 N, r).

    In that subspace it is closest to the first of them, so that A is nearly diagonal there.
    """
    root = mass.sqrt()[:, None]
    columns = (root * shapes).permute(1, 0, 2).flatten(1)
    basis = torch.linalg.svd(columns, full_matrices=False)[0][:, : shapes.shape[2]]
    turn = torch.linalg.svd(basis.mT @ (root * shapes[0]))
    return torch.where(root > 0.0, basis @ turn.U @ turn.Vh / root.clamp_min(1e-300), 0.0)


def _with_output(
    model: ReducedModel, rests: tuple[FloatArray, ...], motions: tuple[FloatArray, ...]
) -> ReducedModel:
    """Adds y_0, fitted to equilibria, and H, fitted to motions.

    Both arguments are coordinates (S, r), inputs (S, n) and observed points (S, 3 M) [m]. Fast
    motions excite more modes than the model has; fitted to them as well, y_0 would compensate for
    these and be wrong at rest.
    """

    def residual(z: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        off = z - model.static(u)
        return off, y - (model.shown(u) @ off[..., None])[..., 0]

    observed = Polynomial.fitted(rests[1], residual(*rests)[1], model.static.order)
    off, remainder = residual(*motions)
    first, second = np.triu_indices(model.modes)
    curved = np.zeros((model.modes, model.modes, remainder.shape[1]))
    curved[first, second] = 0.5 * solve_ridge(
        off[:, first] * off[:, second], remainder - observed(motions[1]), common_scale=True
    )
    return replace(model, observed=observed, curved=curved + curved.swapaxes(0, 1))


def _errors(
    model: ReducedModel, motions: Motions, z: FloatArray, rates: FloatArray, first: int
) -> dict[str, float]:
    """Distances of the model from the robot over windows and whole motions,
    for the motions from ``first`` on [mm].
    """
    steps = round(_WINDOW / model.time_step)
    z, rates, y, acting, commands = (
        series[:, first:] for series in (z, rates, motions.y, motions.acting, motions.commands)
    )
    memories = [model.response.steady(np.zeros(commands.shape[1:]))]
    strains = [np.zeros((len(model.times), *z.shape[1:]))]
    for number, now in enumerate(commands):
        memories.append(model.response(memories[-1], now[None])[2])
        strains.append(model.relaxed(strains[-1], z[number + 1] - z[number]))
    off, moved = [], []
    looks = np.ones(z.shape[1], dtype=np.bool_)
    for at in range(2, len(commands) - steps, max(steps // 3, 1)):
        before = np.stack([z[at - 1], rates[at - 1]])
        start = ReducedState(
            z[at],
            rates[at],
            strains[at],
            acting[at - 1],
            memories[at],
            before,
            looks,
            ~looks,
            ~looks,
        )
        predicted = model.respond(start, commands[at : at + steps])
        true = y[at + 1 : at + steps + 1]
        off.append(_distances(predicted, true).mean())
        moved.append(_distances(np.broadcast_to(y[at], true.shape), true).mean())
    whole = model.respond(model.rest(), commands)
    return {
        "window_s": _WINDOW,
        "window_error_mm": float(np.mean(off)),
        "window_motion_mm": float(np.mean(moved)),
        "window_relative": float(np.mean(off) / np.mean(moved)),
        "whole_error_mm": float(_distances(whole, y[1:]).mean()),
    }


def _distances(left: FloatArray, right: FloatArray) -> FloatArray:
    """Distances between corresponding points of two arrays (..., 3 M), flattened [mm]."""
    return np.asarray(1e3 * np.linalg.norm(left.reshape(-1, 3) - right.reshape(-1, 3), axis=1))
