"""Time integrators, each written as an implicit Euler step
with its own step length and starting point.

Every step minimises the incremental potential with effective step ``h_e``, inertial target y and
strain-rate reference r, and computes the new state from the minimiser x. Both parts are linear in
the states, so the gradients of a method follow from those of the nonlinear solve.
"""

from abc import ABC, abstractmethod

import torch
from typing_extensions import override

from ...io.errors import InputError
from .state import ImplicitStage, State


class Integrator(ABC):
    """One step of a method for M q'' = f(q, q')."""

    @abstractmethod
    def stage(self, state: State, h: float) -> ImplicitStage:
        """Returns the implicit solve of a step of length h [s]."""

    @abstractmethod
    def finish(self, state: State, x: torch.Tensor, h: float) -> State:
        """Returns the new state from the solution x (B, N, 3) of the stage."""

    def solution_for(self, state: State, q: torch.Tensor) -> torch.Tensor:
        """Returns the solution x of the stage for which `finish` gives positions q (B, N, 3)."""
        del state
        return q


class ImplicitEuler(Integrator):
    """First order, strongly damping: y = q + h v, v+ = (x - q) / h."""

    @override
    def stage(self, state: State, h: float) -> ImplicitStage:
        return ImplicitStage(h, state.q + h * state.v, state.q, ((state.q, 1.0),))

    @override
    def finish(self, state: State, x: torch.Tensor, h: float) -> State:
        return State(x, (x - state.q) / h)


class BDF2(Integrator):
    """Second order, damps motions that the step does not resolve; the first step is implicit Euler.

    q+ = (4 q - q') / 3 + 2h/3 v+, likewise for v+ (Hairer and Wanner 1996, section V.1); q' is one
    step earlier.
    """

    @override
    def stage(self, state: State, h: float) -> ImplicitStage:
        if state.previous is None:
            return ImplicitEuler().stage(state, h)
        q_back, v_back = state.previous
        reference = (4.0 * state.q - q_back) / 3.0
        step = 2.0 / 3.0 * h
        target = reference + step * (4.0 * state.v - v_back) / 3.0
        return ImplicitStage(step, target, reference, ((state.q, 4.0 / 3.0), (q_back, -1.0 / 3.0)))

    @override
    def finish(self, state: State, x: torch.Tensor, h: float) -> State:
        back = (state.q, state.v)
        if state.previous is None:
            return State(x, (x - state.q) / h, back)
        return State(x, (3.0 * x - 4.0 * state.q + state.previous[0]) / (2.0 * h), back)


class Midpoint(Integrator):
    """Implicit midpoint: second order, conserves the energy of small vibrations.

    An implicit Euler step of h/2, then an explicit one: q+ = 2 x - q, v+ = 4 (x - q) / h - v.
    Vibrations with periods of few steps persist unless the material is damped.

    The strain rate is needed at the end x of the half step, but (E(x) - E(q)) / (h/2) is the rate
    at its middle: with L = grad v it lacks h/4 L^T L, as E is quadratic. Since
    E(q + s v) + E(q - s v) - 2 E(q) = s^2 L^T L, the reference
    2 E(q) - (E(q + s v) + E(q - s v)) / 2 with s = h/2 corrects this, and rigid rotations stay
    undamped.
    """

    @override
    def stage(self, state: State, h: float) -> ImplicitStage:
        ahead = h / 2.0 * state.v
        strains = ((state.q, 2.0), (state.q + ahead, -0.5), (state.q - ahead, -0.5))
        return ImplicitStage(h / 2.0, state.q + ahead, state.q, strains, end=0.5)

    @override
    def solution_for(self, state: State, q: torch.Tensor) -> torch.Tensor:
        return 0.5 * (state.q + q)

    @override
    def finish(self, state: State, x: torch.Tensor, h: float) -> State:
        half = (x - state.q) * (2.0 / h)
        return State(2.0 * x - state.q, 2.0 * half - state.v)


INTEGRATORS: dict[str, type[Integrator]] = {
    "implicit_euler": ImplicitEuler,
    "bdf2": BDF2,
    "midpoint": Midpoint,
}


def make_integrator(name: str) -> Integrator:
    """Returns the named integrator, or raises InputError for an unknown name."""
    if name not in INTEGRATORS:
        raise InputError(f"integrator is {name!r}: choose one of {', '.join(INTEGRATORS)}.")
    return INTEGRATORS[name]()
