"""Motions that were observed through markers, and the simulation of the same motions.

A replay simulates every motion from its own release, with its own attached weight, for one or several sets of physical
parameters at once, and reads the markers off at the times of the frames. All of it is differentiable.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch

from ..dynamics.integrator import State
from ..dynamics.simulator import MaterialTensors, Simulator
from ..energies.material import Material
from ..io.errors import InputError

MATERIAL_PARAMETERS = ("youngs_modulus", "poissons_ratio", "density", "mass_damping", "stiffness_damping")
PARAMETERS = (*MATERIAL_PARAMETERS, "attached_mass_factor", "gravity_tilt_1", "gravity_tilt_2")
Markers = Callable[[torch.Tensor], torch.Tensor]
StepForce = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Motions:
    """Motions of one body, observed through the same markers, in the frame of the body.

    Attributes:
        names: of the R motions.
        times: (R, T) of the frames since the release; motions that end early repeat their last time [s].
        markers: (R, T, M, 3) [m], NaN where a marker was not seen and past a motion's end.
        held: (R, M, 3) where the markers were before the release [m].
        attached_mass: (R, N) weights that hang on the vertices [kg].
        amplitude: (R,) root mean square distance of the markers from where they were held [m].
    """

    names: tuple[str, ...]
    times: torch.Tensor
    markers: torch.Tensor
    held: torch.Tensor
    attached_mass: torch.Tensor

    def __post_init__(self) -> None:
        """Checks that the shapes agree.

        Raises:
            InputError: they do not, or nothing was seen of a motion.
        """
        r, t, m, _ = self.markers.shape
        if self.times.shape != (r, t) or self.held.shape != (r, m, 3) or len(self.attached_mass) != r:
            raise InputError("the times, held markers and attached masses do not belong to the same motions.")
        for name, seen in zip(self.names, self.seen, strict=True):
            if not bool(seen.any()):
                raise InputError(f"no marker of the motion {name!r} was seen: leave it out.")

    @property
    def seen(self) -> torch.Tensor:
        """(R, T, M) bool."""
        return torch.isfinite(self.markers).all(-1)

    @property
    def amplitude(self) -> torch.Tensor:
        """(R,) root mean square distance of the markers from where they were held [m]."""
        square = (self.markers - self.held[:, None]).square().sum(-1)
        return square.nanmean((1, 2)).sqrt()

    @property
    def loss_weight(self) -> torch.Tensor:
        """(R,) with which sums of squares become the mean over motions of each one's mean square over its amplitude."""
        return 1.0 / (self.seen.sum((1, 2)) * self.amplitude**2 * len(self.names))

    def select(self, indices: list[int]) -> "Motions":
        """Some of the motions."""
        pick = torch.as_tensor(indices, device=self.times.device)
        names = tuple(self.names[i] for i in indices)
        return Motions(names, *(t[pick] for t in (self.times, self.markers, self.held, self.attached_mass)))

    def first(self, seconds: float) -> "Motions":
        """The frames of the first seconds; those past them count as not seen."""
        inside = self.times <= seconds + 1e-9
        last = int(inside.any(0).sum())
        markers = torch.where(inside[..., None, None], self.markers, torch.nan)
        return replace(self, times=self.times[:, :last], markers=markers[:, :last])


@dataclass(frozen=True)
class Release:
    """How motions begin.

    Attributes:
        state: (R, N, 3) positions [m] and velocities [m/s] at the release.
        delay: (R,) by which the body was let go later than the time zero of the frames [s].
        shift: (R, M, 3) from where the markers are bound to where they sit, on a body that only seemed to be held
            undeformed [m]; None for no shift.
    """

    state: State
    delay: torch.Tensor
    shift: torch.Tensor | None = None

    def select(self, indices: list[int]) -> "Release":
        """That of some of the motions."""
        pick = torch.as_tensor(indices, device=self.delay.device)
        shift = None if self.shift is None else self.shift[pick]
        return Release(State(self.state.q[pick], self.state.v[pick]), self.delay[pick], shift)

    def shifted(self, markers: torch.Tensor) -> torch.Tensor:
        """(..., R, T, M, 3) markers where they sit, of those where they are bound [m]."""
        return markers if self.shift is None else markers + self.shift[:, None]

    def bound(self, markers: torch.Tensor) -> torch.Tensor:
        """(R, T, M, 3) markers where they are bound, of those where they sit [m]."""
        return markers if self.shift is None else markers - self.shift[:, None]


class Replay:
    """Simulates observed motions.

    Args:
        simulator: of the body; its material gives the constants that no parameter sets.
        markers: (B, N, 3) positions of the vertices to (B, M, 3) markers [m].
        motions: what was observed.

    Attributes:
        known: the parameters that it takes.
    """

    known: ClassVar[tuple[str, ...]] = PARAMETERS

    def __init__(self, simulator: Simulator, markers: Markers, motions: Motions) -> None:
        self.simulator, self.markers, self.motions = simulator, markers, motions

    def tensors(self, parameters: Mapping[str, torch.Tensor] | None = None) -> MaterialTensors:
        """What E sets of parameters make of R motions, as (E R) environments, the motions running fastest.

        Args:
            parameters: (E,) values of any of `PARAMETERS`.

        Raises:
            InputError: an unknown parameter.
        """
        parameters = {} if parameters is None else parameters
        for name in parameters:
            if name not in self.known:
                raise InputError(f"there is no parameter {name!r} to identify: choose from {', '.join(self.known)}.")
        count, each = len(self.motions.names), len(next(iter(parameters.values()))) if parameters else 1
        spread = {name: value.repeat_interleave(count) for name, value in parameters.items()}
        constants: dict[str, Any] = {}
        for name in {*MATERIAL_PARAMETERS, "fibre_stiffness"} & set(spread):
            constants[name] = spread[name] if name.endswith("damping") else spread[name][:, None]
        material: Material = replace(self.simulator.material, **constants)
        attached = self.motions.attached_mass.repeat(each, 1)
        if "attached_mass_factor" in spread:
            attached = attached * spread["attached_mass_factor"][:, None]
        tilts = [spread.get(f"gravity_tilt_{i}") for i in (1, 2)]
        return self.simulator.prepare(material, attached, tilted_gravity(self.simulator, *tilts))

    def __call__(
        self,
        release: Release,
        parameters: Mapping[str, torch.Tensor] | None = None,
        force: StepForce | None = None,
    ) -> torch.Tensor:
        """(E, R, T, M, 3) markers at the times of the frames [m]; before its release a body holds still.

        Args:
            release: of the R motions.
            parameters: (E,) values of any of `PARAMETERS`; one set without any, if left out.
            force: (B, N, 3) added force [N] of positions and velocities.

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        each = len(next(iter(parameters.values()))) if parameters else 1
        times = (self.motions.times - release.delay[:, None]).clamp_min(0.0)
        # One step past the last frame, for the slope there.
        steps = max(math.ceil(float(times.max()) / self.simulator.time_step - 1e-6) + 1, 2)
        tensors = self.tensors(parameters)
        state = State(release.state.q.repeat(each, 1, 1), release.state.v.repeat(each, 1, 1))
        series = [self.markers(state.q)]
        for _ in range(steps):
            added = None if force is None else force(state.q, state.v)
            state, _ = self.simulator.step(state, added, material=tensors)
            series.append(self.markers(state.q))
        sampled = sample(torch.stack(series, 1), times.repeat(each, 1), self.simulator.time_step)
        return release.shifted(sampled.unflatten(0, (each, -1)))

    def errors(self, simulated: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M, 3) simulated less observed markers [m], zero where nothing was seen."""
        difference = simulated - self.motions.markers
        return torch.where(self.motions.seen[..., None], difference, 0.0)


def tilted_gravity(simulator: Simulator, first: torch.Tensor | None, second: torch.Tensor | None) -> torch.Tensor:
    """(1 or B, 3) the simulator's gravity, turned by components along the axes across it [m/s^2].

    Args:
        simulator: gives the gravity that is turned, and its strength.
        first: (B,) component of the direction along the first axis across gravity (the one of lowest number), or None.
        second: (B,) along the second.

    Raises:
        InputError: there is no gravity to turn.
    """
    gravity = simulator.tensor(simulator.gravity)
    strength = gravity.norm()
    if first is None and second is None:
        return gravity[None]
    if not float(strength) > 0.0:
        raise InputError("without gravity its tilt cannot be identified: leave gravity_tilt_1 and gravity_tilt_2 out.")
    down = gravity / strength
    axes = torch.eye(3, dtype=gravity.dtype, device=gravity.device)
    along = int(down.abs().argmax())
    direction = down[None]
    for axis, tilt in zip([i for i in range(3) if i != along], (first, second), strict=True):
        if tilt is not None:
            across = axes[axis] - (axes[axis] @ down) * down
            direction = direction + tilt[:, None] * across / across.norm()
    return strength * direction / direction.norm(dim=1, keepdim=True)


def sample(series: torch.Tensor, times: torch.Tensor, step: float) -> torch.Tensor:
    """(B, T, ...) values at given times, by cubic Hermite interpolation with central differences as slopes.

    Args:
        series: (B, K + 1, ...) values at the times 0, h, ..., K h, with K at least 2.
        times: (B, T) [s], from zero; beyond the end the last value stays.
        step: h [s].
    """
    slopes = torch.gradient(series, dim=1, edge_order=2)[0]
    last = series.shape[1] - 1
    position = (times / step).clamp(0.0, float(last))
    index = position.floor().long().clamp(max=last - 1)
    s = (position - index).reshape(*times.shape, *[1] * (series.ndim - 2))
    batch = torch.arange(len(series), device=series.device)[:, None]
    a, b, da, db = series[batch, index], series[batch, index + 1], slopes[batch, index], slopes[batch, index + 1]
    return (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * a
        + s * (1.0 - s) ** 2 * da
        + s**2 * (3.0 - 2.0 * s) * b
        + s**2 * (s - 1.0) * db
    )
