r"""Force sensors: load cells and force-torque sensors, as maps from reactions to readings.

A sensor reads the force F and the moment T, about its origin o, of the forces f_i with which it
holds a body at places x_i, in its own axes, the columns of R:

    F = -R^T sum f_i,    T = -R^T sum (x_i - o) x f_i

The minus sign is for readings of the force on the sensor; those of the force on the body have none.
Under a base that moves, origin and axes move with it; with an obstacle that moves, they do not.

A reading has noise, a zero that is unknown in each trial, and a drift from there: its errors have
the covariance s^2 I + z^2 1 1^T + d^2 t t^T over the frames of a trial, with the standard
deviations s, z and d and the times t. With Q L Q^T the last two terms and Q^T Q = I, errors times
its inverse root are those without zero and drift,

    (e - Q (1 - s (s^2 + L)^(-1/2)) Q^T e) / s

so that zero and drift need no unknowns of their own (generalised least squares; Aitken 1935).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..core.stepping.rotations import closest_rotation, rotations
from ..core.stepping.state import Reaction
from ..io.arrays import Brief
from ..io.errors import InputError

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")  # forces [N], then moments [N m]
UNITS = dict(zip(AXES, 3 * ["N"] + 3 * ["N m"], strict=True))
_PLANE = 2  # dimensions that places span which determine a rotation
_FLAT = 1e-6  # of the largest extent, up to which places span no dimension


@dataclass(frozen=True)
class ForceSensor(Brief):
    """A load cell or force-torque sensor that holds a body, or the obstacle that it pushes.

    Attributes:
        at: region of the mesh or body of a scene of which it holds the fixed vertices, numbers of
            fixed vertices, or an obstacle; None: all fixed vertices.
        axes: that it measures, of `AXES`.
        noise: standard deviation of a force [N].
        moment_noise: standard deviation of a moment [N m]; needed where one is measured.
        origin: point about which moments are measured, on the body at rest [m].
        rotation: rotation vector of its axes in the frame of the body at rest [rad].
        on_body: whether readings are forces on the body, such as the tension of a testing machine,
            not on the sensor.
        zero: standard deviation of the unknown zero in each trial, of forces and moments in units
            of their noise.
        drift: standard deviation of the change of the zero per second, likewise [1/s].

    Raises:
        InputError: no or unknown axes, a noise that is not positive, or a negative zero or drift.
    """

    at: str | Sequence[int] | None = None
    axes: tuple[str, ...] = AXES
    noise: float = 0.01
    moment_noise: float | None = None
    origin: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[float] = (0.0, 0.0, 0.0)
    on_body: bool = False
    zero: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        """Checks axes, noise, zero and drift."""
        if isinstance(self.axes, str):
            raise InputError(
                f"axes of a force sensor is {self.axes!r}: give a tuple, such as ({self.axes!r},)."
            )
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown or not self.axes:
            named = f"has the axis {unknown[0]!r}" if self.axes else "has no axes"
            raise InputError(f"a force sensor {named}: name some of {', '.join(AXES)}.")
        for name in ("noise", "moment_noise", "zero", "drift"):
            value, is_noise = getattr(self, name), "noise" in name
            if name == "moment_noise" and value is None:
                continue
            known = isinstance(value, float | int) and math.isfinite(value)
            if not known or value < 0.0 or (is_noise and value == 0.0):
                wanted = "positive" if is_noise else "zero or more"
                raise InputError(f"{name} of a force sensor is {value!r}: it must be {wanted}.")
        if self.moment_noise is None and any(UNITS[axis] == "N m" for axis in self.axes):
            raise InputError(
                "a force sensor measures moments, but has no moment_noise: give it, in N m."
            )

    @property
    def deviations(self) -> list[float]:
        """Standard deviations of the noise of all `AXES` [N, N m].

        Infinite for those that it does not measure.
        """
        noise = dict(zip(AXES, 3 * [self.noise] + 3 * [self.moment_noise or math.inf], strict=True))
        return [noise[axis] if axis in self.axes else math.inf for axis in AXES]

    @property
    def unit(self) -> str:
        """Unit of `distances`: N, or N m where it measures moments alone."""
        return UNITS[self.axes[0]] if len({UNITS[axis] for axis in self.axes}) == 1 else "N"

    def distances(
        self, predicted: torch.Tensor, measured: torch.Tensor, times: torch.Tensor
    ) -> torch.Tensor:
        """Returns sizes (R, T) of the error of the force,
        or of the moment where that alone is measured [`unit`].

        Of an error, the zero and the drift that explain it best are taken away. It is NaN where
        nothing was measured or predicted, and infinite where the prediction is, as the simulation
        diverged. The arguments are as of `errors`, with predictions (R, T, 6).
        """
        errors = self.errors(predicted[None], measured, times)[0]
        chosen = [
            n for n, axis in enumerate(AXES) if axis in self.axes and UNITS[axis] == self.unit
        ]
        away = (errors[..., chosen] * errors.new_tensor([self.deviations[n] for n in chosen])).norm(
            dim=-1
        )
        known, read = (values[..., chosen].isfinite().all(-1) for values in (predicted, measured))
        lost = predicted[..., chosen].isinf().any(-1)
        return torch.where(read & lost, torch.inf, torch.where(read & known, away, torch.nan))

    def __call__(self, reaction: Reaction, rest: torch.Tensor | None = None) -> torch.Tensor:
        """Returns readings (B, 6) of all `AXES`, differentiable [N, N m].

        Args:
            reaction: at the vertices that it holds, or of the obstacle.
            rest: (D, 3) places of these vertices at rest [m], with which it moves, without a turn
                where they are on one line; None: it stands still.
        """
        like = reaction.places
        rest = None if rest is None else rest.to(like)
        turn = rotations(like.new_tensor([[*self.rotation]]))
        origin = like.new_tensor([[*self.origin]])
        if rest is not None and _spanned(rest) >= _PLANE:
            middle, at_rest = like.mean(-2), rest.mean(0)
            moved = closest_rotation((like - middle[:, None]).mT @ (rest - at_rest))
            turn, origin = moved @ turn, middle + ((origin - at_rest) @ moved.mT)[:, 0]
        elif rest is not None:
            origin = origin + (like - rest).mean(-2)
        # Rows are R^T F and R^T T.
        on_body = torch.stack([reaction.force, reaction.moment(origin)], -2) @ turn
        return (on_body if self.on_body else -on_body).flatten(-2)

    def errors(
        self, predicted: torch.Tensor, measured: torch.Tensor, times: torch.Tensor
    ) -> torch.Tensor:
        """Returns errors (E, R, T, 6) in standard deviations, without zero and drift.

        Zero where not measured.

        Args:
            predicted: (E, R, T, 6) readings [N, N m], NaN where the reaction is not known.
            measured: (R, T, 6) readings, NaN where there is none.
            times: (R, T) of the frames [s].
        """
        scale = measured.new_tensor(self.deviations)
        seen = torch.isfinite(measured) & torch.isfinite(scale) & torch.isfinite(predicted).all(0)
        errors = torch.where(seen, (predicted.nan_to_num() - measured.nan_to_num()) / scale, 0.0)
        if not (self.zero or self.drift):
            return errors
        known = seen.to(errors)[..., None]  # (R, T, 6, 1)
        unknown = torch.stack([torch.full_like(times, self.zero), self.drift * times], -1)
        columns = (known * unknown[:, :, None]).transpose(1, 2)  # (R, 6, T, 2)
        basis, sizes = torch.linalg.svd(columns, full_matrices=False)[:2]
        kept = (1.0 - (1.0 + sizes.square()).rsqrt())[..., None]
        flat = errors.transpose(2, 3)[..., None]  # (E, R, 6, T, 1)
        return (flat - basis @ (kept * (basis.mT @ flat)))[..., 0].transpose(2, 3)


def _spanned(places: torch.Tensor) -> int:
    """Returns how many dimensions places (D, 3) span."""
    sizes = torch.linalg.svdvals((places - places.mean(0)).double())
    return int((sizes > _FLAT * sizes.amax()).sum())
