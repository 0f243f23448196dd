"""Roll-outs on a Warp tape, as an alternative to gradients by ``torch.autograd``.

A recorded roll-out is part of a tape with the user's kernels, and ``tape.backward`` differentiates all of it::

    with wp.Tape() as tape:
        wp.launch(forces, dim=..., inputs=[parameters], outputs=[forces])
        rollout = record_rollout(tape, simulator, q, v, steps=60, inputs={"external_force": forces})
        wp.launch(loss, dim=..., inputs=[rollout.q], outputs=[value])
    tape.backward(value)

Nothing is copied: torch uses the memory of the arrays that are passed, and the arrays that are returned use
torch's. A step keeps only its states for its adjoint, as with torch.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import cast

import torch
import warp as wp

from ..io.errors import InputError
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .nonlinear_solver import SolveReport
from .simulator import Simulator

_VECTOR_INPUTS = ("external_force", "fixed_positions")
_SCALARS = {torch.float64: wp.float64, torch.float32: wp.float32}
_VECTORS = {torch.float64: wp.vec3d, torch.float32: wp.vec3f}


@dataclass(frozen=True)
class RecordedRollout:
    """Result of a recorded roll-out."""

    q: wp.array  # (T + 1, B, N) vec3 positions, the start included [m]
    v: wp.array  # (T + 1, B, N) vec3 velocities [m/s]
    reports: list[SolveReport]  # T outcomes of the solver


def record_rollout(
    tape: wp.Tape,
    simulator: Simulator,
    q: wp.array,
    v: wp.array,
    steps: int,
    *,
    previous: tuple[wp.array, wp.array] | None = None,
    inputs: Mapping[str, wp.array] | None = None,
    parameters: Mapping[str, wp.array] | None = None,
) -> RecordedRollout:
    """Returns a roll-out, recorded on a tape for differentiation.

    Gradients are added to the ``grad`` of every array given that requires gradients. As for Warp's own
    kernels, the arrays must keep their values until ``tape.backward``, which reads the gradients of the
    results and sets them to zero unless ``retain_grad`` is set. It may be called again.

    Args:
        tape: entered by the caller or not.
        simulator: its device and type must be those of every array.
        q: (B, N) vec3 positions [m]; Prony branches start relaxed.
        v: (B, N) vec3 velocities [m/s].
        steps: T.
        previous: (q, v) one step earlier, to continue a roll-out by BDF2: its ``(q[-2], v[-2])``.
        inputs: arrays by a name of `Inputs`: ``external_force`` (B, N) vec3 [N], ``fixed_positions`` (B, D) vec3 [m],
            ``attached_mass`` (B, N) [kg], and the inputs of the body's energies (B, n). All but the masses may have a
            time axis T in front.
        parameters: values that replace the simulator's, by a name of ``simulator.parameters``, shaped as for
            `Simulator.prepare`.

    Raises:
        InputError: an unknown parameter, an array of another type or device than the simulator's, wrong
            shapes, or values that are not finite.
        ConvergenceError: see `Simulator.step`.
    """
    leaves = _Leaves(simulator)
    back = None
    if previous is not None:
        back = leaves.vectors("previous q", previous[0]), leaves.vectors("previous v", previous[1])
    state = State(leaves.vectors("q", q), leaves.vectors("v", v), back)
    acting = {
        name: (leaves.vectors if name in _VECTOR_INPUTS else leaves.scalars)(name, array)
        for name, array in (inputs or {}).items()
    }
    values = {name: leaves.scalars(name, array) for name, array in (parameters or {}).items()}
    with leaves.stream(), torch.enable_grad():
        trajectory = simulator.rollout(state, steps, Inputs(**acting), values)
    results = [trajectory.q, trajectory.v]
    arrays = [leaves.result(tensor) for tensor in results]
    if leaves.pairs:
        tape.record_func(leaves.backward(results, arrays), [array for array, _ in leaves.pairs] + arrays)
    return RecordedRollout(arrays[0], arrays[1], trajectory.reports)


class _Leaves:
    """Inputs of a roll-out as leaves of a torch graph, on the memory of the arrays.

    Attributes:
        pairs: arrays that require gradients, with their leaves.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.dtype, self.device = simulator.dtype, simulator.rest_positions.device
        self._warp_device = wp.device_from_torch(self.device)
        self.pairs: list[tuple[wp.array, torch.Tensor]] = []

    def vectors(self, name: str, array: wp.array) -> torch.Tensor:
        """Returns the leaf (..., 3) of an array of vec3."""
        return self._leaf(name, array, _VECTORS[self.dtype])

    def scalars(self, name: str, array: wp.array) -> torch.Tensor:
        """Returns the leaf of an array of numbers."""
        return self._leaf(name, array, _SCALARS[self.dtype])

    def _leaf(self, name: str, array: wp.array, dtype: type) -> torch.Tensor:
        if not isinstance(array, wp.array) or array.dtype != dtype or array.device != self._warp_device:
            raise InputError(
                f"{name} must be a Warp array of {dtype.__name__} on {self._warp_device}, like the simulator."
            )
        leaf = wp.to_torch(array, requires_grad=False)
        if array.requires_grad:
            leaf.requires_grad_(True)
            self.pairs.append((array, leaf))
        return leaf

    def result(self, tensor: torch.Tensor) -> wp.array:
        """Returns an array of vec3 on the memory of a tensor of the graph."""
        dtype = _VECTORS[self.dtype]
        array = wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=bool(self.pairs))
        return cast(wp.array, array)

    def stream(self) -> AbstractContextManager[object]:
        """Makes torch work on Warp's stream, so that neither overtakes the other."""
        if self.device.type == "cpu":
            return nullcontext()
        return torch.cuda.stream(wp.stream_to_torch(self._warp_device))

    def backward(self, results: list[torch.Tensor], arrays: list[wp.array]) -> Callable[[], None]:
        """Returns the function that adds the gradients of the results to the arrays of the leaves."""

        def differentiate() -> None:
            with self.stream():
                adjoints = [wp.to_torch(array.grad) for array in arrays]
                leaves = [leaf for _, leaf in self.pairs]
                gradients = torch.autograd.grad(results, leaves, adjoints, retain_graph=True, allow_unused=True)
                for (array, _), gradient in zip(self.pairs, gradients, strict=True):
                    if gradient is not None:
                        wp.to_torch(array.grad).add_(gradient)
                for array, adjoint in zip(arrays, adjoints, strict=True):
                    if not array.retain_grad:
                        adjoint.zero_()

        return differentiate
