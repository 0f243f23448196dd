"""Recorded Warp launches on torch's memory."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from threading import RLock
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ...io.kernel_cache import ensure_kernel_cache, start_quietly
from ...kernels import points
from ...kernels.modules import RecordedLaunch, launch_stream, shareable

_GPU = RLock()  # Threads take turns on a GPU, whose stream they share.
_MANY_POINTS = 10_000  # of a set, whose stresses a CPU's caches do not hold
# Threads per block on a GPU; the same for all kernels, as Warp compiles a module once per block
# size.
BLOCK = 128

ensure_kernel_cache()  # before Warp is first used


def warp_view(tensor: torch.Tensor, dtype: Any) -> Any:
    """Returns a Warp array on a tensor's memory, without gradient."""
    start_quietly()  # `from_torch` does not
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def struct_of(kind: Any, /, **fields: Any) -> Any:
    """Returns a Warp struct, whose arrays are on the memory of contiguous tensors."""
    out = kind()
    for name, value in fields.items():
        declared = kind.vars[name].type
        if isinstance(value, torch.Tensor):
            value = warp_view(value, declared.dtype)
        setattr(out, name, value)
    return out


def launch(
    kernel: Any, dim: Sequence[int], inputs: list[Any], outputs: list[Any], device: torch.device
) -> None:
    """Launches a kernel once, on torch's stream."""
    with shareable():
        options: dict[str, Any] = {
            "block_dim": BLOCK,
            "device": str(device),
            "stream": launch_stream(device),
        }
        wp.launch(kernel, dim=tuple(dim), inputs=inputs, outputs=outputs, **options)


@contextmanager
def lasting() -> Iterator[None]:
    """Makes tensors that serve outside of ``torch.inference_mode`` too,
    without gradient if made there.
    """
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(False), torch.no_grad():
        yield


class Launcher:
    """Buffers of float64 and kernel launches for a batch, on one device.

    Args:
        batch: number of environments B.
        device: device of every buffer.

    Attributes:
        active: (B,) zero for environments that kernels skip, such as converged ones during a solve.
        lock: held while the buffers are in use, as a backward pass may run in another thread.
    """

    by_cells = False  # whether there is one thread per node or pair of nodes of a cell, as on a GPU

    def __init__(self, batch: int, device: torch.device) -> None:
        self.batch, self.device = batch, device
        self.by_cells = self.by_cells or device.type == "cuda"
        self.lock = RLock() if device.type == "cpu" else _GPU
        self.active = torch.ones(batch, device=device, dtype=torch.int32)

    def zeros(self, *shape: int) -> torch.Tensor:
        """Returns zeros (B, *shape) on the launcher's device,
        which serve outside of inference mode, too.
        """
        with lasting():
            return torch.zeros(self.batch, *shape, device=self.device, dtype=torch.float64)

    def upload(self, values: NDArray[Any], dtype: Any) -> Any:
        """Returns a Warp array with a copy of the values."""
        with shareable():
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=str(self.device))

    def record(
        self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]
    ) -> Any:
        """Returns a recorded launch, for `launch`."""
        options: dict[str, Any] = {
            "block_dim": BLOCK,
            "device": str(self.device),
            "record_cmd": True,
        }
        with shareable():
            return RecordedLaunch(
                wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **options)
            )

    def run(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        """Launches a kernel once."""
        self.launch(self.record(kernel, dim, inputs, outputs))

    def record_blocks(self, kernel: Any, blocks: int, inputs: list[Any], outputs: list[Any]) -> Any:
        """Returns a recorded launch with cooperating blocks
        of threads (one thread per block on a CPU).
        """
        options: dict[str, Any] = {
            "block_dim": BLOCK,
            "device": str(self.device),
            "record_cmd": True,
        }
        with shareable():
            return RecordedLaunch(
                wp.launch_tiled(kernel, dim=[blocks], inputs=inputs, outputs=outputs, **options)
            )

    def gather(self, s: Any, stress: Any, out: torch.Tensor) -> Any:
        """Returns a launch that adds the transposed operators applied
        to a set's stress to ``out`` (B, N, 3).

        With ``by_cells``, or many points and several of them in a cell, there are two launches,
        which read the stress of a cell once for all its nodes.
        """
        outputs, kernels = [warp_view(out, wp.vec3d)], points.set_kernels(s.width)
        if not self.by_cells and (s.points_per_cell == 1 or s.n_points < _MANY_POINTS):
            inputs = [s.points, s.start, s.incident, stress]
            return self.record(kernels.gather, (self.batch, out.shape[1]), inputs, outputs)
        forces = [warp_view(self.zeros(s.cells * s.nodes_per_cell, 3), wp.vec3d)]
        cells, active = (self.batch, s.cells * s.nodes_per_cell), warp_view(self.active, wp.int32)
        return LaunchSequence(
            self.record(kernels.cell_forces, cells, [active, s.points, stress], forces),
            self.record(
                points.gather_cells,
                (self.batch, out.shape[1]),
                [s.start, s.incident, *forces],
                outputs,
            ),
        )

    def product(self, s: Any, tangent: Any, direction: Any, stress: Any) -> Any:
        """Returns a launch that computes a set's stress
        from its tangent (B, P, blocks) and a direction (B, N).
        """
        inputs = [s.points, tangent, direction]
        kernel = points.set_kernels(s.width).tangent_product
        return self.record(kernel, (self.batch, s.n_points), inputs, [stress])

    def capture(self, *commands: Any) -> "CapturedGraph | LaunchSequence":
        """Returns recorded launches as one graph, also on a CPU,
        where it costs a sixth of the single launches.

        Between those that the host makes (`HostLaunches`) there are several graphs.
        """
        if not any(isinstance(command, HostLaunches) for command in commands):
            return self.capture_calls(lambda: issue(*commands), commands)
        groups = itertools.groupby(commands, lambda command: isinstance(command, HostLaunches))
        parts = [list(group) if by_host else [self.capture(*group)] for by_host, group in groups]
        return LaunchSequence(*itertools.chain(*parts))

    def capture_calls(self, calls: Callable[[], None], commands: Iterable[Any]) -> "CapturedGraph":
        """Returns a graph of the launches that a function makes.

        Args:
            calls: makes the launches, by `issue`, ``wp.capture_while`` and ``wp.capture_if``.
            commands: all launches that it may make.
        """
        with self.lock, RecordedLaunch.captured(self.device) as capture:
            calls()
        return CapturedGraph(capture.graph, tuple(commands))

    def launch(self, *commands: Any) -> None:
        """Launches recorded launches and graphs on torch's stream."""
        stream = launch_stream(self.device)
        for command in commands:
            command.launch(stream)


def issue(*commands: Any) -> None:
    """Launches one by one, with graphs expanded, into the graph that is being captured."""
    for command in commands:
        if isinstance(command, CapturedGraph | LaunchSequence):
            issue(*command.commands)
        else:
            command.launch()


class CapturedGraph:
    """A graph of launches, with the interface of a recorded launch."""

    def __init__(self, graph: Any, commands: tuple[Any, ...]) -> None:
        self._graph, self.commands = graph, commands  # keeps the arrays of the launches alive

    def launch(self, stream: Any = None) -> None:
        """Launches the graph."""
        wp.capture_launch(self._graph, stream)


class HostLaunches:
    """Launches that the host makes anew every time, with the interface of a recorded launch.

    Args:
        commands: returns recorded launches.
    """

    def __init__(self, commands: Callable[[], Sequence[Any]]) -> None:
        self._commands = commands

    def launch(self, stream: Any = None) -> None:
        """Launches them in order."""
        for command in self._commands():
            command.launch(stream)


class LaunchSequence:
    """Several recorded launches, with the interface of one."""

    def __init__(self, *commands: Any) -> None:
        self.commands = commands

    def launch(self, stream: Any = None) -> None:
        """Launches them in order."""
        for command in self.commands:
            command.launch(stream)
