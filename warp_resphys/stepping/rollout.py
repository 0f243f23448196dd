"""The roll-out of everything that moves step by step.

A stepper is a function (state, inputs of a step) -> next state: the ``step`` of a simulator, a corrected simulator, a
robot, a scene or a reduced model. All that a step depends on is in the state and the inputs, so that a roll-out is
differentiable, and continues from any of its states. Where a step depends on its number, as with windows that begin
anew, its inputs are that number.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from typing import TypeVar

S = TypeVar("S")  # a state
I = TypeVar("I")  # noqa: E741  # inputs of a step
O = TypeVar("O")  # noqa: E741  # what is observed in a state

Stepper = Callable[[S, I], S]


def states(step: Stepper[S, I], state: S, inputs: Iterable[I]) -> Iterator[S]:
    """Yields the initial state and the state after every step, as they are needed.

    Args:
        step: the stepper.
        state: initial state.
        inputs: inputs of the T steps, in turn.
    """
    return accumulate(inputs, step, initial=state)


def rollout(step: Stepper[S, I], state: S, inputs: Iterable[I], observe: Callable[[S], O]) -> list[O]:
    """Simulates T steps and returns T + 1 observations: of the initial state, and of the state after every step.

    Args:
        step: the stepper.
        state: initial state.
        inputs: inputs of the T steps, in turn, such as `Inputs.by_step`, or ``range(T)`` for their numbers.
        observe: what is kept of a state.
    """
    return [observe(now) for now in states(step, state, inputs)]
