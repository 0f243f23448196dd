"""Motions that pressure drives: what was observed of them, and their simulation.

A motion begins at rest, before the pressure comes, in the equilibrium of gravity, so that its beginning depends on the
parameters as much as all that follows. Everything stands at the steps of the simulation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from typing_extensions import override

from ..data.actuation import lagged
from ..dynamics.integrator import State
from ..dynamics.simulator import MaterialTensors
from ..io.errors import InputError
from .replay import PARAMETERS, Motions, Release, Replay, StepForce

DRIVEN_PARAMETERS = (*PARAMETERS, "fibre_stiffness", "pressure_rise")


@dataclass(frozen=True)
class DrivenMotions(Motions):
    """Motions under pressure, at the steps of a simulation.

    Attributes:
        pressure: (R, K, C) gauge pressure in each chamber during each step [Pa]; there are K + 1 frames.
    """

    pressure: torch.Tensor

    @override
    def __post_init__(self) -> None:
        super().__post_init__()
        r, frames = self.times.shape
        if self.pressure.shape[:2] != (r, frames - 1):
            raise InputError(
                f"{r} motions of {frames} frames have pressures of the shape {tuple(self.pressure.shape)}: give one "
                "for every step between two frames."
            )

    @override
    def select(self, indices: list[int]) -> "DrivenMotions":
        chosen = super().select(indices)
        pick = torch.as_tensor(indices, device=self.times.device)
        fields = (chosen.names, chosen.times, chosen.markers, chosen.held, chosen.attached_mass)
        return DrivenMotions(*fields, self.pressure[pick])

    @override
    def first(self, seconds: float) -> "DrivenMotions":
        last = int((self.times <= seconds + 1e-9).any(0).sum())
        return replace(
            self, times=self.times[:, :last], markers=self.markers[:, :last], pressure=self.pressure[:, : last - 1]
        )


def at_rest(motions: DrivenMotions, positions: torch.Tensor) -> Release:
    """A beginning at rest: a first guess of the equilibrium, from positions (N, 3) [m]."""
    q = positions.expand(len(motions.names), -1, -1)
    return Release(State(q, torch.zeros_like(q)), torch.zeros_like(motions.times[:, 0]))


class DrivenReplay(Replay):
    """Simulates motions that pressure drives, from rest.

    Beside the parameters of `Replay` it knows ``pressure_rise``, the time constant of the valves [s].
    """

    motions: DrivenMotions
    known: ClassVar[tuple[str, ...]] = DRIVEN_PARAMETERS

    def pressures(self, rise: torch.Tensor | None = None) -> torch.Tensor:
        """(E R, K, C) pressure in the chambers during each step, for E rise times [Pa]."""
        commanded = self.motions.pressure
        if rise is None:
            return commanded
        count = len(self.motions.names)
        return lagged(commanded.repeat(len(rise), 1, 1), rise.repeat_interleave(count), self.simulator.time_step)

    def start(self, release: Release, batch: int, tensors: MaterialTensors) -> State:
        """The state of rest before the pressure comes, from a first guess of it."""
        guess = release.state.q.repeat(batch // len(release.state.q), 1, 1)
        return self.simulator.static_equilibrium(material=tensors, start=guess)

    @override
    def __call__(
        self,
        release: Release,
        parameters: Mapping[str, torch.Tensor] | None = None,
        force: StepForce | None = None,
    ) -> torch.Tensor:
        parameters = {} if parameters is None else parameters
        each = len(next(iter(parameters.values()))) if parameters else 1
        tensors = self.tensors({k: v for k, v in parameters.items() if k != "pressure_rise"})
        pressure = self.pressures(parameters.get("pressure_rise"))
        pressure = pressure.repeat(each * len(self.motions.names) // len(pressure), 1, 1)
        state = self.start(release, len(pressure), tensors)
        series = [self.markers(state.q)]
        for p in pressure.unbind(1):
            added = None if force is None else force(state.q, state.v)
            state, _ = self.simulator.step(state, added, material=tensors, pressure=p)
            series.append(self.markers(state.q))
        return torch.stack(series, 1).unflatten(0, (each, -1))
