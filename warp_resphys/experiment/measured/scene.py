"""What the stages of an experiment on recordings share: the body, its markers, its motions and its simulators."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ...data.markers import Markers
from ...dynamics.simulator import Simulator
from ...io.files import read_json
from ...learning.release import ReleaseSettings, estimate_release
from ...learning.replay import Motions, Release, Replay
from ..binding import bound_markers
from ..build import build_body, build_simulator
from .files import IDENTIFICATION, MARKERS, read_motions

# The simulator that a model corrects or is.
SIMULATORS = {
    "published": "published",
    "simulation": "simulation",
    "sysid_elastic": "simulation",
    "sysid": "identified",
    "resphys_uncorrected": "simulation",
    "resphys": "identified",
    "simfree": "identified",
}


@dataclass(frozen=True)
class Scene:
    """The imported motions and the simulators of an experiment.

    Attributes:
        config: the settings of the stage.
        shared: the folder of markers.h5.
    """

    config: Mapping[str, Any]
    shared: Path

    @cached_property
    def _imported(self) -> tuple[Motions, NDArray[np.float64], tuple[str, ...], NDArray[np.float64]]:
        return read_motions(self.shared / MARKERS, build_body(self.config), self.config["data"]["hung_on"])

    @cached_property
    def motions(self) -> Motions:
        """All trials, on the simulators' device."""
        motions, *_ = self._imported
        like = self.simulator("simulation").rest_positions
        fields = (motions.times, motions.markers, motions.held, motions.attached_mass)
        return Motions(motions.names, *(t.to(like) for t in fields))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the followed markers."""
        return self._imported[2]

    @cached_property
    def markers(self) -> Markers:
        """The followed markers on the body."""
        _, bound, labels, _ = self._imported
        found = bound_markers(self.config["markers"], build_body(self.config).mesh, bound, labels)
        return found.to(self.simulator("simulation").rest_positions)

    def simulator(self, kind: str, on_failure: str = "raise") -> Simulator:
        """A simulator under the gravity of the recordings.

        Args:
            kind: ``simulation`` (uncorrected), ``published``, or ``identified``, which steps with another integrator,
                and may take shorter steps.
            on_failure: whether a step that fails raises, or is counted, whatever is configured.
        """
        config = {**self.config, "gravity": self._imported[3].tolist()}
        if kind == "published":
            config |= self.config["published"]
        elif kind == "identified":
            identify = self.config["identify"]
            config |= {"integrator": identify["integrator"], "time_step": config["time_step"] / identify["substeps"]}
        return build_simulator(config, "simulation", on_failure=on_failure)

    def pick(self, names: tuple[str, ...]) -> Motions:
        """Some of the trials."""
        motions = self.motions
        return motions.select([motions.names.index(name) for name in names])

    def release(self, simulator: Simulator, motions: Motions) -> Release:
        """How motions begin, as a simulator would have it."""
        return estimate_release(simulator, self.markers, motions, ReleaseSettings(**self.config["release"]))

    def replay(self, kind: str, names: tuple[str, ...]) -> tuple[Replay, Release]:
        """A simulator of some of the trials, and how they begin."""
        simulator, motions = self.simulator(kind), self.pick(names)
        return Replay(simulator, self.markers, motions), self.release(simulator, motions)


def loads(motions: Motions) -> torch.Tensor:
    """(R, 1) weight that hangs on the body in each motion [kg]."""
    return motions.attached_mass.sum(1, keepdim=True)


def parameters_of(folder: Path, model: str, like: torch.Tensor) -> dict[str, torch.Tensor]:
    """(1,) identified parameters of a model's simulator; none for one that is not identified."""
    if model not in ("sysid_elastic", "sysid", "resphys"):
        return {}
    key = "sysid_elastic" if model == "sysid_elastic" else "sysid"
    values = read_json(folder / IDENTIFICATION)[key]["parameters"]
    return {name: like.new_tensor([value]) for name, value in values.items()}


def at_steps(motions: Motions, step: float, delay: torch.Tensor | None = None) -> NDArray[np.float64]:
    """(R, K + 1, M, 3) markers at the steps of a simulation [m], NaN after a motion's end and in long occlusions.

    Cubic splines through the frames in which a marker was seen, with where it was held at time zero. Steps further than
    a frame and a half from the next sight of a marker count as not seen.

    Args:
        motions: observed.
        step: h [s].
        delay: (R,) by which the bodies were let go later than the time zero of the frames [s]; none if left out.
    """
    since = motions.times if delay is None else (motions.times - delay[:, None]).clamp_min(0.0)
    times, markers, held = (t.cpu().numpy() for t in (since, motions.markers, motions.held))
    steps = step * np.arange(int(times.max() / step + 1e-6) + 1)
    found = np.full((len(times), len(steps), *markers.shape[2:]), np.nan)
    for r, m in np.ndindex(len(times), markers.shape[2]):
        seen = np.isfinite(markers[r, :, m]).all(1)
        t, y = times[r, seen], markers[r, seen, m]
        t, first = np.unique(t, return_index=True)
        y = y[first]
        if np.isfinite(held[r, m]).all() and (not len(t) or t[0] > 1e-9):
            t, y = np.concatenate([[0.0], t]), np.concatenate([held[r, m][None], y])
        if len(t) < 4:
            continue
        nearest = np.abs(steps[:, None] - t).min(1)
        near = (nearest <= 1.5 * np.median(np.diff(t))) & (steps <= t[-1] + 1e-9)
        found[r, near, m] = CubicSpline(t, y)(steps[near])
    return found
