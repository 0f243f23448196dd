"""Settings of bodies that are seen by cameras, at rest or released."""

from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from ..core.mesh.place import LengthUnit, Place
from ..io.settings import (
    Count,
    Many,
    Natural,
    NotNegative,
    Pair,
    Positive,
    Settings,
    Some,
    Vector,
    Word,
    setting,
)
from .performed import LimitSettings, WithoutMotion, different

_Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
_Rows = Annotated[Many[Vector], Field(min_length=3, max_length=3)]


class ColourSettings(Settings):
    """Colours of a body in a picture."""

    hue: Pair[float] = setting(
        description="first and last hue; the interval may pass 360", unit="degrees"
    )
    saturation: _Fraction = setting(0.5, "least saturation")
    value: _Fraction = setting(0.1, "least value (brightness)")


class LensSettings(Settings):
    """The lens of the camera: a calibration, or its matrix."""

    file: Word | None = setting(None, "calibration by OpenCV or ROS, in the folder of the pictures")
    matrix: _Rows | None = setting(None, "K, row by row", "px")
    row_time: float = setting(0.0, "rolling shutter: time from a row to the row below", "s")

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if (self.file is None) == (self.matrix is None):
            raise ValueError(
                "file and matrix: give one of them, "
                "a calibration or the matrix; null takes one out."
            )
        return self


def _kind_of_lens(value: object) -> str:
    """Whether settings of lenses are those of one, or of several by their names."""
    one = (
        isinstance(value, LensSettings)
        or not isinstance(value, Mapping)
        or {*value} & {*LensSettings.model_fields}
    )
    return "one" if one else "several"


_Lenses = Annotated[
    Annotated[LensSettings, Tag("one")] | Annotated[dict[str, LensSettings], Tag("several")],
    Discriminator(_kind_of_lens),
]


class CloudSettings(Settings):
    """Scans of the surface of bodies, and depth images."""

    units: LengthUnit = setting("m", "unit of scans")
    depth_unit: Positive = setting(1e-3, "length that an integer of a depth image stands for", "m")
    noise: Positive = setting(1e-3, "standard deviation of a distance from the surface", "m")
    reach: Positive = setting(0.05, "largest distance of a point from the body", "m")
    points: Natural = setting(1000, "points per scan or depth image")


class TagSettings(Settings):
    """A square tag on the clamp, from which the camera's place is computed
    in place of world_to_camera.
    """

    dictionary: Word = setting(
        "6x6_250", "dictionary of OpenCV's ArUco tags, such as 4x4_50 or apriltag_36h11"
    )
    number: Count = setting(0, "number of the tag")
    size: Positive = setting(description="edge of its black square", unit="m")
    centre: Vector = setting((0.0, 0.0, 0.0), "centre of the tag in the axes of the mesh", "m")
    right: Vector = setting((1.0, 0.0, 0.0), "direction of its upper edge")
    up: Vector = setting((0.0, 1.0, 0.0), "direction of its left edge")


class ReleasedForceSettings(Settings):
    """A force that holds a body at rest and is then released."""

    at: Place = setting(description="vertices that carry it, in equal shares")
    force: Vector = setting(description="force in the axes of the scene", unit="N")
    time: float = setting(0.0, "time of the release, on the clock of the frames", "s")


class PoseSettings(Settings):
    """A body at rest, or one that is released, and the folder of its pictures."""

    folder: Word = setting(
        description="with camera.json and the pictures, in the folder of the data"
    )
    mesh: Word | None = setting(None, "file of its mesh, in its folder; null: the group mesh")
    material: Word | None = setting(None, "name of its material; null: one material")
    frames: Annotated[Some[Count], AfterValidator(different)] | None = setting(
        None, "numbers of the frames, from 0; null: all"
    )
    mask: ColourSettings | None = setting(
        None, "colours of the body, where its frames have no masks; null: data.mask"
    )
    outline: bool = setting(True, "whether the body's outline is compared")
    points: Word | None = setting(None, "file of tracked points, a row per frame")
    cloud: Word | None = setting(None, "file of a scan: .ply, .xyz, .pcd, .npy, .obj, .off or .stl")
    depth: bool = setting(True, "whether depth images of its frames are compared")
    gravity: Vector | None = setting(
        None, "gravity in the axes of the scene; null: as configured", "m/s^2"
    )
    clamp_turn: float = setting(0.0, "rotation of the second clamp against the first", "degrees")
    release: ReleasedForceSettings | None = setting(
        None, "release of a force, after which the body moves, in frames with times; null: it rests"
    )


class SimulatedCamera(Settings):
    """A simulated laboratory of pictures, on the body of the configuration."""

    material: dict[str, float] = setting(
        {}, "parameters of the true material that differ from the simulation"
    )
    corrections: dict[str, float] = setting({}, "true corrections by parameter")
    noise: NotNegative = setting(1.0, "standard deviation of outlines and tracked points", "px")
    frames: Natural = setting(60, "number of frames of a released body")
    frame_rate: Positive = setting(60.0, "rate of these frames", "Hz")
    row_time: float | None = setting(
        None, "true time between two rows; null: that of the lens", "s"
    )
    substeps: Natural = setting(2, "substeps per time step in true motions")
    depth: NotNegative | None = setting(None, "standard deviation of depth images; null: none", "m")
    size: Pair[Natural] = setting((1280, 720), "width and height of the pictures", "px")
    place: Vector = setting(description="position of the camera", unit="m")
    looks_at: Vector = setting(description="point in the middle of the pictures", unit="m")


class PictureData(WithoutMotion):
    """Bodies before a camera, at rest or released: outlines and tracked points in pictures."""

    kind: Literal["pictures"]
    folder: Word | None = setting(None, "folder of the pictures")
    lens: _Lenses | None = setting(
        None,
        "lens of the camera; of several cameras, by name: {left: {file: left.yaml}, right: {...}}",
    )
    tag: TagSettings | None = setting(None, "tag on the clamp; null: frames have world_to_camera")
    stands: bool = setting(True, "the camera stands still during a pose")
    order: Literal[1, 2] = setting(2, "order of the elements of meshes in the folders of poses")
    units: LengthUnit = setting("m", "unit of these meshes")
    mask: ColourSettings | None = setting(None, "colours of the bodies, where frames have no masks")
    points: dict[str, Vector] = setting({}, "tracked points on the undeformed body, by name", "m")
    likelihood: _Fraction = setting(0.6, "least likelihood of a tracked point")
    cloud: CloudSettings = setting(CloudSettings(), "settings of scans and depth images")
    materials: dict[str, dict[str, float]] = setting(
        {}, "parameters by material, where they differ from simulation"
    )
    poses: dict[str, PoseSettings] = setting(description="poses by name")
    train: Some[Word] = setting(description="poses that identify the material")
    test: Many[Word] = setting((), "poses that are predicted with it")
    limit: LimitSettings | None = setting(None, "fewer poses, the first of each split")
    steps: None = setting(None, "null, as frames have their own times")
    simulated: SimulatedCamera | None = setting(None, "plays the camera where there is no folder")

    @model_validator(mode="after")
    def _are_known(self) -> Self:
        for key, names in (("train", self.train), ("test", self.test)):
            unknown = [name for name in names if name not in self.poses]
            if unknown:
                raise ValueError(
                    f"{key} names '{unknown[0]}': data.poses has {', '.join(self.poses)}."
                )
        both = [name for name in self.train if name in self.test]
        if both:
            raise ValueError(
                f"test names '{both[0]}', which is in data.train as well: take one out."
            )
        pointed = [
            name for name, pose in self.poses.items() if pose.points is not None and not self.points
        ]
        if pointed:
            raise ValueError(
                f"points is empty, and data.poses.{pointed[0]} has some: give their places, "
                "{tip: [x, y, z]}."
            )
        used = {pose.material for pose in self.poses.values()} - {None}
        if used and (missing := sorted(str(name) for name in used if name not in self.materials)):
            raise ValueError(
                f"materials lacks '{missing[0]}', which a pose names: give it, or {{}}."
            )
        owners = {
            "data.poses": [*self.poses],
            "data.materials": [*self.materials],
            "data.lens": [*self.lenses],
        }
        for (first, mine), (second, others) in combinations(owners.items(), 2):
            both = [name for name in mine if name in others]
            if both:
                raise ValueError(f"{first} and {second} both have '{both[0]}': rename one.")
        unseen = {self.poses[name].material for name in self.test} - {
            self.poses[n].material for n in self.train
        }
        if unseen:
            raise ValueError(
                f"test has a pose of {min(map(str, unseen))}, "
                "of which no pose is in data.train: take it out."
            )
        if self.folder is None and self.simulated is None:
            raise ValueError("folder is not set: give the folder of the pictures.")
        if self.folder is not None and self.simulated is not None:
            raise ValueError(
                "simulated is for pictures without a folder, and data.folder is set: set "
                "data.simulated to null for the pictures of the folder, or data.folder for those "
                "of the simulated camera."
            )
        if self.simulated is not None:
            for name, pose in self.poses.items():
                if pose.mesh or pose.material or pose.cloud or pose.clamp_turn:
                    raise ValueError(
                        f"poses.{name} has a mesh, a material, a scan or a turned clamp, which "
                        "the simulated camera does not play: leave them out."
                    )
            if [*self.lenses] != [""]:
                raise ValueError("lens must be a single one for the simulated camera.")
            if len({pose.folder for pose in self.poses.values()}) < len(self.poses):
                raise ValueError("poses share a folder: give each its own.")
        return self

    @property
    def lenses(self) -> dict[str, LensSettings]:
        """Lenses by name, which is empty for a single one."""
        if isinstance(self.lens, dict):
            return self.lens
        return {} if self.lens is None else {"": self.lens}

    def limited(self) -> "PictureData":
        """Returns the data with as many poses of training,
        and of the test of their materials, as the limit allows.
        """
        if self.limit is None:
            return self
        train = self.train[: self.limit.train]
        seen = {self.poses[name].material for name in train}
        test = tuple(name for name in self.test if self.poses[name].material in seen)[
            : self.limit.test
        ]
        poses = {name: pose for name, pose in self.poses.items() if name in (*train, *test)}
        return self.model_copy(update={"train": train, "test": test, "poses": poses})
