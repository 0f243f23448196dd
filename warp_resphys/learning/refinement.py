"""Solver-in-the-loop refinement: a residual force that was trained on single steps, trained on through the simulator.

The loss is how far what is observed of the simulator, with the predicted force, is from the target over windows of k
steps that start on it, or on states that were reconstructed from it (Um et al. 2020, "Solver-in-the-Loop"). Its
gradient goes back through the implicit adjoint of every step.
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
from .rollout import FURTHEST, Rollout

REFINEMENTS = ("none", "solver_in_the_loop")
_WINDOW = ("motion", "trial", "frame")
_SMALLEST_UNIT = 1e-20  # mm^2


@dataclass(frozen=True)
class RefinementBatch:
    """Trials that begin alike, at a simulator's steps.

    Attributes:
        q: (R, K + 1, N, 3) positions that windows start from [m].
        v: (R, K + 1, N, 3) velocities there [m/s].
        target: (R, K + 1, M, 3) what should be observed [m], NaN where nothing was seen.
        trials: what acted on the bodies.
        told: what the model is told of that, see `LearnedPredictor`; None for nothing.
        base: in whose frame the model predicts; None where that stands still.
    """

    q: torch.Tensor
    v: torch.Tensor
    target: torch.Tensor
    trials: Trials
    told: torch.Tensor | None = None
    base: BaseFrame | None = None


@dataclass(frozen=True)
class Windows:
    """Pieces of motions.

    Attributes:
        motion: (W,) number of the motion.
        trial: (W,) number of the trial in it.
        frame: (W,) frame that the window starts from.
    """

    motion: torch.Tensor
    trial: torch.Tensor
    frame: torch.Tensor

    def __len__(self) -> int:
        """W."""
        return len(self.frame)

    def pick(self, which: torch.Tensor) -> "Windows":
        """Some of them, by number."""
        return Windows(self.motion[which], self.trial[which], self.frame[which])


class WindowLoss:
    """Distances from the target over windows of k steps.

    Args:
        model: residual force, differentiable in the weights of its network.
        make_simulator: a new simulator whose solver settings count failures. Every loss is computed with one: the
            factor that a solver keeps would make it depend on what was computed before.
        window: k.
        batch_size: windows that are simulated at once.
        observe: what sensors show of the body; all vertices if left out.
        parameters: (1,) physical parameters that were identified.
        frames: with which forces turn; None if they do not.
        range_: of the model's inputs, in which they are held; None for no guard.
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
        self._memories: dict[int, tuple[RefinementBatch, dict[str, torch.Tensor]]] = {}  # by the motion's identity
        simulator = make_simulator()
        self._first_frame = 1 if simulator.integrator == "bdf2" else 0  # BDF2 looks back.
        rest = simulator.rest_positions
        self.failure = (1e3 * FURTHEST * float((rest.amax(0) - rest.amin(0)).max())) ** 2  # of a window [mm^2]

    def side_by_side(self, motions: Sequence[RefinementBatch]) -> Windows:
        """Windows that cover the trials, but for what is left over at their ends or not seen at all."""
        found = []
        for number, motion in enumerate(motions):
            frames = motion.q.shape[1]
            start = torch.arange(self._first_frame, frames - self._window, self._window)
            trial, frame = (t.flatten() for t in torch.meshgrid(torch.arange(len(motion.q)), start, indexing="ij"))
            span = frame[:, None] + torch.arange(1, self._window + 1)
            seen = torch.isfinite(motion.target.cpu()[trial[:, None], span]).all(-1).flatten(1).any(1)
            known = torch.isfinite(motion.q.cpu()[trial, frame]).flatten(1).all(1)
            found.append([x[seen & known] for x in (torch.full_like(trial, number), trial, frame)])
        return Windows(*(torch.cat(each) for each in zip(*found, strict=True)))

    @torch.no_grad()
    def measure(self, windows: Windows, motions: Sequence[RefinementBatch]) -> tuple[float, torch.Tensor]:
        """Mean squared distance [mm^2] of the windows that can be simulated, and (W,) bool: which of them cannot."""
        simulator = self._make_simulator()
        lost = torch.zeros(len(windows), dtype=torch.bool)
        squares: list[torch.Tensor] = []
        for part in self._parts(windows):
            measured, failed = self._distances(simulator, windows.pick(part), motions)
            lost[part], squares = failed, [*squares, measured]
        return float(torch.cat(squares).mean()), lost

    def backward(self, windows: Windows, motions: Sequence[RefinementBatch], unit: float) -> float:
        """Mean squared distance in a unit [mm^2]; adds its gradient to those of the weights.

        A window that cannot be simulated counts as `FURTHEST` body lengths, without a gradient.
        """
        simulator = self._make_simulator()
        total, each = 0.0, 1.0 / (unit * len(windows))
        for part in self._parts(windows):
            squares, lost = self._distances(simulator, windows.pick(part), motions)
            failed = int(lost.sum())
            if len(squares):
                try:
                    torch.autograd.backward(each * squares.sum())
                except ConvergenceError:  # A state without a gradient is no place for the optimiser to be.
                    squares, failed = squares[:0], len(part)
            total += each * (float(squares.detach().sum()) + failed * self.failure)
        return total

    def _remembered(self, simulator: Simulator, motion: RefinementBatch) -> dict[str, torch.Tensor]:
        """Returns the memory of the energies where the windows of a motion start, by name, each (R, W, ...).

        It goes through every state of the motion from the first known one on, in which the body has been at rest for
        long; while none is known, the body stands still. Empty where nothing is remembered.
        """
        if id(motion) not in self._memories:
            constants, *_ = Replay(simulator, self._observe, motion.trials).setting(self._parameters)
            memories, state = list[Mapping[str, torch.Tensor]](), simulator.rest_state(len(motion.q))
            began = torch.zeros(state.batch, dtype=torch.bool, device=state.q.device)
            for frame in range(motion.q.shape[1]):
                q = motion.q[:, frame]
                known = torch.isfinite(q).flatten(1).all(1)
                before = torch.where((known & ~began)[:, None, None], q, state.q)  # at rest where it is first known
                q, began = torch.where(known[:, None, None], q, before), began | known
                with torch.no_grad():
                    state = simulator.remember(replace(state, q=before), q, constants)
                if not state.memory:
                    break
                if frame >= self._first_frame and (frame - self._first_frame) % self._window == 0:
                    memories.append(state.memory)
            names = memories[0] if memories else ()
            self._memories[id(motion)] = (motion, {n: torch.stack([m[n] for m in memories], 1) for n in names})
        return self._memories[id(motion)][1]

    def _parts(self, windows: Windows) -> list[torch.Tensor]:
        """Numbers of windows that are simulated at once: of one motion each."""
        found = []
        for motion in windows.motion.unique().tolist():
            found += (windows.motion == motion).nonzero()[:, 0].split(self._batch_size)
        return found

    def _distances(
        self, simulator: Simulator, windows: Windows, motions: Sequence[RefinementBatch]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(U,) mean squared distances [mm^2] of the windows that can be simulated, and (W,) bool: which cannot.

        Where some fail, the others are simulated again beside copies of each other, so that neither their states nor
        their gradients meet a number that is not finite.
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
        """(W,) mean squared distances [mm^2], and (W,) bool: which windows failed."""
        run, frame = windows.trial, windows.frame
        previous = None
        if self._first_frame:
            previous = (motion.q[run, frame - 1], motion.v[run, frame - 1])
        start = (frame - self._first_frame) // self._window
        memory = {name: values[run, start] for name, values in self._remembered(simulator, motion).items()}
        state = State(motion.q[run, frame], motion.v[run, frame], previous, memory)
        constants, inputs, _ = Replay(simulator, self._observe, motion.trials.select(run.tolist())).setting(
            self._parameters
        )
        told = None if motion.told is None else _during(motion.told.index_select(-2, run), frame, self._window)
        base = None if motion.base is None else motion.base.during(run, frame, self._window)
        predict = LearnedPredictor(self._model, told, self._range, self._frames, base)
        acting = inputs.window(frame, self._window)
        rollout = Rollout(simulator, predict, acting, constants)
        squares = state.q.new_zeros(len(windows))
        for step in range(1, self._window + 1):
            state = rollout.differentiable_step(state)
            target = motion.target[run, frame + step]
            seen = torch.isfinite(target).all(-1)
            distance = torch.where(seen[..., None], 1e3 * (self._observe(state.q) - target), 0.0)
            squares = squares + distance.square().sum((1, 2)) / seen.sum(1).clamp_min(1)
        return squares / self._window, rollout.lost(state)


def _during(series: torch.Tensor, first: torch.Tensor, steps: int) -> torch.Tensor:
    """(k, W, A) what (K, W, A) series are during k steps, each from its own first one; (W, A) stays as it is."""
    if series.ndim == 2:
        return series
    at = (first + torch.arange(steps)[:, None]).clamp_max(len(series) - 1).to(series.device)
    return series[at, torch.arange(series.shape[1], device=series.device)]


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
                f"smaller refinement.window than {self.settings.window}, or refinement=none."
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
        tensors |= {f"windows.{name}": getattr(self._windows, name) for name in _WINDOW}
        return tensors, metadata

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._windows = Windows(*(tensors[f"windows.{name}"] for name in _WINDOW))
