"""Batches of trials, as a replay simulates them: the inputs of a body at its steps,
and the observation of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch

from ..core.fem.bodies import Body
from ..core.mesh.place import Place
from ..core.stepping.inputs import Inputs
from ..data.force_sensors import ForceSensor
from ..data.trials import STATIC, Trials
from ..io.arrays import Brief
from ..io.errors import InputError


@dataclass(frozen=True)
class TrialBatch(Brief):
    """R trials of one body with the same observed points, in the frame of the body.

    The observation is a map of the positions, such as markers or all vertices. A static pose is a
    trial of one frame.
    """

    names: tuple[str, ...]
    times: torch.Tensor  # (R, T) of the frames [s]; trials that end early repeat their last time
    observed: torch.Tensor  # (R, T, M, D) [unit of the observation], NaN: not seen, or ended
    held: torch.Tensor  # (R, M, D) observed points before time zero [unit]
    # of the R environments; inputs that change over time have a value for each step of the
    # simulation
    inputs: Inputs = field(default_factory=Inputs)
    # before time zero, for trials that begin at rest; weights are the same as in `inputs`
    resting: Inputs = field(default_factory=Inputs)
    session: str = ""  # in which all of them were recorded, if there are several
    # (R, T, S, 6) readings of S force sensors [N, N m], NaN where there is none; None for no
    # sensors
    loads: torch.Tensor = field(default=None)  # type: ignore[assignment]
    sensors: tuple[ForceSensor, ...] = ()
    noise: float = (
        1.0  # standard deviation of a coordinate of a point, by which readings are weighted [m]
    )

    @classmethod
    def of(
        cls,
        trials: Trials,
        names: Sequence[str],
        body: Body,
        payload_at: Place | None,
        time_step: float,
        **more: Any,
    ) -> Self:
        """Returns trials that begin in the same way and are of one session, in float64 on the CPU.

        See `Trials.acting`.

        Raises:
            InputError: see `data.trials.payload_inputs`.
        """
        rows = trials.rows(names)
        frames = 1 if trials.begins[rows[0]] == STATIC else None
        times, observed = (
            torch.from_numpy(x[rows][:, :frames]) for x in (trials.times, trials.observed)
        )
        inputs, resting = trials.acting(names, body, payload_at, time_step)
        held = torch.from_numpy(trials.held[rows])
        session = trials.session(names[0])
        read = [torch.from_numpy(readings[rows][:, :frames]) for readings in trials.loads.values()]
        loads = torch.stack(read, 2) if read else None
        known = (tuple(names), times, observed, held, inputs, resting, session, loads)
        return cls(*known, **more)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        """Checks that the shapes agree.

        Raises:
            InputError: they do not agree, or no point of a trial was seen, and no force read.
        """
        r, t, m, d = self.observed.shape
        if self.loads is None:
            object.__setattr__(self, "loads", self.observed.new_zeros(r, t, 0, 6))
        batches = [
            v.shape[i] for inputs in (self.inputs, self.resting) for v, i in inputs.axes().values()
        ]
        if self.times.shape != (r, t) or self.held.shape != (r, m, d) or set(batches) - {r}:
            raise InputError(
                "the times, the held points and the inputs do not belong to the same trials."
            )
        if self.loads.shape != (r, t, len(self.sensors), 6):
            raise InputError("the readings and the force sensors do not belong to the same trials.")
        for name, seen, read in zip(self.names, self.seen, self.readings.tolist(), strict=True):
            if not (read or bool(seen.any())):
                what = "marker" if m else "force"
                raise InputError(
                    f"no {what} of the trial {name!r} was {'seen' if m else 'read'}: leave it out."
                )

    @property
    def seen(self) -> torch.Tensor:
        """Whether a point was seen, (R, T, M) bool."""
        return torch.isfinite(self.observed).all(-1)

    def load_errors(
        self, simulated: torch.Tensor, at: tuple[torch.Tensor, torch.Tensor] | None = None
    ) -> torch.Tensor:
        """(E, R, T, S, 6) errors of readings without zero and drift,
        in lengths that are as likely for a point [m].

        Args:
            simulated: (E, R, T, S, 6) readings [N, N m].
            at: measured ones (R, T, S, 6) and their times (R, T) [s] in place of those of the
                trials.
        """
        measured, times = at or (self.loads, self.times)
        pairs = zip(self.sensors, simulated.unbind(3), measured.unbind(2), strict=True)
        errors = [sensor.errors(reading, one, times) for sensor, reading, one in pairs]
        return self.noise * torch.stack(errors, 3) if errors else simulated

    @property
    def count(self) -> torch.Tensor:
        """(R,) number of points that were seen, three readings counting as one."""
        return self.seen.sum((1, 2)) + self.readings / 3.0

    @property
    def readings(self) -> torch.Tensor:
        """(R,) number of readings of the axes that sensors measure."""
        measured = self.loads.new_tensor([sensor.deviations for sensor in self.sensors]).isfinite()
        return (
            (self.loads.isfinite() & measured).sum((1, 2, 3))
            if self.sensors
            else self.times.new_zeros(len(self.times))
        )

    @property
    def size(self) -> torch.Tensor:
        """(R,) as `amplitude`, of points and readings together [m]."""
        if not self.sensors:
            return self.amplitude
        squares = self.load_errors(torch.zeros_like(self.loads)[None])[0].square().sum((1, 2, 3))
        moved = (self.observed - self.held[:, None]).square().nansum((1, 2, 3))
        return ((squares + moved) / self.count).sqrt()

    @property
    def amplitude(self) -> torch.Tensor:
        """(R,) root mean square distance of points from the held ones [m]."""
        square = (self.observed - self.held[:, None]).square().sum(-1)
        return square.nanmean((1, 2)).sqrt()

    @property
    def loss_weight(self) -> torch.Tensor:
        """Weights (R,) of sums of squares that give the mean
        over trials of the mean square over squared amplitude.
        """
        return 1.0 / (self.count * self.size**2 * len(self.names))

    def select(self, indices: list[int]) -> "TrialBatch":
        """Returns the trials with these indices."""
        pick = torch.as_tensor(indices, device=self.times.device)
        fields = (self.times[pick], self.observed[pick], self.held[pick])
        names = tuple(self.names[i] for i in indices)
        inputs = (self.inputs.select(pick), self.resting.select(pick))
        return TrialBatch(
            names, *fields, *inputs, self.session, self.loads[pick], self.sensors, self.noise
        )

    def first(self, seconds: float) -> "TrialBatch":
        """Returns the trials with the frames after a time [s] left out or marked as not seen."""
        inside = self.times <= seconds + 1e-9
        last = int(inside.any(0).sum())
        observed, loads = (
            torch.where(inside[..., None, None], x, torch.nan)[:, :last]
            for x in (self.observed, self.loads)
        )
        return replace(self, times=self.times[:, :last], observed=observed, loads=loads)

    def to(self, like: torch.Tensor) -> "TrialBatch":
        """Returns the trials on the device and in the precision of a tensor."""
        fields = (self.times.to(like), self.observed.to(like), self.held.to(like))
        inputs = (self.inputs.to(like), self.resting.to(like))
        return TrialBatch(
            self.names,
            *fields,
            *inputs,
            self.session,
            self.loads.to(like),
            self.sensors,
            self.noise,
        )
