"""The state of a robot's full simulator, estimated from its markers.

The simulator itself, with its learned force, carries the mean. The shapes are the slowest
vibrations about the first state. For each refined parameter a robot with another value runs beside,
so that the derivatives of the motion by the parameters follow by differences (a filter with
separate bias: Friedland, IEEE Trans. Autom. Control 14 (1969) 359).
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from typing_extensions import override

from ..core.energies.contact.obstacle_contact import Contact
from ..core.energies.contact.surface_contact import SurfaceContact
from ..core.stepping.quantity import Quantity
from ..core.stepping.state import Reaction, State
from ..data.trials import PAYLOAD
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError, listed
from ..learning.parameters import check_names, identifiable_parameters
from ..robot.actuation import Given
from ..robot.robot import Robot
from .belief import Belief
from .estimator import TwinEstimator
from .tangent import StepTangent, pulled_by, shifted

_MODES: Final = 8  # vibrations in which the state is corrected
_DIFFERENCE: Final = 0.05  # of the robots that run beside, in deviations of their parameter
_OPEN: Final = (
    1e-3  # least distance of a parameter from a bound that it must not reach, over its first value
)
_CHANGED: Final = (
    0.05  # change of a column of the transition after which the next step renews one, too
)
_LONGEST_PAUSE: Final = 8  # steps
_SEEN_STEP: Final = 1e-4  # of differences of markers, over the size of the body


@dataclass(frozen=True, kw_only=True)
class FullBelief(Belief):
    """Estimate of the state of a full simulator."""

    state: State  # of 2 + P: the estimate, P with another parameter, one without markers
    transition: FloatArray  # (2 r, 3 r) of the errors (z, w) by (z, w, b) in a step
    reaction: Reaction | None  # in the uncorrected step or equilibrium that predicted the state
    turn: int = 0  # number of the column of it that is renewed next
    pause: int = 1  # steps between two renewals: few while they change the transition
    wait: int = 0  # steps until the next one


class FullEstimator(TwinEstimator[FullBelief]):
    """Estimates the state of a robot with its own simulator.

    Args:
        robot: with a simulator.
        inputs: constant commands under which it rests at first.
        refine: standard deviations of the parameters to refine, by name, in their units;
            ``payload`` is one of them where the robot has one, and then starts from the first
            command and ignores later ones.
        noise: standard deviation of a coordinate of a marker [m].

    Raises:
        InputError: an unknown parameter or input; a network in place of the simulator; obstacles
            that move, or parameters to refine beside obstacles.
        ConvergenceError: there is no equilibrium.
    """

    def __init__(
        self, robot: Robot, inputs: Mapping[str, Given], refine: Mapping[str, float], noise: float
    ) -> None:
        if robot.is_data_driven:
            raise InputError(
                "a network in the simulator's place cannot be corrected by a force: load another "
                "model."
            )
        if any(isinstance(energy, SurfaceContact) for energy in robot.simulator.body.energies):
            raise InputError(
                "a twin cannot follow a robot with contact between surfaces, which its "
                "corrections would make cross: set self_contact=null."
            )
        contacts = [
            energy for energy in robot.simulator.body.energies if isinstance(energy, Contact)
        ]
        if any(contact.moves for contact in contacts):
            raise InputError(
                "a twin cannot follow a robot with obstacles that move: set moves to false."
            )
        if contacts and refine:
            raise InputError(
                "a twin of a robot with obstacles refines no parameters, as a body that lies on "
                "one hardly shows them: leave refine out."
            )
        self._refined, self.robot = dict(refine), robot
        named = [name for name in refine if name != PAYLOAD.name or name not in robot.inputs]
        check_names(named, identifiable_parameters(robot.simulator))
        for name, deviation in refine.items():
            if not deviation > 0.0:
                raise InputError(
                    f"refine.{name} is {deviation:g}: "
                    "give its standard deviation, which is positive."
                )
        self._known = self._values(inputs)
        resting = at_rest(robot, 1, inputs)
        self.tangent = StepTangent.of(robot, resting, inputs, _MODES)
        super().__init__(
            robot, inputs, self._refined, self.tangent.frequencies, self.tangent.size, noise
        )
        self._apart = _DIFFERENCE * self._prior

    def _values(self, inputs: Mapping[str, Given]) -> FloatArray:
        """First values (P,) of the refined parameters."""
        simulator, values = self.robot.simulator, []
        for name in self._refined:
            if name == PAYLOAD.name:
                values.append(float(torch.as_tensor(inputs.get(name, 0.0)).sum()))
                continue
            known = torch.as_tensor(
                self.robot.parameters.get(name, simulator.defaults.get(name, ()))
            )
            if known.numel() != 1:
                raise InputError(
                    f"refine names {name!r}, which has no single value in this robot: refine one "
                    f"that it has identified, {listed([*self.robot.parameters])}, or the payload."
                )
            values.append(float(known))
        return np.array(values, dtype=np.float64)

    @override
    def begin(self, inputs: Mapping[str, Given], refined: FloatArray | None = None) -> FullBelief:
        self._known = self._values(inputs)
        values = self._known if refined is None else refined
        robot, acting = self._at(values, inputs)
        state = at_rest(robot, self._count, acting)
        first = vars(self._first(values))
        return FullBelief(
            **first,
            state=state.detach(),
            transition=self.tangent.transition,
            reaction=_of(state, range(self._count)),
        )

    @property
    def _count(self) -> int:
        return 2 + len(self._refined)

    def _at(
        self, values: FloatArray, inputs: Mapping[str, Given], more: int = 0
    ) -> tuple[Robot, dict[str, Given]]:
        """The robot with the parameters of all environments,
        and some more like the first, and its commands.
        """
        table = np.tile(values, (self._count + more, 1))
        table[1 : self._count - 1] += np.diag(self._apart)
        table[self._count - 1] = self._known
        columns = dict(zip(self._refined, table.T, strict=True))
        acting = dict(inputs)
        if PAYLOAD.name in columns:
            acting[PAYLOAD.name] = columns.pop(PAYLOAD.name)[:, None]
        changed = {name: self.robot.simulator.tensor(column) for name, column in columns.items()}
        return self.robot.with_parameters(**changed) if changed else self.robot, acting

    @override
    def advance(
        self, belief: FullBelief, inputs: Mapping[str, Given], renew: bool = True
    ) -> FullBelief:
        if renew and not belief.wait:
            # Perhaps of the environments beside it, which renew its derivatives.
            with suppress(ConvergenceError):
                return self._advanced(belief, inputs, True)
        return self._advanced(belief, inputs, False)

    def _advanced(self, belief: FullBelief, inputs: Mapping[str, Given], renew: bool) -> FullBelief:
        """A step; a column of the transition may be renewed, by two environments beside."""
        tangent, more = self.tangent, 2 if renew else 0
        robot, acting = self._at(belief.parameters, inputs, more)
        state = belief.state
        pull = torch.einsum("r,rni->ni", self.robot.simulator.tensor(belief.bias), tangent.pull)
        forces = pull.repeat(self._count + more, 1, 1)
        forces[self._count - 1] = 0.0
        if renew:
            changes = tangent.changes([belief.turn])
            moved, faster, pulled = (
                F.pad(change, (0, 0, 0, 0, self._count, 0)) for change in changes
            )
            state = shifted(robot, state.select([*range(self._count), 0, 0]), moved, faster)
            forces += pulled
        after = robot.step(state, **pulled_by(robot, acting, forces))
        state = after.detach()
        belief = replace(
            belief, wait=max(belief.wait - 1, 0), reaction=_of(after, range(self._count))
        )
        if renew:
            belief = self._renewed(belief, state)
            state = state.select(range(self._count))
        return replace(self._propagated(belief, belief.transition), state=state)

    @override
    def robot_state(self, belief: FullBelief) -> State:
        return replace(belief.state.select([0]), reaction=_of(belief, [0]))

    def _renewed(self, belief: FullBelief, after: State) -> FullBelief:
        """Renews a column of the transition from a step of
        which the last two environments began with its changes.
        """
        column = self.tangent.slopes(after.select([self._count, self._count + 1]), [belief.turn])
        column = column[:, 0]
        before = belief.transition[:, belief.turn]
        transition = belief.transition.copy()
        r = len(belief.bias)
        transition[:, belief.turn] = column
        changed = np.abs(column - before)[:r].max() > _CHANGED * np.abs(before)[:r].max()
        pause = 1 if changed else min(2 * belief.pause, _LONGEST_PAUSE)
        turn = (belief.turn + 1) % (3 * r)
        return replace(belief, transition=transition, turn=turn, pause=pause, wait=pause - 1)

    @override
    def _seen(self, belief: FullBelief, ago: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        state, tangent = belief.state, self.tangent
        q = state.q - ago * state.v
        amount = _SEEN_STEP * self.size / tangent.shapes.norm(dim=2).amax(1)
        both = torch.cat([q, q[:1] + amount[:, None, None] * tangent.shapes])
        seen = self.robot.observe(State(both, torch.zeros_like(both))).cpu().double().numpy()
        now = seen[0]
        beside = seen[1 : self._count - 1]
        free = seen[self._count - 1]
        moved = seen[self._count :]
        by_z = np.moveaxis((moved - now) / amount.cpu().double().numpy()[:, None, None], 0, 2)
        by_values = np.moveaxis((beside - now) / self._apart[:, None, None], 0, 2)
        parts = [by_z, -ago * by_z, np.zeros_like(by_z), by_values]
        if self.labels:
            parts.append(np.eye(belief.places.size).reshape(-1, 3, belief.places.size))
            now = now + belief.places
        return now, np.concatenate(parts, axis=2), free

    @override
    def _free(self, belief: FullBelief) -> FullBelief:
        last = [self._count - 1] * self._count
        return replace(belief, state=belief.state.select(last), reaction=_of(belief, last))

    @override
    def _moved(
        self, belief: FullBelief, z: FloatArray, w: FloatArray, parameters: FloatArray
    ) -> FullBelief:
        state, tangent = belief.state, self.tangent
        if len(self._prior):
            share = state.q.new_tensor((parameters - belief.parameters) / self._apart)
            state = state.map(lambda value: _along(value, share))
        scale = state.q.new_ones(self._count, 1, 1)
        scale[-1] = 0.0
        shapes = (torch.einsum("r,rni->ni", state.q.new_tensor(x), tangent.shapes) for x in (z, w))
        moved, faster = (scale * field for field in shapes)
        return replace(belief, state=shifted(self._at(parameters, {})[0], state, moved, faster))

    @override
    def _furthest(self, belief: FullBelief, z: FloatArray, parameters: FloatArray) -> float:
        q = belief.state.q
        moved = torch.einsum("r,rni->ni", q.new_tensor(z), self.tangent.shapes)
        share = q.new_tensor(parameters / self._apart)
        moved = moved + torch.einsum("p,pni->ni", share, q[1:-1] - q[:1])
        return float(moved.norm(dim=1).max())

    @override
    def _within(self, parameters: FloatArray) -> FloatArray:
        known = {**self.robot.simulator.parameters, PAYLOAD.name: PAYLOAD}
        quantities = [known.get(name, Quantity(name, "")) for name in self._refined]
        far = _OPEN * np.maximum(np.abs(self._known), self._prior)
        low = np.array([quantity.lower for quantity in quantities])
        high = np.array([quantity.upper for quantity in quantities])
        return np.clip(parameters, low + far, high - far - self._apart)


def at_rest(robot: Robot, batch: int, inputs: Mapping[str, Given]) -> State:
    """The equilibrium under constant commands, without the learned force
    where there is none with it.
    """
    try:
        return robot.settle(batch, **inputs)
    except ConvergenceError:
        return robot.begin(batch, **inputs)


def _of(one: State | FullBelief, environments: Sequence[int]) -> Reaction | None:
    """The reaction of some environments, by number."""
    return None if one.reaction is None else one.reaction.select(environments)


def _along(rows: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
    """Moves a tensor of the state along those that run beside, by shares (P,) of the differences.

    The last stays.
    """
    if not rows.is_floating_point():
        return rows
    step = torch.tensordot(share.to(rows), rows[1 : 1 + len(share)] - rows[:1], dims=1)
    return torch.cat([rows[:-1] + step, rows[-1:]])
