"""Trials: what acted on a body, how it began, and what was observed of it."""

from dataclasses import dataclass, field, replace

import torch

from ..io.errors import InputError
from ..stepping.inputs import Inputs


@dataclass(frozen=True)
class Trials:
    """R trials of one body, observed at the same points, in the frame of the body.

    What is observed is a map of the positions, such as markers or all vertices. A static pose is a trial of one frame.
    """

    names: tuple[str, ...]
    times: torch.Tensor  # (R, T) of the frames since time zero; trials that end early repeat their last time [s]
    observed: torch.Tensor  # (R, T, M, D) [unit of the observation], NaN where nothing was seen and past a trial's end
    held: torch.Tensor  # (R, M, D) those points before time zero [unit]
    # what acts on the R environments, during each step of the simulation where it changes
    inputs: Inputs = field(default_factory=Inputs)
    # what acts on them before time zero, where they begin at rest; weights act before as after
    resting: Inputs = field(default_factory=Inputs)

    def __post_init__(self) -> None:
        """Checks that the shapes agree.

        Raises:
            InputError: they do not, or nothing was seen of a trial.
        """
        r, t, m, d = self.observed.shape
        batches = [v.shape[i] for each in (self.inputs, self.resting) for v, i in each.axes().values()]
        if self.times.shape != (r, t) or self.held.shape != (r, m, d) or set(batches) - {r}:
            raise InputError("the times, the held points and the inputs do not belong to the same trials.")
        for name, seen in zip(self.names, self.seen, strict=True):
            if not bool(seen.any()):
                raise InputError(f"no marker of the trial {name!r} was seen: leave it out.")

    @property
    def seen(self) -> torch.Tensor:
        """(R, T, M) bool."""
        return torch.isfinite(self.observed).all(-1)

    @property
    def amplitude(self) -> torch.Tensor:
        """(R,) root mean square distance of the observed points from where they were held [m]."""
        square = (self.observed - self.held[:, None]).square().sum(-1)
        return square.nanmean((1, 2)).sqrt()

    @property
    def loss_weight(self) -> torch.Tensor:
        """(R,) with which sums of squares become the mean over trials of each one's mean square over its amplitude."""
        return 1.0 / (self.seen.sum((1, 2)) * self.amplitude**2 * len(self.names))

    def select(self, indices: list[int]) -> "Trials":
        """Some of the trials."""
        pick = torch.as_tensor(indices, device=self.times.device)
        fields = (self.times[pick], self.observed[pick], self.held[pick])
        names = tuple(self.names[i] for i in indices)
        return Trials(names, *fields, self.inputs.select(pick), self.resting.select(pick))

    def first(self, seconds: float) -> "Trials":
        """The frames of the first seconds; those past them count as not seen."""
        inside = self.times <= seconds + 1e-9
        last = int(inside.any(0).sum())
        observed = torch.where(inside[..., None, None], self.observed, torch.nan)
        return replace(self, times=self.times[:, :last], observed=observed[:, :last])

    def joined(self, other: "Trials") -> "Trials":
        """These trials and others after them, with as many frames and the same inputs."""
        times, observed, held = (
            torch.cat([getattr(t, n) for t in (self, other)]) for n in ("times", "observed", "held")
        )
        inputs, resting = self.inputs.joined(other.inputs), self.resting.joined(other.resting)
        return Trials(self.names + other.names, times, observed, held, inputs, resting)

    def to(self, like: torch.Tensor) -> "Trials":
        """The same on the device and in the type of a tensor."""
        fields = (self.times.to(like), self.observed.to(like), self.held.to(like))
        return Trials(self.names, *fields, self.inputs.to(like), self.resting.to(like))
