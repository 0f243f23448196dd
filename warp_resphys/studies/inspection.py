"""Settings of the commands that inspect meshes and recordings and make arms."""

from typing import Any

from ..io.settings import Count, Many, NotNegative, Positive, Settings, Word, setting


class RecordingFile(Settings):
    """A recording, and what its file does not say or says wrongly."""

    path: Word | None = None
    units: Word | None = None
    rate: Positive | None = setting(None, unit="Hz")
    labels: Many[Word] | None = None


class Inspection(Settings):
    """What `warp-resphys inspect` looks at; conf/inspect.yaml describes the keys."""

    files: Many[Word]
    mesh: dict[str, Any] = setting(description="a group of conf/mesh")
    fixed: dict[str, Any] = setting(description="vertices that are counted: x, y, z and tolerance", unit="m")
    density: Positive = setting(unit="kg/m^3")
    picture: bool
    recording: RecordingFile
    still: Many[Word]
    moving: Many[Word]
    compare_with: Many[Word]
    longest_gap: Count
    least_jump: NotNegative = setting(unit="m")
    largest_distortion: NotNegative = setting(unit="m")


class Arm(Settings):
    """An arm that `warp-resphys inspect make-arm` makes."""

    file: Word
    density: Positive = setting(unit="kg/m^3")
    picture: bool
    mesh: dict[str, Any] = setting(description="the group conf/mesh/arm_generated.yaml")
