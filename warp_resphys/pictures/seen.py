"""Bodies before a camera, at rest or released, and how far pictures
of them are from simulated ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import shapely
import torch

from ..core.dynamics.simulator import Simulator
from ..core.stepping.inputs import Inputs
from ..core.stepping.rotations import rotations
from ..data.camera import CORRECTIONS, PLACES, PlacedCamera
from ..data.markers import Observation
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError
from ..learning.parameters import constants_of, identifiable_parameters
from .clouds import Cloud
from .outlines import ClosedSurface, Outline, Silhouette, visibility, within
from .released_force import OF_RELEASE, ReleasedForce, at_row_times

CLAMP_TURN: Final = "clamp_turn"  # rad
CLAMP_SHIFT: Final = "clamp_shift"  # m
# Parameters of a picture or a release, where these are as configured.
NEUTRAL: Final[Mapping[str, float]] = {
    **dict(zip(CORRECTIONS, PlacedCamera.corrections({}).tolist(), strict=True)),
    **dict.fromkeys((CLAMP_SHIFT, *OF_RELEASE), 0.0),
}
# Values of parameters, and with them the vertices (N, 3) at rest, or (K + 1, N, 3) at the steps of
# a motion [m].
Shape = tuple[Mapping[str, float], torch.Tensor]

_TURNED: Final = 0.4  # rad, largest part of a clamp's turn from one equilibrium to the next
_MARGIN: Final = 6.0  # px, around what a clamp hides
_MILLI: Final = 1e3


@dataclass(frozen=True)
class Photo:
    """Outline, tracked points or depths of a body in a picture, or a scan of it.

    Attributes:
        name: of the picture, or of the scan.
        camera: before which the body stands; without a lens, the axes of a scan.
        outline: of the body; None where it was not drawn.
        tracked: (M, 2) pixels of the body's tracked points, NaN where one was not seen; None
            without tracked points.
        cloud: points of a scan or a depth image; None without.
        lens: name of the lens, whose values of parameters are those of this picture; empty for a
            single one.
        time: at which its row 0 is exposed [s].
        row_time: from the exposure of a row to that of the next [s].
        rows: of the picture; zero where its measurements, or a principal point in the middle, show
            them.
    """

    name: str
    camera: PlacedCamera
    outline: Outline | None = None
    tracked: FloatArray | None = None
    cloud: Cloud | None = None
    lens: str = ""
    time: float = 0.0
    row_time: float = 0.0
    rows: float = 0.0

    @property
    def kinds(self) -> int:
        """Number of kinds of measurements: outline, tracked points, cloud."""
        return sum(kind is not None for kind in (self.outline, self.tracked, self.cloud))

    @property
    def last(self) -> float:
        """Time at which the last row is exposed that may show the body [s]."""
        rows = (
            [self.rows]
            if self.camera.lens is None
            else [self.rows, 2.0 * float(self.camera.lens.matrix[1, 2])]
        )
        rows += [] if self.outline is None else [self.outline.size[1]]
        measured = (self.tracked, None if self.cloud is None else self.cloud.measured)
        rows += [
            float(np.nanmax(pixels[:, 1], initial=0.0)) for pixels in measured if pixels is not None
        ]
        return self.time + max(self.row_time * max(rows), 0.0)


def distance_of(difference: Mapping[str, float]) -> float:
    """Returns the distance of the outlines.

    Where there are none, of the cloud, else of tracked points [mm].
    """
    return next(
        (
            difference[kind]
            for kind in ("outline_mm", "cloud_mm", "points_mm")
            if kind in difference
        ),
        math.nan,
    )


@dataclass(frozen=True)
class SeenPose:
    """A body at rest, or held and released, and pictures of it.

    Attributes:
        name: of the pose.
        simulator: of the body.
        surface: of the body.
        clamps: (V,) vertices in each clamp, which hides them.
        photos: pictures of it, at least one.
        material: owner of the parameters that poses of the same material share.
        points: observation of the tracked points; None without.
        deforms: whether it is simulated; else the undeformed body is compared.
        release: of a force, after which it moves; None for a body at rest.

    Raises:
        InputError: there is no picture, points were tracked that nothing observes, or a body that
            moves was scanned.
    """

    name: str
    simulator: Simulator
    surface: ClosedSurface
    clamps: tuple[IntArray, ...]
    photos: tuple[Photo, ...]
    material: str = ""
    points: Observation | None = None
    deforms: bool = True
    release: ReleasedForce | None = None

    def __post_init__(self) -> None:
        """Checks that there is something to compare."""
        if not self.photos:
            raise InputError(f"{self.name} has no picture.")
        if self.points is None and any(photo.tracked is not None for photo in self.photos):
            raise InputError(
                f"{self.name}: points were tracked, but their places on the body are not known."
            )
        if self.release is not None and any(photo.camera.lens is None for photo in self.photos):
            raise InputError(
                f"{self.name} moves, and a scan shows no time: make a pose of its own for the scan."
            )

    @property
    def moves(self) -> bool:
        """Whether it is simulated as a motion."""
        return self.release is not None and self.deforms

    def before(self, cameras: Mapping[str, torch.Tensor]) -> Self:
        """Returns the pose with all pictures by a lens taken from one place,
        world_to_camera (4, 4) by its name.
        """
        placed = (
            replace(photo, camera=replace(photo.camera, pose=cameras[photo.lens]))
            if photo.camera.lens is not None and photo.lens in cameras
            else photo
            for photo in self.photos
        )
        return replace(self, photos=tuple(placed))

    def copies(self, photo: Photo) -> int:
        """Number of pictures with nearly the same errors as one:
        those by its camera, where it and the body stand.
        """
        if self.release is not None:
            return 1
        lensless = photo.camera.lens is None
        mine = [
            other
            for other in self.photos
            if other.lens == photo.lens and (other.camera.lens is None) == lensless
        ]
        return (
            len(mine)
            if all(torch.equal(other.camera.pose, photo.camera.pose) for other in mine)
            else 1
        )

    @property
    def owners(self) -> tuple[str, ...]:
        """Owners of values of its parameters, of which a later one takes precedence.

        Without the lenses.
        """
        return ("", self.material, self.name)

    @property
    def lenses(self) -> tuple[str, ...]:
        """Names of the lenses of its pictures."""
        return tuple(
            dict.fromkeys(photo.lens for photo in self.photos if photo.camera.lens is not None)
        )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters that shape and pictures depend on."""
        clamps = (CLAMP_TURN, CLAMP_SHIFT) if len(self.clamps) > 1 else ()
        of_clamps = clamps if self.release is None else OF_RELEASE
        return (
            *identifiable_parameters(self.simulator),
            *of_clamps,
            *(CORRECTIONS if self.lenses else PLACES),
        )

    def shape(self, values: Mapping[str, float], near: Shape | None = None) -> torch.Tensor:
        """Returns the vertices (N, 3) of the body at rest,
        or (K + 1, N, 3) of its motion from the release on [m].
        """
        return self.shapes([values], near)[0]

    def shapes(
        self, values: Sequence[Mapping[str, float]], near: Shape | None = None
    ) -> torch.Tensor:
        """Returns shapes (E, N, 3) or (E, K + 1, N, 3) for E sets of parameters,
        which hardly differ [m].

        Args:
            values: of parameters by name; those of the camera are ignored.
            near: values and a shape with them, from which the equilibrium is sought; the undeformed
                body, if left out.

        Raises:
            ConvergenceError: there is no equilibrium, or a step fails.
        """
        if self.moves:
            assert self.release is not None
            guess = (
                self.simulator.rest_state(1).q
                if near is None
                else near[1].view(-1, *near[1].shape[-2:])
            )
            last = max(photo.last for photo in self.photos)
            return self.release.motions(self.simulator, values, last, guess[0])
        first = self._at_rest(values[0], near)
        return (
            torch.stack([first, *(self._at_rest(more, (values[0], first)) for more in values[1:])])
            .double()
            .cpu()
        )

    def seen(
        self, photo: Photo, shapes: torch.Tensor, values: Mapping[str, float]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the vertices (S, N, 3) that a picture shows of S shapes [m],
        at the times of the first one's rows.

        Args:
            photo: the picture.
            shapes: (S, N, 3) at rest, or (S, K + 1, N, 3) in motion: one, and perhaps derivatives
                of it.
            values: of parameters by name.

        Returns:
            The vertices, and velocities (N, 3) of the first shape [m/s].
        """
        if not self.moves:
            return shapes, torch.zeros_like(shapes[0])
        assert self.release is not None
        corrections, step = PlacedCamera.corrections(values), self.simulator.time_step
        begin = photo.time - self.release.at(values)

        def pixels(q: torch.Tensor) -> torch.Tensor:
            return photo.camera.pixels(q, corrections)

        return at_row_times(shapes, begin, photo.row_time, step, pixels)

    def vertices(
        self, photo: Photo, shape: torch.Tensor, values: Mapping[str, float]
    ) -> torch.Tensor:
        """Returns the vertices (N, 3) that a picture shows of a shape; see `seen` [m]."""
        return self.seen(photo, shape[None], values)[0][0]

    def _at_rest(self, values: Mapping[str, float], near: Shape | None) -> torch.Tensor:
        """Returns the vertices (N, 3) of the body at rest [m]."""
        sim = self.simulator
        if not self.deforms:
            return sim.rest_state(1).q[0]
        parameters = {
            name: sim.tensor([v])
            for name, v in values.items()
            if name in identifiable_parameters(sim)
        }
        constants = sim.prepare(constants_of(sim, parameters))
        before, q = (
            ({}, sim.rest_state(1).q[0])
            if near is None
            else (near[0], near[1].to(sim.rest_state(1).q))
        )
        first = [before.get(name, 0.0) for name in (CLAMP_TURN, CLAMP_SHIFT)]
        last = [values.get(name, 0.0) for name in (CLAMP_TURN, CLAMP_SHIFT)]
        parts, inputs = max(math.ceil(abs(last[0] - first[0]) / _TURNED), 1), None
        with torch.no_grad():
            for turn, shift in np.linspace(first, last, parts + 1)[1:]:
                if any(first) or any(last):
                    q = self._turned(q, (last[0] - first[0]) / parts)
                    inputs = Inputs(fixed_positions=self._clamped(turn, shift)[None])
                q = sim.static_equilibrium(inputs, constants, start=q[None]).q[0]
        return q

    def _between(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Centre of the second clamp, direction from the first to it,
        and share (N,) of its motion along the body.
        """
        rest = self.simulator.rest_state(1).q[0]
        first, second = (
            torch.as_tensor(clamp).to(self.simulator.fixed) for clamp in self.clamps[:2]
        )
        centre = rest[second].mean(0)
        axis = torch.nn.functional.normalize(centre - rest[first].mean(0), dim=0)
        along = rest @ axis
        low, high = along[first].max(), along[second].min()
        if not float(high) > float(low):
            raise InputError(
                f"{self.name}: its clamps overlap along the line from one to the other, about "
                "which the second may be turned: leave clamp_turn and clamp_shift out."
            )
        return centre, axis, ((along - low) / (high - low)).clamp(0.0, 1.0)

    def _turned(self, q: torch.Tensor, turn: float) -> torch.Tensor:
        """Vertices (N, 3) turned with the second clamp,
        in proportion to their place between the clamps.
        """
        centre, axis, share = self._between()
        turned = rotations((turn * share)[:, None] * axis) @ (q - centre)[..., None]
        return centre + turned[..., 0]

    def _clamped(self, turn: float, shift: float) -> torch.Tensor:
        """Fixed vertices (D, 3) with the second clamp turned [rad] about the line
        from the first to it, and shifted.
        """
        sim = self.simulator
        axis = self._between()[1]
        rest = sim.rest_state(1).q[0]
        mine = torch.isin(sim.fixed, torch.as_tensor(self.clamps[1]).to(sim.fixed))[:, None]
        return torch.where(
            mine, (self._turned(rest, turn) + shift * axis)[sim.fixed], rest[sim.fixed]
        )

    def outlines(
        self, photo: Photo, q: torch.Tensor, corrections: torch.Tensor
    ) -> tuple[Silhouette, FloatArray, FloatArray]:
        """Returns the outline of the body (N, 3) in a picture that has a measured one.

        Args:
            photo: the picture.
            q: (N, 3) vertices [m].
            corrections: (9,) of the camera.

        Returns:
            The simulated outline, weights (P,) of its points: the length that each stands for [px],
            less where a clamp hides it, and weights (Q,) of the measured points.

        Raises:
            InputError: a part of the body is behind the camera, or none is in the picture outside
                of the clamps.
        """
        assert photo.outline is not None
        pixels = photo.camera.pixels(q.double().cpu(), corrections).numpy()
        rim = self.surface.silhouette(pixels)
        simulated, measured = rim.lengths.copy(), np.ones(len(photo.outline.points))
        simulated *= within(rim.pixels, photo.outline.size)
        for clamp in self.clamps:
            simulated *= visibility(rim.pixels, pixels[clamp], _MARGIN)
            measured *= visibility(photo.outline.points, pixels[clamp], _MARGIN)
        if not (simulated.any() and measured.any()):
            raise InputError(
                f"{photo.name} does not show the simulated body where it is drawn: check the "
                "mask, the lens, and world_to_camera, which takes m in the axes of the mesh to "
                "those of the camera."
            )
        return rim, simulated, measured

    def difference(
        self, photo: Photo, q: torch.Tensor, values: Mapping[str, float]
    ) -> dict[str, float]:
        """Returns how far a simulated picture is from a measured one.

        Args:
            photo: the picture.
            q: (N, 3) vertices [m].
            values: of the camera's corrections by name; none where they are left out.

        Returns:
            What the picture shows of: ``outline_mm``, the mean distance of the outlines, both ways,
            at the body's mean depth; ``outline_px``, the same in pixels; ``overlap``, the common
            area over that of both together, outside of the clamps; ``cloud_mm``, the mean distance
            of the points of a cloud from the surface, of farther ones its reach; and ``points_mm``,
            the mean distance of the tracked points that were seen, at their depths.
        """
        q = q.double().cpu()
        corrections = PlacedCamera.corrections(values)
        result = dict[str, float]()
        if photo.outline is not None:
            depth = photo.camera.seen_from(q, corrections)[:, 2]
            rim, of_simulated, of_measured = self.outlines(photo, q, corrections)
            there = np.average(np.abs(photo.outline.signed(rim.pixels)[0]), weights=of_simulated)
            back = np.average(np.abs(rim.closest(photo.outline.points)[1]), weights=of_measured)
            pixels = float(0.5 * (there + back))
            millimetres = pixels * float(depth.mean()) * photo.camera.millimetres(corrections)
            drawn = photo.camera.pixels(q, corrections).numpy()
            hidden = shapely.union_all(
                [shapely.convex_hull(shapely.multipoints(drawn[ids])) for ids in self.clamps]
            )
            body, mask = (
                shapely.difference(area, hidden)
                for area in (self.surface.region(drawn), photo.outline.region)
            )
            overlap = shapely.intersection(body, mask).area / shapely.union(body, mask).area
            result |= {"outline_mm": millimetres, "outline_px": pixels, "overlap": float(overlap)}
        if photo.cloud is not None:
            distances = np.abs(
                photo.cloud.distances(
                    photo.camera, corrections, self.surface.triangles, q
                ).distances
            )
            result["cloud_mm"] = _MILLI * float(np.minimum(distances, photo.cloud.reach).mean())
        if photo.tracked is not None and self.points is not None:
            places = self.points(q[None])[0]
            away = photo.camera.pixels(places, corrections).numpy() - photo.tracked
            deep = photo.camera.seen_from(places, corrections)[:, 2].numpy()
            distance = np.linalg.norm(away, axis=1) * deep * photo.camera.millimetres(corrections)
            if np.isfinite(distance).any():
                result["points_mm"] = float(np.nanmean(distance))
        return result
