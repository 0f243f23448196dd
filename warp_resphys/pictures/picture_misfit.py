"""The misfit of simulated bodies to pictures of them,
as a function of physical parameters and of the camera's.

The loss is the mean square distance of the measured and the simulated outlines, both ways, and of
tracked points, in pixels, and of the points of clouds from the surface, in multiples of their
noise; every picture or scan has the same weight, and within it outlines, points and cloud. A
distance r counts as s sqrt(2 (sqrt(1 + (r / s)^2) - 1)), which is r where it is well below s = 4,
and less beyond, as a cable or a hand before the body moves its outline by any number of pixels
(Charbonnier et al. 1997).

A name with an owner (`learning.parameters.value_name`) is the value of one pose, of the poses of
one material, or of the pictures by one lens; a name without, that of all. Shapes follow the
physical parameters by differences of equilibria, and pixels and clouds follow shapes and cameras
exactly.

`tests/pictures/test_picture_misfit.py` and `test_clouds.py` compare the derivatives with
differences.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Final

import numpy as np
import torch
from scipy.spatial import cKDTree
from typing_extensions import override

from ..data.camera import CORRECTIONS, PlacedCamera
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError
from ..learning.identification.misfit import BoundedMisfit
from ..learning.identification.uncertainty import LinearMisfit, LinearTrial
from ..learning.parameters import split_name
from ..settings.learning import Bounds
from .released_force import RELEASE_DELAY
from .seen import Photo, SeenPose, Shape

_DIFFERENCE: Final = 1e-4  # of a physical parameter, as a fraction of its range
_DIFFERENCE_OF_MOTION: Final = 1e-5  # where differences of motions are exact to first order
_ROBUST: Final = 4.0  # px, or multiples of the noise of a cloud, s


class PictureMisfit(BoundedMisfit):
    """Residuals of poses and their derivatives; see the module.

    Args:
        poses: seen bodies.
        bounds: range of each parameter to identify.
        known: values of further parameters, which are not identified.
        near: shapes by pose from which equilibria are sought first; None where none is known.

    Raises:
        InputError: an unknown parameter or owner, nothing to identify, or a picture without
            anything to compare.
    """

    def __init__(
        self,
        poses: Sequence[SeenPose],
        bounds: Mapping[str, Bounds],
        known: Mapping[str, float] | None = None,
        near: Sequence[Shape | None] | None = None,
    ) -> None:
        super().__init__(bounds)
        self.poses, self._known = [*poses], {} if known is None else dict(known)
        for photo in self._photos():
            if not photo.kinds:
                raise InputError(
                    f"{photo.name} has neither an outline, "
                    "tracked points nor a cloud: leave it out."
                )
        if not bounds:
            raise InputError(
                "there is nothing to identify: name a parameter under identify.parameters."
            )
        for name in bounds:
            if not any(self._acts(name, pose) for pose in self.poses):
                parameter, owner = split_name(name)
                known_names = [
                    *dict.fromkeys(n for pose in self.poses for n in pose.parameter_names)
                ]
                raise InputError(
                    f"{owner} is neither a pose, a material nor a lens: name one."
                    if owner and parameter in known_names
                    else f"there is no parameter {parameter!r} to identify: choose from "
                    f"{', '.join(known_names)}."
                )
        self._first: list[Shape | None] = [None] * len(self.poses) if near is None else [*near]
        self._was_seen = False  # in every picture, with some parameters
        self._last: tuple[FloatArray, tuple[float, FloatArray, FloatArray]] | None = (
            None  # the last `objective`
        )
        self.forget()

    @override
    def forget(self) -> None:
        self._shapes, self._last = [*self._first], None

    @override
    def update_prior_weight(self, unit: FloatArray) -> None:
        """As elsewhere, but from the known noise of clouds before the first search:
        a far guess has no small errors.
        """
        self._last, first = None, not self.prior_weight
        super().update_prior_weight(unit)
        points = sum(len(photo.cloud.measured) for photo in self._photos() if photo.cloud)
        if first and points:
            self.prior_weight = min(self.prior_weight, 1.0 / points)

    @override
    def objective(
        self, unit: FloatArray, derivatives: bool
    ) -> tuple[float, FloatArray, FloatArray]:
        """As elsewhere, with derivatives in any case:
        they need shapes near that of the residuals, solved together.
        """
        if self._last is None or not np.array_equal(self._last[0], unit):
            self._last = unit.copy(), super().objective(unit, True)
        return self._last[1]

    def _photos(self) -> list[Photo]:
        return [photo for pose in self.poses for photo in pose.photos]

    @staticmethod
    def _acts(name: str, pose: SeenPose) -> bool:
        """Whether a parameter acts on a pose."""
        parameter, owner = split_name(name)
        owners = (*pose.owners, *(pose.lenses if parameter in CORRECTIONS else ()))
        return owner in owners and parameter in pose.parameter_names

    def shape(self, number: int, values: Mapping[str, float]) -> torch.Tensor:
        """Returns the shape of a pose with values of its parameters,
        from the last one (`SeenPose.shape`) [m].

        Raises:
            ConvergenceError: there is no equilibrium.
        """
        physical, last = _physical(values), self._shapes[number]
        if last is not None and last[0] == physical:
            return last[1]
        q = self.poses[number].shape(physical, last)
        self._shapes[number] = (physical, q)
        return q

    @override
    def linearise(self, unit: FloatArray, derivatives: bool = True) -> LinearMisfit | None:
        values, trials = self.from_unit(unit), list[LinearTrial]()
        share = 1.0 / sum(len(pose.photos) for pose in self.poses)
        for number, pose in enumerate(self.poses):
            known = {**self._known, **values}
            seen_by = values_of(pose, known)
            try:
                shapes, columns = self._shapes_by(number, unit, seen_by, derivatives)
                series = dict[str, list[LinearTrial]]()  # of tracked points that move, by lens
                for photo in pose.photos:
                    seen_by = values_of(pose, known, photo.lens)
                    parts, points = self._of_photo(pose, photo, seen_by, shapes, columns, share)
                    trials += parts
                    (series.setdefault(photo.lens, []) if pose.moves else trials).extend(points)
                # Errors of the same points may be correlated in time.
                for frames in filter(None, series.values()):
                    rows = np.stack([frame.rows.ravel() for frame in frames])
                    slopes = np.concatenate([frame.slopes for frame in frames])
                    trials.append(LinearTrial(rows, slopes, sum(frame.seen for frame in frames)))
            except ConvergenceError:
                return None
            except InputError:
                if not self._was_seen:  # Else a step went too far.
                    raise
                return None
        self._was_seen = True
        return LinearMisfit(trials, *self.prior_rows(unit))

    @override
    def losses_or_infinite(self, points: FloatArray) -> FloatArray:
        losses = np.full(len(points), np.inf)
        for number, point in enumerate(points):
            with suppress(InputError):  # A body may be out of a picture with random parameters.
                losses[number] = super().losses_or_infinite(point[None])[0]
        return losses

    def _shapes_by(
        self, number: int, unit: FloatArray, values: Mapping[str, float], derivatives: bool
    ) -> tuple[torch.Tensor, list[int] | None]:
        """A pose's shape and its derivatives by K of the physical parameters, (1 + K, ...), and
        their K columns.

        Derivatives are differences into the range. Without any the columns are None.
        """
        if not derivatives:
            return self.shape(number, values)[None], None
        pose = self.poses[number]
        moved = list[dict[str, float]]()
        columns = list[int]()
        steps = list[float]()
        for column, (name, range_) in enumerate(self.bounds.items()):
            parameter = split_name(name)[0]
            fixed = parameter in (*CORRECTIONS, RELEASE_DELAY) or not pose.deforms
            if fixed or not self._acts(name, pose):
                continue
            step = (1.0 if unit[column] < 0.5 else -1.0) * (
                _DIFFERENCE_OF_MOTION if pose.moves else _DIFFERENCE
            )
            value = range_.from_unit(torch.tensor(unit[column] + step, dtype=torch.float64))
            moved.append({**values, parameter: float(value)})
            columns.append(column)
            steps.append(step)
        if not columns:
            return self.shape(number, values)[None], columns
        physical = _physical(values)
        shapes = pose.shapes([values, *moved], self._shapes[number])
        self._shapes[number] = (physical, shapes[0])
        change = shapes[1:] - shapes[:1]
        return torch.cat(
            [shapes[:1], change / shapes.new_tensor(steps).view(-1, *[1] * (change.ndim - 1))]
        ), columns

    def _of_photo(
        self,
        pose: SeenPose,
        photo: Photo,
        values: Mapping[str, float],
        shapes: torch.Tensor,
        columns: Sequence[int] | None,
        share: float,
    ) -> tuple[list[LinearTrial], list[LinearTrial]]:
        """Weighted residuals of a picture, and their derivatives:
        outlines both ways and a cloud, and tracked points.

        The outlines of all pictures by a standing camera, both ways, have nearly the same errors
        (correlated by 0.87 to 0.997 between real pictures), so that they count as one set.
        """
        corrections = PlacedCamera.corrections(values)
        parts = list[LinearTrial]()
        points = list[LinearTrial]()
        vertices, velocities = pose.seen(photo, shapes, values)
        q, moved = vertices[0], torch.cat([vertices[1:], velocities[None]])
        share, camera = share / photo.kinds, photo.camera
        copies = pose.copies(photo)
        if photo.outline is not None:
            rim, of_simulated, of_measured = pose.outlines(photo, q, corrections)
            slopes = self._pixel_slopes(
                pose, photo, rim.points(q), rim.points(moved), corrections, columns
            )
            distance, along = photo.outline.signed(rim.pixels)
            order = np.argsort(cKDTree(photo.outline.points).query(rim.pixels)[1], kind="stable")
            jacobian = np.einsum("kpi,pi->pk", slopes, along)[order, None]
            parts.append(
                _weighted(
                    0.5 * share, of_simulated[order], distance[order, None], jacobian, 2 * copies
                )
            )
            index, distance, along = rim.closest(photo.outline.points)
            jacobian = np.einsum("kpi,pi->pk", slopes[:, index], along)[:, None]
            parts.append(
                _weighted(0.5 * share, of_measured, -distance[:, None], jacobian, 2 * copies)
            )
        if photo.tracked is not None and pose.points is not None:
            places = pose.points(q[None])[0]
            moves = (moved.flatten(1) @ pose.points.transposed_jacobian(q[None])[0]).unflatten(
                1, (-1, 3)
            )
            slopes = self._pixel_slopes(pose, photo, places, moves, corrections, columns)
            away = camera.pixels(places, corrections).numpy() - photo.tracked
            visible = np.asarray(np.isfinite(away).all(1))
            jacobian, away = slopes.transpose(1, 2, 0), np.where(visible[:, None], away, 0.0)
            if visible.any():
                points.append(_weighted(share, visible.astype(np.float64), away, jacobian, copies))
        if photo.cloud is not None:
            cloud = photo.cloud
            closest = cloud.distances(camera, corrections, pose.surface.triangles, q)
            slopes = np.zeros((len(self.bounds), len(closest.distances)))
            if columns is not None:
                placed = camera.located_by(torch.as_tensor(cloud.measured), corrections).numpy()
                by = np.concatenate(
                    [closest.moved(moved), np.einsum("cpi,pi->cp", placed, closest.directions)]
                )
                slopes = self._slopes(pose, photo, by, columns) * (
                    np.abs(closest.distances) < cloud.reach
                )
            distance = closest.distances.clip(-cloud.reach, cloud.reach)[:, None] / cloud.noise
            parts.append(
                _weighted(
                    share, np.ones(len(distance)), distance, slopes.T[:, None] / cloud.noise, copies
                )
            )
        return parts, points

    def _pixel_slopes(
        self,
        pose: SeenPose,
        photo: Photo,
        points: torch.Tensor,
        moved: torch.Tensor,
        corrections: torch.Tensor,
        columns: Sequence[int] | None,
    ) -> FloatArray:
        """Derivatives (P, Q, 2) of the pixels of points (Q, 3),
        which move (K + 1, Q, 3) as `_slopes` has it.
        """
        if columns is None:
            return np.zeros((len(self.bounds), len(points), 2))
        by = photo.camera.derivative(points, corrections, moved).numpy()
        # Where rows have times of their own, see `released_force`.
        late = photo.row_time * by[len(columns)]
        return self._slopes(pose, photo, by + late / (1.0 - late[:, 1:]) * by[..., 1:], columns)

    def _slopes(
        self, pose: SeenPose, photo: Photo, by: FloatArray, columns: Sequence[int]
    ) -> FloatArray:
        """Derivatives (P, ...) by all P parameters.

        Args:
            pose: of the picture.
            photo: the picture.
            by: (K + 1 + 9, ...) derivatives by K physical parameters, the time and the corrections.
            columns: K numbers of the physical parameters.
        """
        slopes = np.zeros((len(self.bounds), *by.shape[1:]))
        slopes[columns] = by[: len(columns)]
        late, placed = -by[len(columns)], by[len(columns) + 1 :]
        for column, (name, range_) in enumerate(self.bounds.items()):
            parameter, owner = split_name(name)
            if owner in (*pose.owners, photo.lens) and parameter in (*CORRECTIONS, RELEASE_DELAY):
                slope = late if parameter == RELEASE_DELAY else placed[CORRECTIONS.index(parameter)]
                slopes[column] = slope * range_.slope(0.5)
        return slopes


def _physical(values: Mapping[str, float]) -> dict[str, float]:
    """Values of the parameters that are not of the camera."""
    return {name: value for name, value in values.items() if name not in CORRECTIONS}


def _weighted(
    share: float, weight: FloatArray, distance: FloatArray, jacobian: FloatArray, copies: int
) -> LinearTrial:
    """Robust residuals (T, C) whose squares sum to a share
    of the weighted mean square of distances.

    Args:
        share: of the loss.
        weight: (T,) of each point.
        distance: (T, C) coordinates of the distance of each point [px], or multiples of its noise.
        jacobian: (T, C, P) of the distances.
        copies: number of sets of residuals with the same errors; this one counts as a part of one.
    """
    root = np.sqrt(share * weight / max(float(weight.sum()), 1e-12))
    bent = np.sqrt(1.0 + np.square(distance).sum(1) / _ROBUST**2)
    length = np.sqrt(2.0 / (bent + 1.0))  # of a residual over the distance
    # Derivative of the logarithm of that by d^2 / 2.
    inwards = -1.0 / (2.0 * _ROBUST**2 * bent * (bent + 1.0))
    along = np.einsum("tc,tcp->tp", distance, jacobian)
    slopes = jacobian + (inwards[:, None] * along)[:, None] * distance[..., None]
    scale = (root * length)[:, None]
    rows = scale * distance
    count = max(round(int((weight > 0.0).sum()) * distance.shape[1] / copies), 1)
    return LinearTrial(rows, (scale[..., None] * slopes).reshape(rows.size, -1), count)


def values_of(pose: SeenPose, values: Mapping[str, float], lens: str = "") -> dict[str, float]:
    """Returns the values of a pose's parameters, by their names without an owner.

    Values of a lens come before those of all, values of its material before these, and its own
    before all others.
    """
    result: dict[str, float] = {}
    everyone, *owners = pose.owners
    for owner in dict.fromkeys((everyone, lens, *owners)):
        result |= {
            split_name(name)[0]: value
            for name, value in values.items()
            if split_name(name)[1] == owner
        }
    return result
