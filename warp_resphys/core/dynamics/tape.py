"""Roll-outs on a Warp tape, with the same gradients as ``torch.autograd``.

A recorded roll-out can be combined with other kernels on a tape; ``tape.backward`` differentiates
all of them::

    with wp.Tape() as tape:
        wp.launch(forces, dim=..., inputs=[parameters], outputs=[forces])
        path, speeds = record_rollout(
            tape, simulator, q, v, steps=60, inputs={"external_force": forces}
        )
        wp.launch(loss, dim=..., inputs=[path], outputs=[value])
    tape.backward(value)

Nothing is copied: torch uses the memory of the input arrays, and the result arrays use torch's
memory. As with torch, a step keeps only its states and terms for the adjoint.
"""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import cast

import torch
import warp as wp

from ...io.errors import InputError
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .simulator import Simulator

_VECTOR_INPUTS = ("external_force", "internal_force", "fixed_positions")
_SCALARS = {torch.float64: wp.float64, torch.float32: wp.float32}
_VECTORS = {torch.float64: wp.vec3d, torch.float32: wp.vec3f}


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
) -> tuple[wp.array, wp.array]:
    """Simulates several time steps and records their adjoint on a tape.

    Gradients are added to the ``grad`` of every input array that requires gradients. As for Warp's
    kernels, the arrays must keep their values until ``tape.backward``, which reads the gradients of
    the results and sets them to zero unless they are retained. It may be called repeatedly.

    Args:
        tape: a tape, active or not.
        simulator: the simulator; every array must have its device and dtype.
        q: (B, N) vec3 positions [m]; Prony branches start relaxed.
        v: (B, N) vec3 velocities [m/s].
        steps: number of steps T.
        previous: (q, v) one step earlier, to continue a roll-out by BDF2: its ``(q[-2], v[-2])``.
        inputs: inputs by name: ``external_force`` and ``internal_force`` (B, N) vec3 [N],
            ``fixed_positions`` (B, D) vec3 [m], ``attached_mass`` (B, N) [kg], and those of the
            energies (B, n); all but the masses may have a leading time axis T.
        parameters: parameters by name, with shapes as in `Simulator.prepare`.

    Returns:
        Positions [m] and velocities [m/s] as (T + 1, B, N) vec3, including the start.

    Raises:
        InputError: an unknown parameter, a wrong dtype, device or shape, or values that are not
            finite.
        ConvergenceError: as in `Simulator.step`.
    """
    leaves = _Leaves(simulator)
    back = None
    if previous is not None:
        back = leaves.vectors("previous q", previous[0]), leaves.vectors("previous v", previous[1])
    state = State(leaves.vectors("q", q), leaves.vectors("v", v), back)
    fields = {
        name: (leaves.vectors if name in _VECTOR_INPUTS else leaves.scalars)(name, array)
        for name, array in (inputs or {}).items()
    }
    values = {name: leaves.scalars(name, array) for name, array in (parameters or {}).items()}
    with leaves.stream(), torch.enable_grad():
        motion = simulator.rollout(state, steps, Inputs(**fields), values)
    results = [motion.q, motion.v]
    arrays = [leaves.result(tensor) for tensor in results]
    if leaves.pairs:
        tape.record_func(
            leaves.backward(results, arrays), [array for array, _ in leaves.pairs] + arrays
        )
    return arrays[0], arrays[1]


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
        if (
            not isinstance(array, wp.array)
            or array.dtype != dtype
            or array.device != self._warp_device
        ):
            raise InputError(
                f"{name} must be a Warp array of {dtype.__name__} "
                f"on {self._warp_device}, like the simulator."
            )
        leaf = wp.to_torch(array, requires_grad=False)
        if array.requires_grad:
            leaf.requires_grad_(True)
            self.pairs.append((array, leaf))
        return leaf

    def result(self, tensor: torch.Tensor) -> wp.array:
        """Returns the array of vec3 on the memory of a result tensor."""
        array = wp.from_torch(
            tensor.detach(), dtype=_VECTORS[self.dtype], requires_grad=bool(self.pairs)
        )
        return cast(wp.array, array)

    def stream(self) -> AbstractContextManager[object]:
        """Returns a context in which torch uses Warp's stream,
        so that their operations are ordered.
        """
        if self.device.type == "cpu":
            return nullcontext()
        return torch.cuda.stream(wp.stream_to_torch(self._warp_device))

    def backward(self, results: list[torch.Tensor], arrays: list[wp.array]) -> Callable[[], None]:
        """Returns the function that propagates the gradients of the results to the leaves."""

        def differentiate() -> None:
            with self.stream():
                adjoints = [wp.to_torch(array.grad) for array in arrays]
                leaves = [leaf for _, leaf in self.pairs]
                gradients = torch.autograd.grad(
                    results, leaves, adjoints, retain_graph=True, allow_unused=True
                )
                for (array, _), gradient in zip(self.pairs, gradients, strict=True):
                    if gradient is not None:
                        wp.to_torch(array.grad).add_(gradient)
                for array, adjoint in zip(arrays, adjoints, strict=True):
                    if not array.retain_grad:
                        adjoint.zero_()

        return differentiate
