"""Terms on points that belong to parts, such as chambers, tendons or muscles, with values for each part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ..fem.elements import Points
from .base import Adjoint, PointSet, Term, Values, value_of
from .launcher import Launcher, warp_view


@dataclass(frozen=True)
class PartPoints(Points):
    """Weighted points that belong to the parts of an energy, such as chambers or tendons."""

    part: NDArray[np.int64]  # (P,) index of the part
    weights: NDArray[np.float64]  # (P,) weight of the point's energy: a volume, an area, a length, or one


class PartTerm(Term):
    """A term on one set of `PartPoints` of ``count`` parts, with the `shapes` of its values."""

    def __init__(
        self, launcher: Launcher, sets: Sequence[PointSet], shapes: Mapping[str, tuple[int, ...]], count: int
    ) -> None:
        super().__init__(launcher, sets)
        (s,) = sets
        assert isinstance(s.source, PartPoints)
        self._shapes, self.count = dict(shapes), count
        self.weights = launcher.upload(s.source.weights, wp.float64)
        self.part = launcher.upload(s.source.part.astype(np.int32), int)
        self._one_hot = torch.as_tensor(np.eye(count)[s.source.part], device=launcher.device)  # (P, count)
        self.part_of = torch.as_tensor(s.source.part, device=launcher.device)
        self.weight = torch.as_tensor(s.source.weights, device=launcher.device)

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return self._shapes

    def views(self, values: Values) -> list[Any]:
        """Returns the values of the step as kernel arguments, in the order of `shapes`."""
        return [warp_view(value_of(values, name), wp.float64) for name in self.shapes]

    def sum_parts(self, values: torch.Tensor) -> torch.Tensor:
        """Returns the sums (B, count) of values (B, P) over the points of each part, in a fixed order."""
        return values @ self._one_hot


class ReadingTerm(PartTerm):
    """A term whose kernels read any number of values at each point (``kernels.points.value_reader``).

    Args:
        launcher: launcher of the potential.
        sets: one set of points.
        kernels: ``local_step``, ``tangent`` and ``adjoint``, and the vector type ``values``.
        shapes: shapes of the values in the order of the vector: (count,) or (count, n) for one or n values per part.
        count: number of parts.
        arrays: names of arrays, of any shape, that every point reads completely.
        extra: arguments of the kernels after the values.
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        kernels: Any,
        shapes: Mapping[str, tuple[int, ...]],
        count: int,
        arrays: Sequence[str] = (),
        extra: Sequence[Any] = (),
    ) -> None:
        super().__init__(launcher, sets, shapes, count)
        self._kernels, self._extra = kernels, extra
        self._arrays = frozenset(arrays)
        part = self.part_of.cpu().numpy()
        self._columns = {name: self._columns_of(name, part) for name in self._shapes}
        self._column = launcher.upload(np.concatenate(list(self._columns.values())).astype(np.int32), int)
        sizes = [int(np.prod(shape)) for name, shape in self._shapes.items() for _ in self._columns[name]]
        self._sizes = launcher.upload(np.array(sizes, dtype=np.int32), int)

    def _columns_of(self, name: str, part: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns the columns (n, P) of the values of each point in a row of their array."""
        if name in self._arrays:
            return np.tile(np.arange(int(np.prod(self._shapes[name])))[:, None], len(part))
        n = int(np.prod(self._shapes[name][1:]))
        return np.stack([part * n + k for k in range(n)])

    @override
    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        pointers = [value_of(values, name).data_ptr() for name in self._shapes for _ in self._columns[name]]
        addresses = self.launcher.upload(np.array(pointers, dtype=np.uint64), wp.uint64)
        read = [addresses, self._sizes, self._column]
        return [s.nodes, s.gradients, self.weights, *read, *self._extra, s.points_per_cell, positions]

    @override
    def adjoint(self, values: Values, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points, self._kernels.values._length_)
        inputs = [*self._arguments(s, values, warp_view(positions, wp.vec3d)), warp_view(direction, wp.vec3d)]
        view = warp_view(out, self._kernels.values)
        command = own.record(self._kernels.adjoint, (own.batch, s.n_points), inputs, [view])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            slopes, first = {}, 0
            for name, shape in self._shapes.items():
                slope = out[..., first : first + len(self._columns[name])]
                whole = name in self._arrays
                slope = slope.sum(1) if whole else torch.einsum("bpn,pc->bcn", slope, self._one_hot)
                slopes[name] = slope.reshape(own.batch, *shape).clone()
                first += len(self._columns[name])
            return slopes

        return differentiate
