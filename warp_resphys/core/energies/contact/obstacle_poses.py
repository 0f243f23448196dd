"""Poses of obstacles, and distances and normals of points from them, differentiable."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from ....kernels.contact import signed_distances as kernels
from ...stepping.adjoints import AdjointFunction, first_derivatives
from ..launcher import Launcher, struct_of, warp_view
from .obstacles import KINDS, DistanceGrid
from .touching_bodies import Obstacle


@dataclass(frozen=True)
class Pose:
    """Places (B, O, 3) [m], rotations (B, O, 3, 3) and growth (B, O) [m] of obstacles."""

    place: torch.Tensor
    turn: torch.Tensor
    growth: torch.Tensor

    @classmethod
    def joined(cls, poses: "Sequence[Pose]") -> "Pose":
        """Returns the poses of several sets of obstacles as those of one."""
        parts = [(pose.place, pose.turn, pose.growth) for pose in poses]
        return cls(*(torch.cat(fields, 1) for fields in zip(*parts, strict=True)))

    def local(self, x: torch.Tensor) -> torch.Tensor:
        """Returns positions (B, P, O, 3) in the axes of the obstacles, from those in the world."""
        return torch.einsum("boji,bpoj->bpoi", self.turn, x - self.place[:, None])

    def world(self, y: torch.Tensor) -> torch.Tensor:
        """Returns the inverse of `local`."""
        return torch.einsum("boij,bpoj->bpoi", self.turn, y) + self.place[:, None]


class ObstacleSet:
    """Shapes of obstacles on a device.

    Args:
        obstacles: the obstacles.
        reach: distance at which contact begins [m].
        device: a torch device.
    """

    def __init__(self, obstacles: tuple[Obstacle, ...], reach: float, device: torch.device) -> None:
        grids = [o if isinstance(o, DistanceGrid) else None for o in obstacles]
        parts = [np.zeros(0) if grid is None else grid.coefficients.ravel() for grid in grids]
        firsts = np.cumsum([0, *(len(part) for part in parts)])
        nodes = [
            (0,) * 4 if g is None else (*g.distances.shape, first)
            for g, first in zip(grids, firsts, strict=False)
        ]
        low = [(0.0,) * 3 if grid is None else grid.low for grid in grids]
        arrays = {
            "kind": np.array([KINDS[type(o)] for o in obstacles], dtype=np.int32),
            "size": np.array([o.size for o in obstacles]),
            "low": np.array(low),
            "nodes": np.array(nodes, dtype=np.int32),
            "coefficients": np.concatenate(parts),
        }
        self._fixed = {
            name: torch.as_tensor(values, device=device) for name, values in arrays.items()
        }
        self._reach = reach
        self._measurements: dict[tuple[int, int, int], _Measurement] = {}

    def at(self, place: torch.Tensor, turn: torch.Tensor, growth: torch.Tensor) -> Any:
        """Returns the obstacles at float64 poses, as a kernel argument that reads these tensors."""
        return struct_of(
            kernels.Obstacles,
            **self._fixed,
            reach=self._reach,
            place=place,
            turn=turn,
            growth=growth,
        )

    def distances(self, x: torch.Tensor, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns signed distances (B, P, O) [m] and normals (B, P, O, 3)
        of positions (B, P, 3), differentiable.
        """
        size = batch, points, count = (*x.shape[:2], pose.place.shape[1])
        if size not in self._measurements:
            self._measurements[size] = _Measurement(self, batch, points, count, x.device)
        d, n = _Distances.apply(self._measurements[size], x, pose.place, pose.turn, pose.growth)
        return d, n


class _Measurement(Launcher):
    """Buffers and launches of `kernels.contact.signed_distances.measure`
    and its adjoint for one size of a batch.
    """

    def __init__(
        self, shapes: ObstacleSet, batch: int, points: int, count: int, device: torch.device
    ) -> None:
        super().__init__(batch, device)
        self._size = (points, count)
        self.inputs = [
            self.zeros(points, 3),
            self.zeros(count, 3),
            self.zeros(count, 3, 3),
            self.zeros(count),
        ]
        x, *pose = self.inputs
        self._given = [shapes.at(*pose), warp_view(x, wp.vec3d)]
        self.results, views = self._pair()
        self.measure = self.record(kernels.measure, (batch, *self._size), self._given, views)

    def _pair(self) -> tuple[list[torch.Tensor], list[Any]]:
        """Returns buffers of distances and normals, and Warp's views of them."""
        buffers = [self.zeros(*self._size), self.zeros(*self._size, 3)]
        return buffers, [
            warp_view(buffer, kind)
            for buffer, kind in zip(buffers, (wp.float64, wp.vec3d), strict=True)
        ]

    @cached_property
    def adjoint(self) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor, Any]:
        """Buffers of derivatives by the results, by positions and by rotations, and the launch.

        Made when needed.
        """
        by_results, views = self._pair()
        position, turn = self.zeros(*self._size, 3), self.zeros(*self._size, 3, 3)
        slopes = [warp_view(position, wp.vec3d), warp_view(turn, wp.mat33d)]
        inputs = [*self._given, *views]
        return (
            by_results,
            position,
            turn,
            self.record(kernels.measure_adjoint, (self.batch, *self._size), inputs, slopes),
        )


class _Distances(AdjointFunction):
    """Signed distances and normals."""

    @override
    @staticmethod
    def forward(
        ctx: Any, measurement: _Measurement, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        with measurement.lock:
            for buffer, value in zip(measurement.inputs, tensors, strict=True):
                buffer.copy_(value.detach())
            measurement.launch(measurement.measure)
            d, n = (value.to(tensors[0].dtype, copy=True) for value in measurement.results)
        ctx.measurement = measurement
        ctx.save_for_backward(*tensors)
        return d, n

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, *by_results: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        measurement = ctx.measurement
        with measurement.lock:
            buffers, position, turn, command = measurement.adjoint
            for buffer, value in zip(
                (*measurement.inputs, *buffers), (*ctx.saved_tensors, *by_results), strict=True
            ):
                buffer.copy_(value)
            measurement.launch(command)
            sums = (
                lambda: position.sum(2),
                lambda: -position.sum(1),
                lambda: turn.sum(1),
                lambda: -buffers[0].sum(1),
            )
            needed = zip(sums, ctx.needs_input_grad[1:], strict=True)
            return None, *(
                slope().to(by_results[0].dtype) if used else None for slope, used in needed
            )
