"""Compares the recording of a released beam with a simulation of the beam with data-sheet material.

The recording is registered to the frame of the simulated body, in which the clamped face lies in x = 0 and gravity
points along -z. Arrays are in metres; T frames or steps, M markers, N vertices.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..data.oscillation import Oscillation, measure_oscillation
from ..data.recordings.processing import fill_gaps, trim_to_release
from ..data.recordings.quality import check_motion, check_passive
from ..data.recordings.reading import read_recording
from ..data.recordings.recording import Recording
from ..data.recordings.release import Release, find_release
from ..data.rigid import kabsch, root_mean_square
from ..dynamics.nonlinear_solver import SolverName
from ..dynamics.simulator import Simulator
from ..experiment.build import build_material
from ..fem.body import Body, PointMass
from ..fem.elements import VolumeIntegration
from ..io.atomic import atomic_path
from ..io.errors import DataFileError, InputError
from ..io.files import write_json
from ..io.settings import Count, NotNegative, Positive, Settings, Some, Vector, Word, setting
from ..mesh.mesh import box_hexahedra, select_vertices
from ..report.figures import STYLE, TONES, save_png
from ..settings.body import Integrator, MaterialSettings
from .beam import Divisions
from .tables import aligned

FloatArray = NDArray[np.float64]

_MILLI: Final = 1e3
_CLOSE_UP_SECONDS: Final = 1.4
_HELD_FRAMES: Final = 20  # before a configured release, from which the rest position is taken
_LINES: Final[Mapping[str, dict[str, Any]]] = {
    "measured": {"color": TONES["ink"].light, "linestyle": "none", "marker": "o", "markersize": 2.0},
    "simulated": {"color": TONES["simulation"].light, "linewidth": 1.3},
}
# Keys of comparison.json and factors of their units, by attribute of an oscillation.
_NUMBERS: Final[Mapping[str, tuple[str, float]]] = {
    "sag": ("sag_mm", _MILLI),
    "period": ("period_s", 1.0),
    "decay_rate": ("decay_rate_per_s", 1.0),
    "damping_ratio": ("damping_ratio", 1.0),
    "tail_spread": ("tail_spread_mm", _MILLI),
    "fit_residual": ("fit_residual_mm", _MILLI),
}
_COMPARED: Final = {"sag [mm]": "sag", "period [s]": "period", "decay [1/s]": "decay_rate"}


class NominalMarker(Settings):
    """A marker and its nominal position in the frame of the body."""

    name: Word
    position: Vector = setting(unit="m")


class NominalMarkers(Settings):
    """Markers of the tip and of the clamp."""

    tip: Some[NominalMarker]
    base: Some[NominalMarker]


class RegistrationSettings(Settings):
    """Tolerances of the registration to the nominal markers."""

    longest_gap: Count = setting(description="frames of an occlusion that are interpolated")
    largest_residual: NotNegative = setting(description="root mean square of the registration", unit="m")


class BeamSettings(Settings):
    """The box that is simulated."""

    size: Vector = setting(unit="m")
    divisions: Divisions
    mass: Literal["row_sum", "per_vertex"]
    volume_integration: VolumeIntegration


class SwingSimulation(Settings):
    """Settings of the simulated swing."""

    time_step: Positive = setting(unit="s")
    integrator: Integrator
    solver: SolverName
    relative_tolerance: Positive
    gravity: Positive = setting(unit="m/s^2")
    device: Word


class WindowSettings(Settings):
    """Time spans from which results are computed."""

    fit_seconds: Positive = setting(unit="s")
    tail_seconds: Positive = setting(unit="s")
    error_seconds: Positive = setting(unit="s")


class SwingRecording(Settings):
    """The group ``recording``: a file, and the weight that hung on the beam."""

    name: Word
    title: Word
    path: Word | None
    hung_weight: NotNegative = setting(unit="N")
    release_frame: float | None


class ComparisonSettings(Settings):
    """The configuration ``inspect_compare``, which explains its keys."""

    markers: NominalMarkers
    registration: RegistrationSettings
    body: BeamSettings
    material: MaterialSettings
    simulation: SwingSimulation
    comparison: WindowSettings
    recording: SwingRecording


@dataclasses.dataclass(frozen=True)
class Swing:
    """Motion of the tip markers of a beam after its release."""

    time: FloatArray  # (T,) [s] since the release
    displacement: FloatArray  # (T, M, 3) [m] from the positions while the beam was held straight

    @property
    def deflection(self) -> FloatArray:
        """Mean displacement (T,) of the markers along z [m]; negative is down."""
        return self.displacement[:, :, 2].mean(axis=1)

    @property
    def rate(self) -> float:
        """Samples a second [Hz]."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])


@dataclasses.dataclass(frozen=True)
class MeasuredSwing(Swing):
    """The swing of a recording."""

    rest_markers: FloatArray  # (M, 3) [m] tip markers while the beam was held, in the frame of the body
    release: Release  # in frames of the recording
    registration_residual: float  # [m] root mean square distance of measured from nominal markers at rest


def measured_swing(recording: Recording, settings: ComparisonSettings) -> MeasuredSwing:
    """Finds the release, registers the recording by its markers at rest, and follows the tip after the release.

    Raises:
        ResphysError: a marker is missing or occluded for too long, no release is found, or the markers do not fit.
    """
    tip, base, registration = settings.markers.tip, settings.markers.base, settings.registration
    markers, release_frame = [*tip, *base], settings.recording.release_frame
    nominal = np.array([marker.position for marker in markers])
    recording = fill_gaps(recording.select([marker.name for marker in markers]), registration.longest_gap)
    positions = recording.positions
    if release_frame is None:
        release = find_release(positions[:, : len(tip)].mean(axis=1), recording.rate, source=recording.source)
    elif 1.0 <= release_frame < len(positions) - 1:
        release = Release(release_frame, (max(0, int(release_frame) - _HELD_FRAMES), int(release_frame)))
    else:
        raise InputError(
            f"recording.release_frame is {release_frame:g}: set it to one of the {len(positions)} frames recorded."
        )
    held = np.median(positions[slice(*release.rest)], axis=0)
    motion = kabsch(held, nominal)
    residual = root_mean_square(motion.apply(held) - nominal)
    if residual > registration.largest_residual:
        raise DataFileError(
            f"{recording.source}: the markers at rest are {1e3 * residual:.1f} mm (root mean square) off their nominal "
            f"positions, more than {1e3 * registration.largest_residual:.1f} mm; check the configured names and "
            "positions."
        )
    rest_markers = motion.apply(held)[: len(tip)]
    swing = trim_to_release(recording, release)
    displacement = motion.apply(swing.positions)[:, : len(tip)] - rest_markers
    time = swing.start + np.arange(len(displacement)) / recording.rate
    return MeasuredSwing(time, displacement, rest_markers, release, residual)


def follow_face(face: FloatArray, rest_face: FloatArray, markers: FloatArray) -> FloatArray:
    """Displacement (T, M, 3) [m] of markers on stems that follow the rigid motion of a face.

    Args:
        face: (T, S, 3) [m] vertices of the face over time.
        rest_face: (S, 3) [m] vertices of the face at rest.
        markers: (M, 3) [m] at rest.
    """
    return kabsch(np.broadcast_to(rest_face, face.shape), face).apply(markers) - markers


def marker_error(measured: Swing, simulated: Swing, seconds: float) -> float:
    """Mean distance [m] between simulated and measured markers over the measured frames of the first seconds."""
    inside = measured.time <= min(seconds, simulated.time[-1])
    at_frames = CubicSpline(simulated.time, simulated.displacement)(measured.time[inside])
    return float(np.linalg.norm(at_frames - measured.displacement[inside], axis=-1).mean())


def simulate_swing(settings: ComparisonSettings, rest_markers: FloatArray, seconds: float) -> Swing:
    """Simulates the beam, released straight and at rest, for some seconds and follows its markers (M, 3) [m].

    Raises:
        ResphysError: a value in the configuration cannot be simulated, or a step did not converge.
    """
    shape, simulation = settings.body, settings.simulation
    length, _, height = shape.size
    mesh = box_hexahedra(shape.size, shape.divisions)
    mass = settings.recording.hung_weight / simulation.gravity
    weights = [PointMass(mass, select_vertices(mesh, x=length, z=height).tolist())] if mass > 0.0 else []
    body = Body(
        mesh,
        fixed=select_vertices(mesh, x=0.0),
        mass=shape.mass,
        volume_integration=shape.volume_integration,
        point_masses=weights,
    )
    simulator = Simulator(
        body,
        build_material(settings.material, "material"),
        **{**simulation.plain(), "gravity": (0.0, 0.0, -simulation.gravity)},
    )
    steps = int(np.ceil(seconds / simulation.time_step))
    with torch.no_grad():
        positions = simulator.rollout(simulator.rest_state(), steps).q
    tip_face = select_vertices(mesh, x=length)
    face = positions[:, 0, tip_face].cpu().numpy().astype(np.float64)
    time = simulation.time_step * np.arange(steps + 1, dtype=np.float64)
    return Swing(time, follow_face(face, mesh.vertices[tip_face], rest_markers))


def compare(settings: ComparisonSettings, folder: Path) -> None:
    """Writes comparison.json and comparison.png into the run folder and prints the results."""
    print(aligned(comparison_table(compare_recording(settings, folder))))
    print(f"Written: {folder / 'comparison.json'}, {folder / 'comparison.png'}")


def comparison_table(result: Mapping[str, Any]) -> list[list[str]]:
    """Rows with sag, period and decay of both swings and their relative difference, from comparison.json."""
    rows = [["", *_LINES, "difference"]]
    for label, number in _COMPARED.items():
        values = [f"{result[name][_NUMBERS[number][0]]:.4g}" for name in _LINES]
        rows.append([label, *values, f"{result['relative_difference'][number]:+.1%}"])
    return rows


def compare_recording(settings: ComparisonSettings, folder: Path) -> dict[str, Any]:
    """Measures and simulates a swing, writes comparison.json and comparison.png, and returns comparison.json.

    Raises:
        ResphysError: the recording cannot be used, a step of the simulation did not converge, or a file cannot be
            written.
    """
    path, markers, windows = settings.recording.path, settings.markers, settings.comparison
    if path is None:
        raise InputError("No recording given: set recording.path to one, as in recording.path=swing.c3d.")
    recording = read_recording(path)
    check_passive(recording)
    check_motion(recording, [marker.name for marker in markers.tip])
    measured = measured_swing(recording, settings)
    simulated = simulate_swing(settings, measured.rest_markers, float(measured.time[-1]))
    oscillations = {
        name: measure_oscillation(swing.deflection, swing.rate, window=windows.fit_seconds, tail=windows.tail_seconds)
        for name, swing in (("measured", measured), ("simulated", simulated))
    }
    error = marker_error(measured, simulated, windows.error_seconds)
    result = _summary(measured, oscillations, error) | {"config": settings.plain()}
    figure = draw_comparison(measured, simulated, result)
    write_json(folder / "comparison.json", result)
    with atomic_path(folder / "comparison.png") as partial:
        save_png(figure, partial)
    return result


def draw_comparison(measured: Swing, simulated: Swing, result: Mapping[str, Any]) -> Figure:
    """Draws the deflection of the tip over time, the results of comparison.json beside it, and each marker below."""
    labels = [marker["name"] for marker in result["config"]["markers"]["tip"]]
    swings = {"measured": measured, "simulated": simulated}
    with rc_context(STYLE):
        figure = Figure(figsize=(10.0, 6.2), layout="constrained")
        rows = figure.add_gridspec(2, 1, height_ratios=[1.5, 1.0])
        top = rows[0].subgridspec(1, 2, width_ratios=[2.2, 1.0])
        whole, numbers = figure.add_subplot(top[0]), figure.add_subplot(top[1])
        panels = rows[1].subgridspec(1, len(labels)).subplots(sharey=True, squeeze=False)[0]
        for name, swing in swings.items():
            whole.plot(swing.time, _MILLI * swing.deflection, label=name, **_LINES[name])
            whole.axhline(result[name]["sag_mm"], color=_LINES[name]["color"], linewidth=0.7, linestyle=":")
            for marker, axes in enumerate(panels):
                axes.plot(swing.time, _MILLI * swing.displacement[:, marker, 2], **_LINES[name])
        whole.set(xlabel="time since release [s]", ylabel="deflection, mean of the tip markers [mm]")
        whole.set_xlim(0.0, measured.time[-1])
        whole.set_title(result["config"]["recording"]["title"], fontsize=11, fontweight="bold")
        whole.legend(loc="lower right", ncols=2)
        for axes, label in zip(panels, labels, strict=True):
            axes.set(xlabel="time since release [s]", xlim=(0.0, min(_CLOSE_UP_SECONDS, measured.time[-1])))
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.set_title(label)
        panels[0].set_ylabel("vertical displacement [mm]")
        numbers.set_axis_off()
        table = numbers.table(
            comparison_table(result), loc="upper left", edges="open", bbox=Bbox.from_bounds(0.0, 0.6, 1.2, 0.35)
        )
        table.auto_set_font_size(False)
        numbers.text(0.0, 0.5, _notes(result), verticalalignment="top", fontsize=8, linespacing=1.5)
    return figure


def _notes(result: Mapping[str, Any]) -> str:
    seconds = result["config"]["comparison"]["error_seconds"]
    return (
        f"Tip markers {result['marker_error_mm']:.2f} mm apart on average in the first {seconds:g} s.\n"
        f"Released in frame {result['release_frame']:.1f}; registered to nominal markers\n"
        f"with {result['registration_residual_mm']:.2f} mm left (root mean square)."
    )


def _summary(measured: MeasuredSwing, oscillations: Mapping[str, Oscillation], error: float) -> dict[str, Any]:
    """Content of comparison.json in millimetres and seconds; relative differences are over the measured value."""
    return {
        "release_frame": measured.release.frame,
        "rest_frames": list(measured.release.rest),
        "registration_residual_mm": _MILLI * measured.registration_residual,
        **{
            name: {key: factor * getattr(oscillation, number) for number, (key, factor) in _NUMBERS.items()}
            for name, oscillation in oscillations.items()
        },
        "relative_difference": {
            name: getattr(oscillations["simulated"], name) / getattr(oscillations["measured"], name) - 1.0
            for name in ("sag", "period", "decay_rate", "damping_ratio")
        },
        "marker_error_mm": _MILLI * error,
    }
