"""The misfit of simulated bodies to pictures of them, as a function of physical parameters and of the camera's.

The loss is the mean square distance of the measured and the simulated outlines, both ways, and of tracked points, in
pixels, and of the points of clouds from the surface, in multiples of their noise; every picture or scan has the same
weight, and within it outlines, points and cloud. A distance r counts as s sqrt(2 (sqrt(1 + (r / s)^2) - 1)), which is r
where it is well below s = 4, and less beyond, as a cable or a hand before the body moves its outline by any number of
pixels (Charbonnier et al. 1997).

A name with an owner (`learning.parameters.own_name`) is the value of one pose, of the poses of one material, or of the
pictures by one lens; a name without, that of all. Shapes follow the physical parameters by differences of equilibria,
and pixels and clouds follow shapes and cameras exactly.

`tests/pictures/test_picture_misfit.py` and `test_clouds.py` compare the derivatives with differences.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Final

import numpy as np
import torch
from scipy.spatial import cKDTree
from typing_extensions import override

from ..io.errors import ConvergenceError, InputError
from ..learning.bounded_misfit import BoundedMisfit, FloatArray, LinearMisfit
from ..learning.bounds import Bounds
from ..learning.parameters import split_name
from ..learning.uncertainty import Linearised
from .camera import CORRECTIONS, PlacedCamera
from .seen import Photo, SeenPose, Shape

_DIFFERENCE: Final = 1e-4  # of a physical parameter, as a fraction of its range
_ROBUST: Final = 4.0  # px, or multiples of the noise of a cloud, s


class PictureMisfit(BoundedMisfit):
    """Residuals of poses and their derivatives; see the module.

    Args:
        poses: seen bodies.
        bounds: range of each parameter to identify.
        known: values of further parameters, which are not identified.
        near: shapes by pose from which equilibria are sought first; None where none is known.

    Raises:
        InputError: an unknown parameter or owner, nothing to identify, or a picture without anything to compare.
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
        for photo in (photo for pose in self.poses for photo in pose.photos):
            if not photo.kinds:
                raise InputError(f"{photo.name} has neither an outline, tracked points nor a cloud: leave it out.")
        if not bounds:
            raise InputError("there is nothing to identify: name a parameter under identify.parameters.")
        for name in bounds:
            if not any(self._acts(name, pose) for pose in self.poses):
                parameter, owner = split_name(name)
                known_names = [*dict.fromkeys(n for pose in self.poses for n in pose.parameter_names)]
                raise InputError(
                    f"{owner} is neither a pose, a material nor a lens: name one."
                    if owner and parameter in known_names
                    else f"there is no parameter {parameter!r} to identify: choose from {', '.join(known_names)}."
                )
        self._first: list[Shape | None] = [None] * len(self.poses) if near is None else [*near]
        self._was_seen = False  # in every picture, with some parameters
        self.forget()

    @override
    def forget(self) -> None:
        self._shapes = [*self._first]

    @override
    def update_prior_weight(self, unit: FloatArray) -> float:
        """As elsewhere, but from the known noise of clouds before the first search: a far guess has no small errors."""
        first, change = not self.prior_weight, super().update_prior_weight(unit)
        points = sum(len(photo.cloud.measured) for pose in self.poses for photo in pose.photos if photo.cloud)
        if first and points:
            self.prior_weight = min(self.prior_weight, 1.0 / points)
        return change

    @staticmethod
    def _acts(name: str, pose: SeenPose) -> bool:
        """Whether a parameter acts on a pose."""
        parameter, owner = split_name(name)
        owners = (*pose.owners, *(pose.lenses if parameter in CORRECTIONS else ()))
        return owner in owners and parameter in pose.parameter_names

    def shape(self, number: int, own: Mapping[str, float]) -> torch.Tensor:
        """Returns the vertices (N, 3) of a pose with values of its parameters [m], from the last ones.

        Raises:
            ConvergenceError: there is no equilibrium.
        """
        physical, last = {name: v for name, v in own.items() if name not in CORRECTIONS}, self._shapes[number]
        if last is not None and last[0] == physical:
            return last[1]
        q = self.poses[number].shape(physical, last).double().cpu()
        self._shapes[number] = (physical, q)
        return q

    @override
    def linearise(self, unit: FloatArray, derivatives: bool = True) -> LinearMisfit | None:
        values, trials = self.from_unit(unit), list[Linearised]()
        share = 1.0 / sum(len(pose.photos) for pose in self.poses)
        for number, pose in enumerate(self.poses):
            known = {**self._known, **values}
            own = values_of(pose, known)
            try:
                q = self.shape(number, own)
                tangents = self._tangents(number, unit, own, q) if derivatives else {}
                for photo in pose.photos:
                    trials += self._of_photo(pose, photo, values_of(pose, known, photo.lens), q, tangents, share)
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

    def _tangents(
        self, number: int, unit: FloatArray, own: Mapping[str, float], q: torch.Tensor
    ) -> dict[int, torch.Tensor]:
        """Derivatives (N, 3) of a shape by its physical parameters, by their column; differences into the range."""
        pose, tangents = self.poses[number], dict[int, torch.Tensor]()
        for column, (name, range_) in enumerate(self.bounds.items()):
            parameter = split_name(name)[0]
            if parameter in CORRECTIONS or not pose.deforms or not self._acts(name, pose):
                continue
            step = _DIFFERENCE if unit[column] < 0.5 else -_DIFFERENCE
            moved = {**own, parameter: float(range_.from_unit(torch.tensor(unit[column] + step, dtype=torch.float64)))}
            tangents[column] = (pose.shape(moved, (own, q)).double().cpu() - q) / step
        return tangents

    def _of_photo(
        self,
        pose: SeenPose,
        photo: Photo,
        own: Mapping[str, float],
        q: torch.Tensor,
        tangents: Mapping[int, torch.Tensor],
        share: float,
    ) -> list[Linearised]:
        """Weighted residuals of a picture, and their derivatives: outlines both ways, tracked points, and a cloud.

        The outlines of all pictures by a standing camera, both ways, have nearly the same errors (correlated by 0.87 to
        0.997 between real pictures), so that they count as one set.
        """
        corrections, parts = PlacedCamera.corrections(own), list[Linearised]()
        moved = torch.stack([*tangents.values()]) if tangents else q.new_zeros(0, *q.shape)
        share, copies, camera = share / photo.kinds, pose.copies(photo), photo.camera
        if photo.outline is not None:
            seen = pose.outlines(photo, q, corrections)
            rim = seen.silhouette
            by = camera.derivative(rim.points(q), corrections, rim.points(moved)).numpy()
            slopes = self._slopes(pose, photo, by, [*tangents])
            distance, along = photo.outline.signed(rim.pixels)
            order = np.argsort(cKDTree(photo.outline.points).query(rim.pixels)[1], kind="stable")
            jacobian = np.einsum("kpi,pi->pk", slopes, along)[order, None]
            weights = seen.of_simulated[order]
            parts.append(_weighted(0.5 * share, weights, distance[order, None], jacobian, 2 * copies))
            index, distance, along = rim.closest(photo.outline.points)
            jacobian = np.einsum("kpi,pi->pk", slopes[:, index], along)[:, None]
            parts.append(_weighted(0.5 * share, seen.of_measured, -distance[:, None], jacobian, 2 * copies))
        if photo.tracked is not None and pose.points is not None:
            places = pose.points(q[None])[0]
            moves = (moved.flatten(1) @ pose.points.transposed_jacobian(q[None])[0]).unflatten(1, (-1, 3))
            slopes = self._slopes(pose, photo, camera.derivative(places, corrections, moves).numpy(), [*tangents])
            away = camera.pixels(places, corrections).numpy() - photo.tracked
            visible = np.asarray(np.isfinite(away).all(1))
            jacobian, away = slopes.transpose(1, 2, 0), np.where(visible[:, None], away, 0.0)
            if visible.any():
                parts.append(_weighted(share, visible.astype(np.float64), away, jacobian, copies))
        if photo.cloud is not None:
            cloud, closest = photo.cloud, pose.cloud_distances(photo, q, corrections)
            placed = camera.located_by(torch.as_tensor(cloud.measured), corrections).numpy()
            by = np.concatenate([closest.moved(moved), np.einsum("cpi,pi->cp", placed, closest.directions)])
            slopes = self._slopes(pose, photo, by, [*tangents]) * (np.abs(closest.distances) < cloud.reach)
            distance = closest.distances.clip(-cloud.reach, cloud.reach)[:, None] / cloud.noise
            parts.append(_weighted(share, np.ones(len(distance)), distance, slopes.T[:, None] / cloud.noise, copies))
        return parts

    def _slopes(self, pose: SeenPose, photo: Photo, by: FloatArray, columns: Sequence[int]) -> FloatArray:
        """Derivatives (P, ...) by all P parameters, from those (K + 9, ...) by K physical ones and the corrections.

        Args:
            pose: of the picture.
            photo: the picture.
            by: see above.
            columns: K numbers of the physical parameters.
        """
        slopes = np.zeros((len(self.bounds), *by.shape[1:]))
        slopes[columns] = by[: len(columns)]
        for column, (name, range_) in enumerate(self.bounds.items()):
            parameter, owner = split_name(name)
            if parameter in CORRECTIONS and owner in (*pose.owners, photo.lens):
                slopes[column] = by[len(columns) + CORRECTIONS.index(parameter)] * range_.slope(0.5)
        return slopes


def _weighted(share: float, weight: FloatArray, distance: FloatArray, jacobian: FloatArray, copies: int) -> Linearised:
    """Robust residuals (T, C) whose squares sum to a share of the weighted mean square of distances.

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
    inwards = -1.0 / (2.0 * _ROBUST**2 * bent * (bent + 1.0))  # derivative of the logarithm of that by d^2 / 2
    along = np.einsum("tc,tcp->tp", distance, jacobian)
    slopes = jacobian + (inwards[:, None] * along)[:, None] * distance[..., None]
    scale = (root * length)[:, None]
    rows = scale * distance
    count = max(round(int((weight > 0.0).sum()) * distance.shape[1] / copies), 1)
    return rows, (scale[..., None] * slopes).reshape(rows.size, -1), count


def values_of(pose: SeenPose, values: Mapping[str, float], lens: str = "") -> dict[str, float]:
    """Returns the values of a pose's parameters, by their names without an owner.

    Values of a lens come before those of all, values of its material before these, and its own before all others.
    """
    own: dict[str, float] = {}
    everyone, *owners = pose.owners
    for owner in dict.fromkeys((everyone, lens, *owners)):
        own |= {split_name(name)[0]: value for name, value in values.items() if split_name(name)[1] == owner}
    return own
