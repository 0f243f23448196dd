"""Solver-in-the-loop refinement: a residual force that was trained on single steps, trained on through the simulator.

The loss is how far the simulator, with the predicted force, is from the target trajectory over windows of k steps that
start on it (Um et al. 2020, "Solver-in-the-Loop"). Its gradient goes back through the implicit adjoint of every step.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from typing_extensions import override

from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError, InputError
from .full_batch import FullBatchTrainer
from .networks import ResidualForce
from .rollout import FURTHEST, ForcePredictor, HybridRollout

REFINEMENTS = ("none", "solver_in_the_loop")
_SMALLEST_UNIT = 1e-20  # mm^2


@dataclass(frozen=True)
class Motion:
    """Target trajectories of a split.

    Attributes:
        q: (R, T + 1, N, 3) positions [m].
        v: (R, T + 1, N, 3) velocities [m/s].
    """

    q: torch.Tensor
    v: torch.Tensor


@dataclass(frozen=True)
class Windows:
    """Pieces of trajectories.

    Attributes:
        trajectory: (W,) number of the trajectory.
        frame: (W,) frame that the window starts from.
    """

    trajectory: torch.Tensor
    frame: torch.Tensor

    def __len__(self) -> int:
        """W."""
        return len(self.frame)

    def pick(self, which: torch.Tensor) -> "Windows":
        """Some of them, by number."""
        return Windows(self.trajectory[which], self.frame[which])


class WindowLoss:
    """Distances from the target over windows of k steps.

    Args:
        predict: residual force, differentiable in the weights of its network.
        make_simulator: a new simulator whose solver settings count failures. Every loss is computed with one: the
            factor that a solver keeps would make it depend on what was computed before.
        window: k.
        batch_size: windows that are simulated at once.
    """

    def __init__(
        self, predict: ForcePredictor, make_simulator: Callable[[], Simulator], window: int, batch_size: int
    ) -> None:
        self._predict, self._make_simulator = predict, make_simulator
        self._window, self._batch_size = window, batch_size
        simulator = make_simulator()
        self._first_frame = 1 if simulator.integrator == "bdf2" else 0  # BDF2 looks back.
        rest = simulator.rest_positions
        self.failure = (1e3 * FURTHEST * float((rest.amax(0) - rest.amin(0)).max())) ** 2  # of a window [mm^2]

    def side_by_side(self, motion: Motion) -> Windows:
        """Windows that cover the trajectories, but for what is left over at their ends."""
        trajectories, frames = motion.q.shape[:2]
        start = torch.arange(self._first_frame, frames - self._window, self._window)
        return Windows(torch.arange(trajectories).repeat_interleave(len(start)), start.repeat(trajectories))

    @torch.no_grad()
    def measure(self, windows: Windows, motion: Motion) -> tuple[float, torch.Tensor]:
        """Mean squared distance [mm^2] of the windows that can be simulated, and (W,) bool: which of them cannot."""
        simulator = self._make_simulator()
        parts = [windows.pick(part) for part in torch.arange(len(windows)).split(self._batch_size)]
        measured = [self._distances(simulator, part, motion) for part in parts]
        squares, lost = (torch.cat(tensors) for tensors in zip(*measured, strict=True))
        return float(squares.mean()), lost

    def backward(self, windows: Windows, motion: Motion, unit: float) -> float:
        """Mean squared distance in a unit [mm^2]; adds its gradient to those of the weights.

        A window that cannot be simulated counts as `FURTHEST` body lengths, without a gradient.
        """
        simulator = self._make_simulator()
        total, each = 0.0, 1.0 / (unit * len(windows))
        for part in torch.arange(len(windows)).split(self._batch_size):
            squares, lost = self._distances(simulator, windows.pick(part), motion)
            failed = int(lost.sum())
            if len(squares):
                try:
                    torch.autograd.backward(each * squares.sum())
                except ConvergenceError:  # A state without a gradient is no place for the optimiser to be.
                    squares, failed = squares[:0], len(part)
            total += each * (float(squares.detach().sum()) + failed * self.failure)
        return total

    def _distances(self, simulator: Simulator, windows: Windows, motion: Motion) -> tuple[torch.Tensor, torch.Tensor]:
        """(U,) mean squared distances [mm^2] of the windows that can be simulated, and (W,) bool: which cannot.

        Where some fail, the others are simulated again beside copies of each other, so that neither their states nor
        their gradients meet a number that is not finite.
        """
        batch = len(windows)
        whole = torch.arange(batch)
        lost = torch.ones(batch, dtype=torch.bool)
        while len(whole):
            chosen = windows.pick(whole[torch.arange(batch) % len(whole)])
            squares, failed = self._roll_out(simulator, chosen, motion)
            failed = failed[: len(whole)]
            if not bool(failed.any()):
                lost[whole] = False
                return squares[: len(whole)], lost
            whole = whole[~failed.cpu()]
        return motion.q.new_zeros(0), lost

    def _roll_out(self, simulator: Simulator, windows: Windows, motion: Motion) -> tuple[torch.Tensor, torch.Tensor]:
        """(W,) mean squared distances [mm^2], and (W,) bool: which windows failed."""
        run, frame = windows.trajectory, windows.frame
        previous = None
        if self._first_frame:
            previous = (motion.q[run, frame - 1], motion.v[run, frame - 1])
        state = State(motion.q[run, frame], motion.v[run, frame], previous)
        rollout = HybridRollout(simulator, self._predict)
        squares = state.q.new_zeros(len(windows))
        for step in range(1, self._window + 1):
            state = rollout.differentiable_step(state)
            distance = 1e3 * (state.q - motion.q[run, frame + step])
            squares = squares + distance.square().sum(-1).mean(-1)
        return squares / self._window, rollout.lost(state)


class SolverInTheLoop(FullBatchTrainer):
    """Minimises the squared distance from the target over windows of k steps, by L-BFGS.

    The windows lie side by side over the trajectories: the loss is one smooth function of the weights. Losses are mean
    squared distances of vertices [mm^2].

    The weights that it starts from are the first candidate: what is kept is never worse on the validation split. The
    history starts with their record, of epoch 0. Windows that fail with them are left out; a step of the optimiser with
    which another one fails costs so much that the line search goes back.

    Args:
        model: to refine.
        loss: of windows.
        train: training trajectories.
        validation: held-out trajectories.
        rollout_error: mean roll-out error on the validation split [mm]; infinite where a roll-out diverged.
        config: the group ``refinement``.

    Raises:
        InputError: a setting out of range.
    """

    def __init__(
        self,
        model: ResidualForce,
        loss: WindowLoss,
        train: Motion,
        validation: Motion,
        rollout_error: Callable[[ResidualForce], float],
        config: Mapping[str, Any],
    ) -> None:
        check_refinement(config, train.q.shape[1] - 1)
        super().__init__(model, rollout_error, config)
        self._loss, self._train, self._validation = loss, train, validation
        self._windows = loss.side_by_side(train)

    @override
    def _run_epoch(self) -> dict[str, float]:
        if not self.state.history:
            self._begin()
        return {"train_loss": self._iterate() * self._unit, **self._validate()}

    def _begin(self) -> None:
        """Leaves out the windows that cannot be simulated, and measures the weights that refinement starts from."""
        loss, lost = self._loss.measure(self._windows, self._train)
        if bool(lost.all()):
            raise InputError(
                "the simulator fails in every window of the training split with the trained network's forces: take a "
                f"smaller refinement.window than {self.config['window']}, or refinement=none."
            )
        self._windows = self._windows.pick((~lost).nonzero()[:, 0])
        losses = {"train_loss": loss, **self._validate()}
        left_out = float(lost.sum())
        self._keep({"epoch": 0.0, **losses, "left_out": left_out, "rollout_error_mm": self.rollout_error(self.model)})

    def _validate(self) -> dict[str, float]:
        """Loss on the validation split; infinite where the simulator fails in a window."""
        loss, lost = self._loss.measure(self._loss.side_by_side(self._validation), self._validation)
        return {"validation_loss": math.inf if bool(lost.any()) else loss}

    @property
    def _unit(self) -> float:
        """The first loss [mm^2], which makes one of what the optimiser sees."""
        return max(self.state.history[0]["train_loss"], _SMALLEST_UNIT)

    @override
    def _backward(self) -> float:
        return self._loss.backward(self._windows, self._train, self._unit)

    @override
    def snapshot(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        tensors, metadata = super().snapshot()
        tensors |= {"windows.trajectory": self._windows.trajectory, "windows.frame": self._windows.frame}
        return tensors, metadata

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._windows = Windows(tensors["windows.trajectory"], tensors["windows.frame"])


def check_refinement(config: Mapping[str, Any], steps: int) -> None:
    """Checks the ranges of the group ``refinement``.

    Args:
        config: the group.
        steps: of a trajectory.

    Raises:
        InputError: an unknown kind, or a setting out of range.
    """
    if config["kind"] not in REFINEMENTS:
        raise InputError(f"refinement.kind is {config['kind']!r}: choose one of {', '.join(REFINEMENTS)}.")
    if config["kind"] == "none":
        return
    for key in ("window", "epochs", "batch_size", "memory", "rollout_every"):
        if not config[key] > 0:
            raise InputError(f"refinement.{key} is {config[key]}: it must be positive.")
    if config["window"] >= steps:
        raise InputError(f"refinement.window is {config['window']}: it must be less than the data's {steps} steps.")
