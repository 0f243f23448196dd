"""Solver-in-the-loop refinement: a residual force trained on single steps is trained further through the simulator.

The loss is the distance between simulated and observed points over windows of k steps, which start at observed or
reconstructed states (Um et al. 2020, "Solver-in-the-Loop"). Its gradient goes back through the implicit adjoint of
every step.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from typing_extensions import override

from ..data.observation import WHOLE_STATE, Observation
from ..data.trials import Trials
from ..dynamics.frames import BaseFrame, VertexFrames
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError, InputError
from ..settings.learning import RefinementSettings
from ..stepping.state import State
from .full_batch import FullBatchTrainer
from .networks import ResidualForce
from .predictors import LearnedPredictor, Range
from .replay import Replay
from .rollout import DIVERGENCE_DISTANCE, Rollout

_WINDOW = ("motion", "trial", "frame")
_SMALLEST_UNIT = 1e-20  # mm^2


@dataclass(frozen=True)
class RefinementBatch:
    """Trials that begin alike, at the steps of a simulator.

    Attributes:
        q: (R, K + 1, N, 3) initial positions of windows [m].
        v: (R, K + 1, N, 3) initial velocities [m/s].
        target: (R, K + 1, M, 3) observed points [m], NaN where a point was not seen.
        trials: give the inputs.
        context: see `LearnedPredictor`; None for none.
        base: moving frame of the base in which the model predicts; None where the base stands still.
    """

    q: torch.Tensor
    v: torch.Tensor
    target: torch.Tensor
    trials: Trials
    context: torch.Tensor | None = None
    base: BaseFrame | None = None


@dataclass(frozen=True)
class Windows:
    """W windows of trials.

    Attributes:
        motion: (W,) index of the `RefinementBatch`.
        trial: (W,) index of the trial in the batch.
        frame: (W,) first frame of the window.
    """

    motion: torch.Tensor
    trial: torch.Tensor
    frame: torch.Tensor

    def __len__(self) -> int:
        """Number of windows, W."""
        return len(self.frame)

    def pick(self, index: torch.Tensor) -> "Windows":
        """Returns the windows of an index."""
        return Windows(self.motion[index], self.trial[index], self.frame[index])


class WindowLoss:
    """Mean squared distance from the target over windows of k steps.

    Args:
        model: residual force, differentiable in the weights of its network.
        make_simulator: returns a new simulator whose solver settings count failures. Every loss is computed with a new
            one: with the factorisation that a solver keeps, the loss would depend on earlier computations.
        window: k.
        batch_size: number of windows that are simulated at once.
        observe: observation of the body; all vertices if left out.
        parameters: (1,) identified physical parameters.
        frames: vertex frames in which forces are predicted; None for the world's frame.
        range_: to which the model's inputs are clamped; None for no clamping.
    """

    def __init__(
        self,
        model: ResidualForce,
        make_simulator: Callable[[], Simulator],
        window: int,
        batch_size: int,
        observe: Observation = WHOLE_STATE,
        parameters: Mapping[str, torch.Tensor] | None = None,
        frames: VertexFrames | None = None,
        range_: Range | None = None,
    ) -> None:
        self._model, self._make_simulator, self._observe = model, make_simulator, observe
        self._window, self._batch_size = window, batch_size
        self._parameters, self._frames, self._range = parameters or {}, frames, range_
        self._memories: dict[int, tuple[RefinementBatch, dict[str, torch.Tensor]]] = {}  # by id() of the batch
        simulator = make_simulator()
        self._first_frame = 1 if simulator.integrator == "bdf2" else 0  # BDF2 needs the state before.
        rest = simulator.rest_positions
        self.failure = (
            1e3 * DIVERGENCE_DISTANCE * float((rest.amax(0) - rest.amin(0)).max())
        ) ** 2  # of a window [mm^2]

    def consecutive(self, motions: Sequence[RefinementBatch]) -> Windows:
        """Consecutive windows over all trials, without incomplete ones and those in which nothing was seen."""
        windows = []
        for number, motion in enumerate(motions):
            frames = motion.q.shape[1]
            start = torch.arange(self._first_frame, frames - self._window, self._window)
            trial, frame = (t.flatten() for t in torch.meshgrid(torch.arange(len(motion.q)), start, indexing="ij"))
            span = frame[:, None] + torch.arange(1, self._window + 1)
            seen = torch.isfinite(motion.target.cpu()[trial[:, None], span]).all(-1).flatten(1).any(1)
            known = torch.isfinite(motion.q.cpu()[trial, frame]).flatten(1).all(1)
            windows.append([x[seen & known] for x in (torch.full_like(trial, number), trial, frame)])
        return Windows(*(torch.cat(parts) for parts in zip(*windows, strict=True)))

    @torch.no_grad()
    def measure(self, windows: Windows, motions: Sequence[RefinementBatch]) -> tuple[float, torch.Tensor]:
        """Returns the mean squared distance of the windows that do not fail [mm^2], and which fail, (W,) bool."""
        simulator = self._make_simulator()
        lost = torch.zeros(len(windows), dtype=torch.bool)
        squares: list[torch.Tensor] = []
        for part in self._parts(windows):
            measured, failed = self._distances(simulator, windows.pick(part), motions)
            lost[part], squares = failed, [*squares, measured]
        return float(torch.cat(squares).mean()), lost

    def backward(self, windows: Windows, motions: Sequence[RefinementBatch], unit: float) -> float:
        """Returns the mean squared distance relative to a unit [mm^2]; adds its gradient to those of the weights.

        The distance of a failed window is `DIVERGENCE_DISTANCE` body lengths, without a gradient.
        """
        simulator = self._make_simulator()
        total, weight = 0.0, 1.0 / (unit * len(windows))
        for part in self._parts(windows):
            squares, lost = self._distances(simulator, windows.pick(part), motions)
            failed = int(lost.sum())
            if len(squares):
                try:
                    torch.autograd.backward(weight * squares.sum())
                except ConvergenceError:  # The adjoint fails: these weights count as failed.
                    squares, failed = squares[:0], len(part)
            total += weight * (float(squares.detach().sum()) + failed * self.failure)
        return total

    def _memory(self, simulator: Simulator, motion: RefinementBatch) -> dict[str, torch.Tensor]:
        """Returns the internal variables of the energies at the start of all windows, by name, (R, W, ...).

        They are updated through every state of the motion, from rest in the first known state on; an unknown state is
        taken to equal the one before. Empty for energies without internal variables.
        """
        if id(motion) not in self._memories:
            constants, inputs, _ = Replay(simulator, self._observe, motion.trials).prepare(self._parameters)
            memories, state = list[Mapping[str, torch.Tensor]](), simulator.rest_state(len(motion.q))
            began = torch.zeros(state.batch, dtype=torch.bool, device=state.q.device)
            for frame in range(motion.q.shape[1]):
                q = motion.q[:, frame]
                known = torch.isfinite(q).flatten(1).all(1)
                before = torch.where((known & ~began)[:, None, None], q, state.q)  # at rest in the first known state
                q, began = torch.where(known[:, None, None], q, before), began | known
                with torch.no_grad():
                    acting = inputs.at(max(frame - 1, 0))
                    state = simulator.remember(replace(state, q=before), q, constants, acting)
                if not state.memory:
                    break
                if frame >= self._first_frame and (frame - self._first_frame) % self._window == 0:
                    memories.append(state.memory)
            names = memories[0] if memories else ()
            self._memories[id(motion)] = (motion, {n: torch.stack([m[n] for m in memories], 1) for n in names})
        return self._memories[id(motion)][1]

    def _parts(self, windows: Windows) -> list[torch.Tensor]:
        """Indices of the windows that are simulated at once, which belong to one motion."""
        parts = list[torch.Tensor]()
        for motion in windows.motion.unique().tolist():
            parts += (windows.motion == motion).nonzero()[:, 0].split(self._batch_size)
        return parts

    def _distances(
        self, simulator: Simulator, windows: Windows, motions: Sequence[RefinementBatch]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mean squared distances (U,) of the windows that do not fail [mm^2], and which fail, (W,) bool.

        After a failure, the other windows are simulated again, with copies of them in place of the failed ones, so that
        their states and gradients stay finite.
        """
        batch, motion = len(windows), motions[int(windows.motion[0])]
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

    def _roll_out(
        self, simulator: Simulator, windows: Windows, motion: RefinementBatch
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mean squared distances (W,) [mm^2], and which windows failed, (W,) bool."""
        run, frame = windows.trial, windows.frame
        previous = None
        if self._first_frame:
            previous = (motion.q[run, frame - 1], motion.v[run, frame - 1])
        start = (frame - self._first_frame) // self._window
        memory = {name: values[run, start] for name, values in self._memory(simulator, motion).items()}
        state = State(motion.q[run, frame], motion.v[run, frame], previous, memory)
        constants, inputs, _ = Replay(simulator, self._observe, motion.trials.select(run.tolist())).prepare(
            self._parameters
        )
        context = None if motion.context is None else _during(motion.context.index_select(-2, run), frame, self._window)
        base = None if motion.base is None else motion.base.during(run, frame, self._window)
        predict = LearnedPredictor(self._model, context, self._range, self._frames, base)
        rollout = Rollout(simulator, predict, inputs.window(frame, self._window), constants)
        squares = state.q.new_zeros(len(windows))
        for step in range(1, self._window + 1):
            state = rollout.differentiable_step(state)
            target = motion.target[run, frame + step]
            seen = torch.isfinite(target).all(-1)
            distance = torch.where(seen[..., None], 1e3 * (self._observe(state.q) - target), 0.0)
            squares = squares + distance.square().sum((1, 2)) / seen.sum(1).clamp_min(1)
        return squares / self._window, rollout.lost(state)


def _during(series: torch.Tensor, first: torch.Tensor, steps: int) -> torch.Tensor:
    """Returns k steps (k, W, A) of series (K, W, A), from a first step for each; a constant (W, A) as it is."""
    if series.ndim == 2:
        return series
    at = (first + torch.arange(steps)[:, None]).clamp_max(len(series) - 1).to(series.device)
    return series[at, torch.arange(series.shape[1], device=series.device)]


class SolverInTheLoop(FullBatchTrainer):
    """Minimises the squared distance from the target over windows of k steps, by L-BFGS.

    The windows are consecutive pieces of the trajectories, so that the loss is one smooth function of the weights.
    Losses are mean squared distances [mm^2].

    The initial weights are the first candidate, so that the result is never worse on the validation split. The history
    starts with their record, of epoch 0. Windows that fail with them are left out. If another window fails in a step of
    the optimiser, its large loss makes the line search step back.

    Args:
        model: to refine.
        loss: of windows.
        train: training trials.
        validation: held-out trials.
        rollout_error: mean roll-out error on the validation split [mm]; infinite where a roll-out diverged.
        settings: epochs, and the memory of L-BFGS.
    """

    settings: RefinementSettings

    def __init__(
        self,
        model: ResidualForce,
        loss: WindowLoss,
        train: Sequence[RefinementBatch],
        validation: Sequence[RefinementBatch],
        rollout_error: Callable[[ResidualForce], float],
        settings: RefinementSettings,
    ) -> None:
        super().__init__(model, rollout_error, settings)
        self._loss, self._train, self._validation = loss, train, validation
        self._windows = loss.consecutive(train)

    @override
    def _run_epoch(self) -> dict[str, float]:
        if not self.state.history:
            self._begin()
        return {"train_loss": self._iterate() * self._unit, **self._validate()}

    def _begin(self) -> None:
        """Leaves out the windows that fail, and records the errors of the initial weights."""
        loss, lost = self._loss.measure(self._windows, self._train)
        if bool(lost.all()):
            raise InputError(
                "the simulator fails in every window of the training split with the trained network's forces: take a "
                f"smaller refinement.window than {self.settings.window}, or refinement=none."
            )
        self._windows = self._windows.pick((~lost).nonzero()[:, 0])
        losses = {"train_loss": loss, **self._validate()}
        left_out = float(lost.sum())
        self._keep({"epoch": 0.0, **losses, "left_out": left_out, "rollout_error_mm": self.rollout_error(self.model)})

    def _validate(self) -> dict[str, float]:
        """Loss on the validation split; infinite where the simulator fails in a window."""
        loss, lost = self._loss.measure(self._loss.consecutive(self._validation), self._validation)
        return {"validation_loss": math.inf if bool(lost.any()) else loss}

    @property
    def _unit(self) -> float:
        """The first loss [mm^2], by which the optimiser's loss is divided."""
        return max(self.state.history[0]["train_loss"], _SMALLEST_UNIT)

    @override
    def _backward(self) -> float:
        return self._loss.backward(self._windows, self._train, self._unit)

    @override
    def snapshot(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        tensors, metadata = super().snapshot()
        tensors |= {f"windows.{name}": getattr(self._windows, name) for name in _WINDOW}
        return tensors, metadata

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._windows = Windows(*(tensors[f"windows.{name}"] for name in _WINDOW))
