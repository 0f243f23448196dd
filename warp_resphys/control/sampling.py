"""Samples of a robot for its reduced model: motions, equilibria, and the vibrations about these."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch

from ..core.energies.materials import MASS_DAMPING, PRONY_RATIOS, PRONY_TIME, VISCOUS
from ..core.energies.viscosity import relaxation
from ..core.stepping.state import State
from ..data.input_response import InputResponse, draw_inputs, response_of
from ..io.arrays import FloatArray, IntArray
from ..io.errors import ConvergenceError, InputError
from ..learning.residuals.correction import Learned
from ..robot.actuation import Given, RobotInput
from ..robot.robot import Robot
from ..settings.control import ReductionSettings
from ..settings.played import SequenceSettings

OnProgress = Callable[[int], None]

_OF_MEDIUM: Final = ("added_layer", "drag_linear", "drag_normal", "drag_tangential")
_MORE_MODES: Final = 1.5  # computed vibrations per kept one, so that the slowest are accurate
_MEAN, _DEVIATION = 0.4, 0.45  # of sampled inputs, as shares of their range
# Correlation times of the inputs [s].
_FASTEST = 0.05  # the shortest in motions for fitting
_FAST = 0.25  # the shortest in motions for the error
_SLOWEST = 0.45  # the longest in both


@dataclass(frozen=True)
class Motions:
    """B sampled motions over T steps."""

    q: torch.Tensor  # (T + 1, B, N, 3) [m]
    v: torch.Tensor  # (T + 1, B, N, 3) [m/s]
    y: FloatArray  # (T + 1, B, 3 M) observed points [m]
    commands: FloatArray  # (T, B, n) in the unit of the input
    acting: FloatArray  # (T, B, n') moving inputs after their response to commands, in the scale


@dataclass(frozen=True)
class Tangent:
    """Linearisation about an equilibrium, in the basis of its slowest vibrations."""

    shapes: torch.Tensor  # (3 N, r), orthonormal in the mass
    stiffness: FloatArray  # (r, r) [1/s^2]
    damping: FloatArray  # (r, r) [1/s]
    shown: FloatArray  # (3 M, r) derivatives of the observed points by the vibrations' amplitudes
    branches: FloatArray  # (K, r, r) of the Prony branches [1/s^2]
    # (r, c) derivatives of the force with respect to the network's outputs; None without a network
    push: FloatArray | None

    def slowest(self, modes: int) -> "Tangent":
        """Truncates the linearisation to fewer vibrations."""
        return Tangent(
            self.shapes[:, :modes],
            self.stiffness[:modes, :modes],
            self.damping[:modes, :modes],
            self.shown[:, :modes],
            self.branches[:, :modes, :modes],
            None if self.push is None else self.push[:modes],
        )


def driven_input(robot: Robot) -> RobotInput:
    """Returns the one input that drives a robot's trials.

    Raises:
        InputError: there is none, or several.
    """
    inputs = [robot.inputs[name] for name in robot.driven if name in robot.description.seen]
    if len(inputs) != 1:
        raise InputError(
            "a reduced model needs a robot whose trials are driven by one input, and "
            f"{robot.description.name} has {len(inputs) or 'none'}: choose a run with pressures, "
            "tendons or muscles, or give Robot.of the ranges of one input."
        )
    return inputs[0]


def settle_some(robot: Robot, batch: int, **inputs: Given) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns positions (B, N, 3) of `Robot.settle` [m], and (B,) bool,
    which environments are in equilibrium.

    Raises:
        InputError: an invalid input, as for `Robot.step`.
        ConvergenceError: the simulator has no equilibrium even without the learned force.
    """
    try:
        q = robot.settle(batch, **inputs).q
    except ConvergenceError as error:
        if not isinstance(error.report, torch.Tensor):
            raise
        return error.positions.detach(), error.report
    return q, torch.ones(batch, dtype=torch.bool, device=q.device)


def linearised(
    robot: Robot, state: State, **inputs: Given
) -> tuple[scipy.sparse.csc_array, scipy.sparse.csc_array, IntArray]:
    """Linearises a step of a robot's simulator about a state, without the learned force.

    Returns:
        The (3 F, 3 F) Hessian and the inertia in it [N/m], and the numbers of the F free vertices.
    """
    acting = robot.acting(state, **inputs).inputs
    linear = robot.simulator.linearise(state, acting, robot.constants)
    hessian, _ = linear.matrix(state.q)
    return hessian, linear.inertia_matrix(state.q), linear.free.cpu().numpy()


def check_reducible(robot: Robot) -> None:
    """Refuses a robot that cannot be reduced.

    Raises:
        InputError: a data-driven robot, one that is not driven by exactly one input, without
            markers, with a moving base, friction, a medium or obstacles, that is stepped by the
            midpoint rule, or whose network is nodal.
    """
    description = robot.description
    if robot.is_data_driven:
        raise InputError("a data-driven model has no stiffness to reduce: choose resphys or sysid.")
    driven_input(robot)
    if not robot.labels:
        raise InputError(f"{description.name} has no markers: a reduced model predicts markers.")
    if description.told_of_base is not None:
        raise InputError(f"the base of {description.name} moves: reduced models have a fixed base.")
    if robot.simulator.integrator not in ("implicit_euler", "bdf2"):
        raise InputError(
            f"a robot that is stepped by {robot.simulator.integrator} cannot be reduced: set "
            "identify.integrator to implicit_euler or bdf2."
        )
    if any(getattr(energy, "memory", ()) for energy in robot.simulator.body.energies):
        raise InputError(
            "an energy with memory, such as friction, cannot be reduced: use the full simulator."
        )
    if any(getattr(energy, "is_barrier", False) for energy in robot.simulator.body.energies):
        raise InputError(
            "a robot in contact cannot be reduced, as contact has no basis: use the full simulator."
        )
    for name in (*_OF_MEDIUM, "tendon_friction"):
        if name in robot.simulator.parameters and bool((_value(robot, name) != 0.0).any()):
            raise InputError(
                f"{name} is no stiffness, so that this robot cannot be reduced: "
                "use the full simulator."
            )
    network = None if description.learned is None else description.learned.network
    if network is not None and any(
        coder.basis is None for coder in (network.position, *network.coders)
    ):
        raise InputError("a nodal network cannot be reduced: train one with network.kind=reduced.")


def _value(robot: Robot, name: str) -> torch.Tensor:
    """Values of a parameter."""
    known = robot.parameters.get(name, robot.simulator.defaults.get(name, 0.0))
    return torch.as_tensor(known, dtype=torch.float64)


class Source:
    """Samples a robot.

    Args:
        robot: that `check_reducible` accepts.
        driven: its input.
    """

    def __init__(self, robot: Robot, driven: RobotInput) -> None:
        self.robot, self.input = robot, driven
        simulator = robot.simulator
        self.parts, self.rest = len(driven.parts), simulator.rest_positions
        self.learned: Learned | None = robot.description.learned
        self.filters = robot.description.filters if self.learned is not None else ()
        values = {name: float(value[0]) for name, value in robot.parameters.items()}
        self.range = np.array([driven.low, driven.high], dtype=np.float64)
        self.moving = np.flatnonzero(np.ptp(self.range, axis=0))
        self.acts = response_of(driven.quantity, values, driven.parts, robot.description.actuator)
        self.response = InputResponse(robot.time_step, **self.acts)
        # Parts are also commanded one at a time, as a learned actuator may let one part reduce the
        # input of another.
        alone = self.range[0] + np.diag(np.ptp(self.range, axis=0))
        reach = np.abs(self.response.still(np.concatenate([self.range, alone]))).max(0)
        self.scale = np.where(reach > 0.0, reach, 1.0)
        damping = {
            name: 0.0 for name in simulator.parameters if name.endswith((*VISCOUS, MASS_DAMPING))
        }
        words = {
            name: word for name in simulator.parameters for word in PRONY_RATIOS if word in name
        }
        ratios = dict.fromkeys(words, 0.0)
        self._viscous, self._elastic = (
            robot.with_parameters(**ratios),
            robot.with_parameters(**damping, **ratios),
        )
        self._branches, times = list[Robot](), list[float]()
        for name, word in words.items():
            others = {other: 0.0 for other in ratios if other != name}
            self._branches.append(robot.with_parameters(**damping, **others))
            name = name.replace(word, PRONY_TIME)
            times.append(float(_value(robot, name)))
        self.times = tuple(times)
        free = np.ones(simulator.body.n_vertices)
        free[simulator.body.fixed_vertices] = 0.0
        mass = robot.constants.mass[0].double() * torch.as_tensor(free, device=self.rest.device)
        self.mass = mass.repeat_interleave(3)  # (3 N,) [kg]

    def commands(self, shares: FloatArray) -> FloatArray:
        """Commands (..., n) for shares of the range of the trials."""
        return np.asarray(self.range[0] + shares * np.ptp(self.range, axis=0))

    def acting(self, commands: FloatArray) -> FloatArray:
        """Moving inputs (..., n') under constant commands (..., n), in units of the scale."""
        return np.asarray((self.response.still(commands) / self.scale)[..., self.moving])

    def keywords(self, commands: FloatArray) -> dict[str, Any]:
        """Keyword argument of the robot's methods for commands (B, n) in the unit of the input."""
        return {self.input.name: self.robot.simulator.tensor(commands)}

    def conditions(self) -> tuple[FloatArray, FloatArray]:
        """Standardised inputs (k,) of the network beside the state,
        at zero inputs, and their derivatives.

        The derivatives (k, n' (1 + F)) are by the moving inputs and the filtered ones; both are
        empty where the network takes no inputs.
        """
        network = None if self.learned is None else self.learned.network
        if network is None or network.actuation is None:
            return np.zeros(0), np.zeros((0, 0))
        nothing = self.keywords(np.zeros((1, self.parts)))
        still = self.robot.state(self.rest, **nothing)
        conditions = self.robot.acting(still, **nothing).conditions
        assert conditions is not None
        blocks = 1 + len(self.filters)
        changes = np.diag(np.tile(self.scale, blocks))
        conditions = conditions.double().clone()
        conditions[:, conditions.shape[1] - len(changes) :] = 0.0
        changes = np.pad(changes, ((0, 0), (conditions.shape[1] - len(changes), 0)))
        encode = network.actuation.encode
        base = encode(conditions)
        changes = changes.reshape(blocks, -1, changes.shape[1])[:, self.moving].reshape(
            -1, changes.shape[1]
        )
        by = encode(conditions + torch.as_tensor(changes).to(conditions)) - base
        return base[0].cpu().numpy(), by.mT.cpu().numpy()

    def motions(self, samples: ReductionSettings, seed: int, on_progress: OnProgress) -> Motions:
        """Simulates motions under smooth random inputs.

        The first half, for fitting, includes faster ones.
        """
        robot, steps = self.robot, max(round(samples.seconds / self.robot.time_step), 20)
        random, batch = np.random.default_rng(seed), 2 * samples.motions
        drawn = []
        for number in range(batch):
            fastest = _FASTEST if number < samples.motions else _FAST
            time = float(np.exp(random.uniform(np.log(fastest), np.log(_SLOWEST))))
            rest = 2.0 * robot.time_step
            source = SequenceSettings(
                mean=_MEAN, deviation=_DEVIATION, correlation_time=time, rest=rest
            )
            drawn.append(draw_inputs(source, 1.0, steps, robot.time_step, self.parts, random)[1:])
        commands = self.commands(np.stack(drawn, axis=1))
        every = max(steps // samples.tenths, 1)

        def on_step(number: int) -> None:
            if number % every == 0 and number <= every * samples.tenths:
                on_progress(1)

        with torch.no_grad():
            motion = robot.rollout(robot.begin(batch), on_step=on_step, **self.keywords(commands))
        on_progress(max(samples.tenths - steps // every, 0))
        y = motion.markers.flatten(2).double().cpu().numpy()
        return Motions(
            motion.q.float(),
            motion.v.float(),
            y,
            commands,
            (self.response.from_rest(commands)[0] / self.scale)[..., self.moving],
        )

    def _outputs(self, state: State, commands: dict[str, torch.Tensor]) -> FloatArray:
        """Outputs (B, c) of the network in a step from a state."""
        assert self.learned is not None
        network, conditions = self.learned.network, self.robot.acting(state, **commands).conditions
        like = network.rest
        conditions = (
            None if conditions is None or network.actuation is None else conditions.to(like)
        )
        inputs = network.encode(state.q.to(like), state.v.to(like), conditions)
        range_ = self.learned.range_
        outputs = (
            network.standardised(inputs) if range_ is None else range_.outputs(network, inputs)
        )
        return np.asarray(outputs.double().cpu().numpy())

    def equilibria(
        self, commands: FloatArray
    ) -> tuple[torch.Tensor, FloatArray, FloatArray | None]:
        """Computes equilibria under commands (B, n); those without an equilibrium are left out.

        Returns:
            Positions (S, N, 3) [m], their commands (S, n), and the network's outputs (S, c) there,
            if there is one.
        """
        q, rests = settle_some(self.robot, len(commands), **self.keywords(commands))
        q, commands = q[rests], commands[rests.cpu().numpy()]
        if self.learned is None:
            return q, commands, None
        if not len(commands):
            return q, commands, np.zeros((0, self.learned.network.linear.shape[1]))
        keywords = self.keywords(commands)
        return q, commands, self._outputs(self.robot.state(q, **keywords), keywords)

    def _pull(self, state: State, outputs: FloatArray) -> torch.Tensor:
        """Learned force (B, N, 3) of network outputs (B, c) on a body in a state [N]."""
        assert self.learned is not None
        (coder,), frames = self.learned.network.coders, self.robot.frames
        force = coder.decode(torch.as_tensor(outputs).to(coder.scale)).to(state.q)
        return force if frames is None else frames.to_world(state.q, state.v, force)

    def tangent(
        self, q: torch.Tensor, commands: FloatArray, modes: int, outputs: FloatArray | None
    ) -> Tangent:
        """Linearises about an equilibrium (1, N, 3) under commands (n,)
        and the force of network outputs (c,).
        """
        robot, still = self.robot, torch.zeros_like(q)
        keywords = self.keywords(commands[None])
        state = robot.state(q, **keywords)
        hessian, inertia, free = linearised(self._elastic, state, **keywords)
        stiffness = (hessian - inertia).tocsc()
        coordinates = (3 * free[:, None] + np.arange(3)).ravel()
        mass = scipy.sparse.diags_array(self.mass.cpu().numpy()[coordinates]).tocsc()
        count = min(int(np.ceil(_MORE_MODES * modes)) + 2, inertia.shape[0] - 2)
        values, vectors = scipy.sparse.linalg.eigsh(
            stiffness, count, M=mass, sigma=0.0, v0=np.ones(inertia.shape[0])
        )
        order = np.argsort(values)[:modes]
        shapes = torch.zeros(q[0].numel(), modes, dtype=torch.float64, device=q.device)
        shapes[torch.as_tensor(coordinates, device=q.device)] = torch.as_tensor(
            vectors[:, order], device=q.device
        )
        modal_stiffness = np.diag(values[order])
        damped, inertia = linearised(self._viscous, state, **keywords)[:2]
        # The Hessian of a step of length s is M / s^2 + D / s + K.
        step = float(np.sqrt(mass.diagonal()[0] / inertia.diagonal()[0]))
        kept = vectors[:, order]
        damping = step * (kept.T @ ((damped - hessian) @ kept))
        branches = np.zeros((len(self.times), *modal_stiffness.shape))
        gamma = relaxation(torch.tensor(self.times), robot.time_step)[1]
        for number, branch in enumerate(self._branches):
            branches[number] = (
                kept.T
                @ ((linearised(branch, state, **keywords)[0] - hessian) @ kept)
                / float(gamma[number])
            )
        columns, zero = shapes.mT.reshape(-1, *q.shape[1:]).to(q), q.new_zeros(modes)

        def seen(by: torch.Tensor) -> torch.Tensor:
            return robot.observe(State(q + _moved(by, columns), still)).flatten()

        shown = torch.func.jacfwd(seen)(zero).double().cpu().numpy()
        if outputs is None:
            return Tangent(shapes, modal_stiffness, damping, shown, branches, None)
        outputs, width = outputs[None], len(outputs)
        by_q = np.zeros_like(modal_stiffness)
        if robot.frames is not None:
            # The force turns with the body after the step, so that it contributes to A.
            pull = torch.func.jacfwd(
                lambda by: self._pull(State(q + _moved(by, columns), still), outputs).flatten()
            )
            by_q = (shapes.mT @ pull(zero).double()).cpu().numpy()
        unit = self._pull(
            State(q.expand(width, -1, -1), still.expand(width, -1, -1)), np.eye(width)
        )
        zero_force = self._pull(State(q, still), np.zeros((1, width)))
        push = (shapes.mT @ (unit - zero_force).flatten(1).mT.double()).cpu().numpy()
        return Tangent(shapes, modal_stiffness - by_q, damping, shown, branches, push)


def _moved(amounts: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Sum (1, N, 3) of columns (k, N, 3) times amounts (k,)."""
    return torch.einsum("k,kni->ni", amounts, columns)[None]
