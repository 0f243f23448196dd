"""What a robot is asked for a reduced model of it: motions, equilibria, and the vibrations about these."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from numpy.typing import NDArray

from ..data.actuation import InputSequences
from ..data.input_response import InputResponse, response_of
from ..experiment.models import Learned
from ..io.errors import InputError
from ..robot.inputs import RobotInput
from ..robot.robot import Robot
from ..robot.state import RobotState
from ..stepping.state import State

FloatArray = NDArray[np.float64]
OnProgress = Callable[[int], None]

_MORE_MODES: Final = 1.5  # vibrations that are found for each that is kept, so that the slowest are right
_MEAN, _DEVIATION = 0.4, 0.45  # of sampled inputs, as shares of their range
# Correlation times of theirs [s]: the fastest to fit to, the fastest that tell the error, and the slowest of both.
_FASTEST, _FAST, _SLOWEST = 0.05, 0.25, 0.45


@dataclass(frozen=True)
class Sampling:
    """How much is sampled.

    Attributes:
        modes: numbers r of coordinates of the reduced model, of which the one with the least error is taken.
        equilibria: for z_0 and y_0.
        tangents: of these, about which vibrations are found.
        motions: for H, and as many again that tell the error.
        seconds: of a motion.
        batch: equilibria that are found at once.
        seed: of all that is drawn.
    """

    modes: tuple[int, ...] = (4, 6, 8)
    equilibria: int = 192
    tangents: int = 96
    motions: int = 6
    seconds: float = 2.5
    batch: int = 32
    seed: int = 0

    @property
    def total(self) -> int:
        """Equilibria, tangents, and tenths of a second of the motions."""
        return self.equilibria + self.tangents + self.tenths

    @property
    def tenths(self) -> int:
        """Of a second of a motion."""
        return max(round(10 * self.seconds), 4)


@dataclass(frozen=True)
class Motions:
    """B sampled motions over T steps.

    Attributes:
        q: (T + 1, B, N, 3) [m].
        v: (T + 1, B, N, 3) [m/s].
        y: (T + 1, B, 3 M) what is observed [m].
        commands: (T, B, n) as shares.
        acting: (T, B, n) what they come to, as shares.
    """

    q: torch.Tensor
    v: torch.Tensor
    y: FloatArray
    commands: FloatArray
    acting: FloatArray


@dataclass(frozen=True)
class Tangent:
    """About an equilibrium, in its own slowest vibrations.

    Attributes:
        shapes: (3 N, r), orthonormal in the mass.
        stiffness: (r, r) [1/s^2].
        damping: (r, r) [1/s].
        shown: (3 M, r) of what is observed, by displacements in the shapes.
        push: (r, c) of the outputs of the network; None where there is none.
    """

    shapes: torch.Tensor
    stiffness: FloatArray
    damping: FloatArray
    shown: FloatArray
    push: FloatArray | None

    def slowest(self, modes: int) -> "Tangent":
        """The same in fewer vibrations."""
        return Tangent(
            self.shapes[:, :modes],
            self.stiffness[:modes, :modes],
            self.damping[:modes, :modes],
            self.shown[:, :modes],
            None if self.push is None else self.push[:modes],
        )


def driven_input(robot: Robot) -> RobotInput:
    """The one input that a robot's trials are driven by.

    Raises:
        InputError: there is none, or several.
    """
    known = [robot.inputs[name] for name in robot.driven if name in robot.description.seen]
    if len(known) != 1:
        raise InputError(
            f"control needs a robot whose trials are driven by one input, and {robot.description.name} has "
            f"{len(known) or 'none'}: take a run of pressures, tendons or muscles."
        )
    return known[0]


def check_reducible(robot: Robot) -> None:
    """Refuses a robot of which no reduced model can be made.

    Raises:
        InputError: a data-driven robot, one without markers, whose base moves, whose material relaxes, or whose network
            is recurrent or nodal.
    """
    known = robot.description
    if robot.is_data_driven:
        raise InputError("a network in a simulator's place has no stiffness to reduce: take resphys or sysid.")
    if not robot.labels:
        raise InputError(f"{known.name} has no markers: control follows markers of the robot.")
    if known.told_of_base is not None:
        raise InputError(f"the base of {known.name} moves: control is for robots whose base stands still.")
    if any(material.prony for material in robot.simulator.materials.values()):
        raise InputError(
            "a material that relaxes has a memory of its own, which is not reduced: leave out its branches."
        )
    network = None if known.learned is None else known.learned.network
    if network is not None and network.recurrent is not None:
        raise InputError("a recurrent force has a memory of its own, which is not reduced: train one that has none.")
    if network is not None and any(coder.basis is None for coder in (network.position, *network.coders)):
        raise InputError("the network moves every vertex by itself: train one of network.kind=reduced for control.")


class Source:
    """A robot, as it is asked.

    Args:
        robot: that `check_reducible` accepts.
        known: its input.
    """

    def __init__(self, robot: Robot, known: RobotInput) -> None:
        self.robot, self.input, simulator = robot, known, robot.simulator
        assert known.high is not None
        self.scale = np.asarray(known.high, dtype=np.float64)
        self.parts, self.rest = len(known.parts), simulator.rest_positions
        self.learned: Learned | None = robot.description.learned
        self.filters = robot.description.filters if self.learned is not None else ()
        values = {name: each[0] for name, each in robot.parameters.items()}
        factor, delay, rise = response_of(known.name, values)
        self._factor, self.delay, self.rise = (
            float(1.0 if factor is None else factor),
            float(delay or 0.0),
            float(rise or 0.0),
        )
        self._elastic = robot.with_parameters(stiffness_damping=0.0, mass_damping=0.0)
        free = np.ones(simulator.body.n_vertices)
        free[simulator.body.fixed_vertices] = 0.0
        mass = robot.constants.mass[0].double() * torch.as_tensor(free, device=self.rest.device)
        self.mass = mass.repeat_interleave(3)  # (3 N,) [kg]

    def given(self, shares: FloatArray) -> dict[str, Any]:
        """The input of shares (B, n) of the scale, by its name."""
        return {self.input.name: self.robot.simulator.tensor(shares * self.scale)}

    def told(self) -> tuple[FloatArray, FloatArray]:
        """(k,) standardised inputs of the network beside the state, without inputs; (k, n (1 + F)) their derivatives.

        The derivatives are by the inputs and their means; both are empty where the network takes no inputs.
        """
        network = None if self.learned is None else self.learned.network
        if network is None or network.actuation is None:
            return np.zeros(0), np.zeros((0, 0))
        nothing = self.given(np.zeros((1, self.parts)))
        still = RobotState(self.robot.simulator.rest_state(1), self.robot.begin_memory(nothing))
        told = self.robot.told(still, **nothing)
        assert told is not None
        width, blocks, n = told.shape[1], 1 + len(self.filters), self.parts
        changed = torch.zeros(blocks * n, width, dtype=told.dtype, device=told.device)
        at = torch.arange(blocks * n, device=told.device)
        changed[at, width - blocks * n + at] = torch.as_tensor(np.tile(self._factor * self.scale, blocks)).to(told)
        encode = network.actuation.encode
        base = encode(told.double())
        by = encode(told.double() + changed.double()) - base
        return base[0].cpu().numpy(), by.mT.cpu().numpy()

    def motions(self, sampling: Sampling, on_progress: OnProgress) -> Motions:
        """Motions under smooth random inputs: the first half, to fit to, some of them faster than the others."""
        robot, steps = self.robot, max(round(sampling.seconds / self.robot.time_step), 20)
        random, batch = np.random.default_rng(sampling.seed), 2 * sampling.motions
        drawn = []
        for number in range(batch):
            fastest = _FASTEST if number < sampling.motions else _FAST
            time = float(np.exp(random.uniform(np.log(fastest), np.log(_SLOWEST))))
            source = InputSequences(_MEAN, _DEVIATION, time, limit=1.0, rest=2.0 * robot.time_step)
            drawn.append(source.draw(steps, robot.time_step, self.parts, random)[1:])
        commands = np.stack(drawn, axis=1)
        every = max(steps // sampling.tenths, 1)

        def on_step(number: int) -> None:
            if number % every == 0 and number <= every * sampling.tenths:
                on_progress(1)

        with torch.no_grad():
            motion = robot.rollout(robot.begin(batch), on_step=on_step, **self.given(commands))
        on_progress(max(sampling.tenths - steps // every, 0))
        acting, _ = InputResponse(robot.time_step, None, self.delay or None, self.rise or None).from_rest(commands)
        y = motion.markers.flatten(2).double().cpu().numpy()
        return Motions(motion.q.float(), motion.v.float(), y, commands, acting)

    def _outputs(self, state: RobotState, given: dict[str, torch.Tensor]) -> FloatArray:
        """(B, c) of the network, for a step from a state."""
        assert self.learned is not None
        network, told = self.learned.network, self.robot.told(state, **given)
        like = network.rest
        known = None if told is None or network.actuation is None else told.to(like.device, like.dtype)
        inputs = network.encode(state.q.to(like), state.v.to(like), known)
        held = inputs if self.learned.range_ is None else self.learned.range_.hold(inputs)
        return np.asarray(network.standardised(held)[0].double().cpu().numpy())

    def equilibria(self, shares: FloatArray) -> tuple[torch.Tensor, FloatArray, FloatArray | None]:
        """Where the robot rests under inputs (B, n), of those under which it does.

        Returns:
            (S, N, 3) positions [m], (S, n) these inputs, and (S, c) the outputs of the network there, if there is one.
        """
        q, rests = self.robot.settle_some(len(shares), **self.given(shares))
        q, shares = q[rests], shares[rests.cpu().numpy()]
        if self.learned is None or not len(shares):
            return q, shares, None if self.learned is None else np.zeros((0, self._width))
        given = self.given(shares)
        state = RobotState(State(q, torch.zeros_like(q)), self.robot.begin_memory(given, len(shares)))
        return q, shares, self._outputs(state, given)

    @property
    def _width(self) -> int:
        assert self.learned is not None
        return int(self.learned.network.linear.shape[1])

    def _pull(self, state: State, outputs: FloatArray) -> torch.Tensor:
        """(B, N, 3) the learned force of outputs (B, c) of the network, on a body in a state [N]."""
        assert self.learned is not None
        force = self._decoded(outputs).to(state.q)
        frames = self.robot.frames
        return force if frames is None else frames.to_world(state.q, state.v, force)

    def _decoded(self, outputs: FloatArray) -> torch.Tensor:
        assert self.learned is not None
        (coder,) = self.learned.network.coders
        return coder.decode(torch.as_tensor(outputs).to(coder.scale))

    def tangent(self, q: torch.Tensor, share: FloatArray, modes: int, outputs: FloatArray | None) -> Tangent:
        """About an equilibrium (1, N, 3) under inputs (n,) and the force of outputs (c,) of the network."""
        robot, still = self.robot, torch.zeros_like(q)
        state = RobotState(State(q, still), robot.begin_memory(self.given(share[None])))
        hessian, inertia, free = self._elastic.linearised(state, **self.given(share[None]))
        stiffness = (hessian - scipy.sparse.diags_array(inertia)).tocsc()
        coordinates = (3 * free[:, None] + np.arange(3)).ravel()
        mass = scipy.sparse.diags_array(self.mass.cpu().numpy()[coordinates]).tocsc()
        count = min(int(np.ceil(_MORE_MODES * modes)) + 2, len(inertia) - 2)
        values, vectors = scipy.sparse.linalg.eigsh(stiffness, count, M=mass, sigma=0.0, v0=np.ones(len(inertia)))
        order = np.argsort(values)[:modes]
        shapes = torch.zeros(q[0].numel(), modes, dtype=torch.float64, device=q.device)
        shapes[torch.as_tensor(coordinates, device=q.device)] = torch.as_tensor(vectors[:, order], device=q.device)
        own = np.diag(values[order])
        damped, inertia = self.robot.linearised(state, **self.given(share[None]))[:2]
        # The Hessian of a step of s seconds is M / s^2 + D / s + K.
        step = float(np.sqrt(mass.diagonal()[0] / inertia[0]))
        kept = vectors[:, order]
        damping = step * (kept.T @ ((damped - hessian) @ kept))
        columns, zero = shapes.mT.reshape(-1, *q.shape[1:]).to(q), q.new_zeros(modes)

        def seen(by: torch.Tensor) -> torch.Tensor:
            return robot.observe(RobotState(State(q + _moved(by, columns), still))).flatten()

        shown = torch.func.jacfwd(seen)(zero).double().cpu().numpy()
        if outputs is None:
            return Tangent(shapes, own, damping, shown, None)
        outputs, width = outputs[None], len(outputs)
        by_q = np.zeros_like(own)
        if robot.frames is not None:  # They turn it as the body will be after the step, which A sees, too.
            pull = torch.func.jacfwd(lambda by: self._pull(State(q + _moved(by, columns), still), outputs).flatten())
            by_q = (shapes.mT @ pull(zero).double()).cpu().numpy()
        ones = np.eye(width)
        each = self._pull(State(q.expand(width, -1, -1), still.expand(width, -1, -1)), ones)
        none = self._pull(State(q, still), np.zeros((1, width)))
        push = (shapes.mT @ (each - none).flatten(1).mT.double()).cpu().numpy()
        return Tangent(shapes, own - by_q, damping, shown, push)


def _moved(amounts: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """(1, N, 3) the sum of amounts (k,) of columns (k, N, 3)."""
    return torch.einsum("k,kni->ni", amounts, columns)[None]
