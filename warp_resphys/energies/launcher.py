"""Warp launches on torch's memory, recorded once and repeated."""

from collections.abc import Callable, Iterable
from threading import Lock
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..io.kernel_cache import ensure_kernel_cache
from ..kernels import points
from ..kernels.modules import launch_stream, shareable

# Warp captures launches of all threads: only one thread may work while a simulator is new.
_CAPTURES = Lock()
BLOCK = 128  # threads of a block on a GPU, equal for all kernels: Warp compiles a module for every block size

ensure_kernel_cache()  # Before Warp is first used, by this package or by who imports it.


def warp_view(tensor: torch.Tensor, dtype: Any) -> Any:
    """Returns a Warp array on a tensor's memory, without a gradient."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


class Launcher:
    """Buffers of float64 and launches for a batch, on one device.

    Args:
        batch: environments B.
        device: of every buffer.

    Attributes:
        active: (B,) zero for environments that kernels skip, such as converged ones during a solve.
    """

    by_cells = False  # whether every node or pair of nodes of a cell has a thread of its own, as on a GPU

    def __init__(self, batch: int, device: torch.device) -> None:
        self.batch, self.device = batch, device
        self.by_cells = self.by_cells or device.type == "cuda"
        self.active = torch.ones(batch, device=device, dtype=torch.int32)

    def zeros(self, *shape: int) -> torch.Tensor:
        """Returns zeros (B, *shape) on the launcher's device."""
        return torch.zeros(self.batch, *shape, device=self.device, dtype=torch.float64)

    def upload(self, values: NDArray[Any], dtype: Any) -> Any:
        """Returns a Warp array with a copy of the values."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=str(self.device))

    def points_view(self, tensor: torch.Tensor, part: slice, dtype: Any) -> Any:
        """Returns a Warp array on the points of one set."""
        return warp_view(tensor[:, part], dtype)

    def record(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> Any:
        """Returns a recorded launch for `launch`."""
        options: dict[str, Any] = {"block_dim": BLOCK, "device": str(self.device), "record_cmd": True}
        with shareable():
            return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **options)

    def record_blocks(self, kernel: Any, blocks: int, inputs: list[Any], outputs: list[Any]) -> Any:
        """Returns a recorded launch by cooperating blocks of threads; on a CPU a block is one thread."""
        options: dict[str, Any] = {"block_dim": BLOCK, "device": str(self.device), "record_cmd": True}
        with shareable():
            return wp.launch_tiled(kernel, dim=[blocks], inputs=inputs, outputs=outputs, **options)

    def gather(self, s: Any, stress: Any, out: torch.Tensor) -> Any:
        """Returns a launch that adds the nodal forces of a set's stress, see `PointSet.stress_view`, to (B, N, 3).

        Two launches on a GPU, where a cell's threads read its stress once for all of its nodes.
        """
        to, kernels = [warp_view(out, wp.vec3d)], points.gather_kernels(s.width)
        if not self.by_cells:
            inputs = [s.nodes, s.gradients, s.points_per_cell, s.start, s.incident, stress]
            return self.record(kernels.gather, (self.batch, out.shape[1]), inputs, to)
        forces = [warp_view(self.zeros(s.cells * s.nodes_per_cell, 3), wp.vec3d)]
        cells, active = (self.batch, s.cells * s.nodes_per_cell), warp_view(self.active, wp.int32)
        return Several(
            self.record(kernels.cell_forces, cells, [active, s.gradients, s.points_per_cell, stress], forces),
            self.record(points.gather_cells, (self.batch, out.shape[1]), [s.start, s.incident, *forces], to),
        )

    def product(self, s: Any, tangent: Any, direction: Any, stress: Any) -> Any:
        """Returns a launch: stress of a set from its tangent (B, P, blocks) mat33 and a direction (B, N) vec3."""
        inputs = [s.nodes, s.gradients, s.points_per_cell, tangent, direction]
        kernel = points.line_tangent_product if s.width == 1 else points.tangent_product
        return self.record(kernel, (self.batch, s.n_points), inputs, [stress])

    def capture(self, *commands: Any) -> "Launches":
        """Returns recorded launches as one graph, on a CPU too, at a sixth of the cost of single launches."""
        return self.capture_calls(lambda: issue(*commands), commands)

    def capture_calls(self, calls: Callable[[], None], commands: Iterable[Any]) -> "Launches":
        """Returns recorded launches as one graph, in the order and under the conditions of a function.

        Args:
            calls: makes the launches, by `issue`, ``wp.capture_while`` and ``wp.capture_if``.
            commands: all launches that it may make.
        """
        with _CAPTURES, wp.ScopedCapture(device=str(self.device)) as capture:
            calls()
        return Launches(capture.graph, tuple(commands))

    def launch(self, *commands: Any) -> None:
        """Makes recorded launches, on torch's stream."""
        stream = launch_stream(self.device)
        for command in commands:
            command.launch(stream)


def issue(*commands: Any) -> None:
    """Makes recorded or captured launches one by one, as into a graph that is being captured."""
    for command in commands:
        if isinstance(command, Launches | Several):
            issue(*command.commands)
        else:
            command.launch()


class Launches:
    """Captured launches, with the interface of a recorded launch."""

    def __init__(self, graph: Any, commands: tuple[Any, ...]) -> None:
        self._graph, self.commands = graph, commands  # Keeps the arrays of the launches alive.

    def launch(self, stream: Any = None) -> None:
        """Makes all launches in their order."""
        wp.capture_launch(self._graph, stream)


class Several:
    """Several recorded launches, with the interface of one."""

    def __init__(self, *commands: Any) -> None:
        self.commands = commands

    def launch(self, stream: Any = None) -> None:
        """Makes all launches in their order."""
        for command in self.commands:
            command.launch(stream)
