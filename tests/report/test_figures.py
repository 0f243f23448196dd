"""Figures: what is drawn where, in which colours, and what does not set the scale."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.core.energies.pressure import PRESSURE
from warp_resphys.core.mesh.boxes import box_hexahedra
from warp_resphys.report import figures
from warp_resphys.report.body_section import body_section, input_sequences, marker_paths
from warp_resphys.report.control_section import followed_paths
from warp_resphys.report.data import Driven, FollowedPath, TrialResults
from warp_resphys.report.error_section import error_over_time, training_curves
from warp_resphys.report.figures import CHAMBER_COLOURS, use_logarithm
from warp_resphys.report.identification_section import loss_histories
from warp_resphys.report.wording import MODELS, TONES

TIMES = np.arange(20) * 0.01
MEASURED = np.zeros((20, 1, 3))
MEASURED[:, 0, 2] = 0.01 * np.sin(30.0 * TIMES)
CANVAS = SimpleNamespace(
    figure=lambda name, figure, alt, caption: figure, rendered=lambda *arguments: None
)


def trials_of(target, positions, times=TIMES, labels=("A",)):
    """One trial of some models, whose markers begin at zero."""
    shown = {model: q[None] for model, q in positions.items()}
    zeros = np.zeros(target.shape[1:])
    return TrialResults(
        ("a",), labels, ("released",), times[None], target[None], shown, zeros, zeros, 0.01
    )


def paths_of(positions, target=MEASURED, times=TIMES, bands=(), driven=None):
    trials = trials_of(target, positions, times)
    return marker_paths(trials, 0, [0], [*positions], trials.bound, dict(bands), driven)


@pytest.mark.parametrize(
    ("errors", "labels"),
    [
        ((0.3, 6.0), ["0.5", "1", "2", "5"]),
        ((2.0, 3.0), ["2", "5"]),
        ((1e-3, 50.0), ["0.001", "0.01", "0.1", "1", "10"]),
        ((1.2e-5, 9e-5), ["2·10⁻⁵", "5·10⁻⁵"]),
    ],
)
def test_a_logarithmic_axis_has_enough_labels(errors, labels):
    axes = Figure().subplots()
    axes.plot(errors)
    use_logarithm(axes)
    axes.figure.canvas.draw()
    low, high = axes.get_ylim()
    inside = [
        tick.get_text() for tick in axes.get_yticklabels() if low <= tick.get_position()[1] <= high
    ]
    assert inside == labels


def test_none_of_the_lines_of_models_that_agree_hides_another():
    still = np.zeros((20, 1, 3))
    figure = paths_of({model: still for model in ("regression", "sysid", "resphys")})
    for axes in figure.axes:
        lines = {line.get_label(): line for line in axes.lines}
        for label in ("Regression", "SysID"):  # dashed, over the thicker line of ResPhys
            assert lines[label].get_linestyle() == "--"
            assert lines[label].get_zorder() > lines["ResPhys"].get_zorder()
            assert lines[label].get_linewidth() < lines["ResPhys"].get_linewidth()


def test_the_tip_is_the_mean_of_its_vertices():
    target = np.arange(2.0 * 4 * 3).reshape(2, 4, 3)
    trials = trials_of(target, {"resphys": -target}, labels=()).of_tip(np.array([1, 3]))
    assert trials.labels == ("tip",)
    np.testing.assert_array_equal(trials.target[0], target[:, [1, 3]].mean(axis=1, keepdims=True))
    np.testing.assert_array_equal(trials.positions["resphys"], -trials.target)
    assert trials.bound.shape == (1, 3)


class TestErrors:
    def test_a_model_without_error_does_not_hide_the_others(self):
        rows = np.full((2, 5), 0.5)
        (axes,) = error_over_time(
            {"simulation": rows, "resphys": 0.0 * rows}, 0.01 * np.arange(5)
        ).axes
        low, high = axes.get_ylim()
        assert axes.get_yscale() == "log"
        assert low <= 0.5 <= high
        assert not axes.texts

    def test_lines_are_filtered_and_thin_behind(self):
        rows, times = np.ones((2, 200)), 0.01 * np.arange(200)
        rows[:, 100:110] = 9.0
        rows[1, 180:] = np.inf
        (axes,) = error_over_time({"resphys": rows}, times, window=1.0).axes
        thin, thick = axes.lines
        assert thin.get_linewidth() < 1.0 < thick.get_linewidth()
        assert np.nanmax(thin.get_ydata()) == 9.0
        assert np.nanmax(thick.get_ydata()) == 1.0
        np.testing.assert_allclose(thick.get_xdata()[[0, -1]], [0.0, 1.99])
        assert np.isnan(thin.get_ydata()[180:]).all()
        (axes,) = error_over_time({"resphys": rows}, times).axes
        (only,) = axes.lines
        assert np.nanmax(only.get_ydata()) == 9.0

    def test_lines_end_where_a_trial_diverged(self):
        rows = np.array([[1.0, 1.0, 1.0], [3.0, np.nan, np.inf]])
        (line,) = error_over_time({"resphys": rows}, np.arange(1.0, 4.0)).axes[0].lines
        np.testing.assert_allclose(line.get_ydata(), [2.0, 1.0, np.nan])


def test_one_epoch_is_seen_and_named_by_a_whole_number_and_the_start_that_was_kept_is_bold():
    record = {"epoch": 1, "train_loss": 3e-5, "validation_loss": 1.5e-4, "learning_rate": 1e-3}
    losses, rate = training_curves([record]).axes
    assert all(line.get_marker() == "." for line in (*losses.lines, *rate.lines))
    low, high = rate.get_xlim()
    assert [tick for tick in rate.get_xticks() if low <= tick <= high] == [1.0]
    histories = {
        "sysid": [[{"loss": 1.0}, {"loss": 3.0}, {"loss": 0.5}], [{"loss": 2.0}, {"loss": 0.1}], []]
    }
    (axes,) = loss_histories(histories).axes
    assert [line.get_color() for line in axes.lines] == [TONES["muted"].light, TONES["sysid"].light]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [1.0, 1.0, 0.5])


class TestMotion:
    def test_a_model_that_runs_away_does_not_set_the_scale(self):
        wild = MEASURED + np.exp(50.0 * TIMES)[:, None, None]
        figure = paths_of({"resphys": wild})
        spans = [np.ptp(axes.get_ylim()) for axes in figure.axes[:3]]
        assert spans[2] < 50.0
        assert 0.05 * np.ptp(MEASURED[..., 2]) * 1e3 < spans[1] < 5.0  # [mm]

    def test_prediction_intervals_are_bands_around_their_model(self):
        shown = {"sysid": 1.2 * MEASURED, "resphys": 1.1 * MEASURED}
        widths = {"resphys": np.linspace(1e-3, 3e-3, 20)[:, None]}
        figure = paths_of(shown, bands=widths)
        (axes,) = figure.axes  # Nothing moves along x and y.
        (band,) = axes.collections
        corners = band.get_paths()[0].vertices
        for time, middle, width in zip(
            TIMES, 1.1 * MEASURED[:, 0, 2], widths["resphys"][:, 0], strict=True
        ):
            reached = corners[np.isclose(corners[:, 0], time), 1]
            assert [reached.min(), reached.max()] == pytest.approx(
                [1e3 * (middle - width), 1e3 * (middle + width)]
            )

    def test_markers_stand_over_the_pressures(self):
        times = 0.1 * np.arange(4)
        moved = np.repeat(np.array([0.0, 1e-3, 2e-3, 3e-3])[:, None, None], 3, axis=2)
        driven = Driven(PRESSURE, ("chamber_1",), {"a": np.full((3, 1), 5e3)})
        figure = paths_of({"resphys": moved}, moved, times, driven=driven)
        coordinates, inputs = figure.axes[:3], figure.axes[3:]
        assert len(inputs) == 3
        assert all(
            axes.get_xlim() == below.get_xlim()
            for axes, below in zip(coordinates, inputs, strict=True)
        )
        measured_line, model_line = coordinates[2].lines
        np.testing.assert_allclose(measured_line.get_ydata(), [0.0, 1.0, 2.0, 3.0], atol=1e-12)
        assert model_line.get_color() == TONES["resphys"].light
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["chamber 1"]


class TestInputs:
    def figures_of(self, driven, *tested):
        """Figures of the section on the inputs."""
        trials = SimpleNamespace(names=tested, time_step=0.5, labels=())
        mesh = box_hexahedra(divisions=(1, 1, 1))
        shape = {
            "mesh": mesh,
            "fixed": [],
            "chambers": (),
            "tendons": {},
            "obstacles": ObstacleSurface(),
        }
        return body_section(SimpleNamespace(trials=trials, driven=driven, **shape), CANVAS).blocks[
            1:
        ]

    def test_pressures_are_in_kilopascal_in_the_chambers_colours(self):
        pressure = np.array([[0.0, 1e3], [2e4, 3e3]])
        driven = Driven(PRESSURE, ("one", "two"), {"a": pressure, "b": 2 * pressure}, 2e4)
        (figure,) = self.figures_of(driven, "b")
        first, second = figure.axes
        assert second.get_xlim() == (0.0, 1.0)
        assert [line.get_ydata()[0] for line in first.lines] == [20.0]
        np.testing.assert_allclose(first.patches[1].get_data().values, [1.0, 3.0])
        np.testing.assert_allclose(first.patches[1].get_data().edges, [0.0, 0.5, 1.0])
        assert [text.get_text() for text in figure.legends[0].get_texts()] == [
            "one",
            "two",
            "limit",
        ]
        assert [line.get_color() for line in figure.legends[0].get_lines()[:2]] == list(
            CHAMBER_COLOURS[:2]
        )

    def test_those_of_poses_are_bars_of_the_chambers_in_use_and_not_drawn_over_time(self):
        poses = {
            "a": np.array([[9e3, 0.0, 1e3]]),
            "b": np.array([[0.0, 0.0, 0.0], [3e3, 0.0, 5e3]]),
        }
        (figure,) = self.figures_of(
            Driven(PRESSURE, ("one", "two", "three"), poses, 2e4, poses=("a", "b")), "b"
        )
        (axes,) = figure.axes
        assert axes.get_xlabel() == "pressure [kPa]"
        assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "b (test)"]
        assert [bar.get_width() for bar in axes.patches] == [9.0, 3.0, 1.0, 5.0]
        assert [text.get_text() for text in figure.legends[0].get_texts()] == [
            "one",
            "three",
            "limit",
        ]
        assert [line.get_xdata()[0] for line in axes.lines] == [20.0]
        rows, trials = np.ones((3, 1)), SimpleNamespace(names=("b", "q"))
        driven = Driven(
            PRESSURE, ("one",), {"p": rows, "a": rows, "b": rows, "q": rows}, poses=("p", "q")
        )
        assert list(input_sequences(driven, trials)) == [
            "a, a trial of the training",
            "b, a test trial",
        ]
        assert input_sequences(replace(driven, poses=tuple("pabq")), trials) == {}


def test_followed_paths_are_drawn_in_their_plane():
    path = np.stack([np.linspace(0.0, 0.02, 5), np.zeros(5), np.linspace(0.0, 0.01, 5)], axis=1)
    paths = [
        FollowedPath(name=name, seconds=2.0, path=path, points={"open_sysid": 1.1 * path})
        for name in ("line", "bow")
    ]
    with figures.in_style():
        figure = followed_paths(paths, {"open_sysid": "SysID"}, np.eye(3)[[0, 2]])
    asked, driven = figure.axes[0].lines
    np.testing.assert_allclose(np.ptp(asked.get_xdata()), 20.0)  # [mm]
    np.testing.assert_allclose(np.ptp(driven.get_ydata()), 11.0)
    assert driven.get_color() == TONES["sysid"].light
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["line", "bow"]


# Colours as they look without each kind of cone, for linear RGB (Machado, Oliveira and Fernandes
# 2009, severity 1).
CONES = {
    "all": np.eye(3),
    "no long": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no middle": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no short": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour, cones):
    """CIELAB coordinates of a colour such as #1c2127, as it is seen."""
    linear = ((np.array(to_rgb(colour)) + 0.055) / 1.055) ** 2.4
    xyz = TO_XYZ @ np.clip(np.asarray(cones) @ linear, 0.0, 1.0)
    f = np.cbrt(xyz / TO_XYZ.sum(axis=1))
    return np.array([116.0 * f[1], 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_lines_of_models_differ_by_colour_or_dashes_also_with_colour_blindness(theme):
    def apart(one, other):
        colours = [getattr(TONES[model], theme) for model in (one, other)]
        return min(
            np.linalg.norm(lab(colours[0], cones) - lab(colours[1], cones))
            for cones in CONES.values()
        )

    solid = [
        model
        for model in MODELS
        if figures.model_line(model)["linestyle"] == "-" and model != "reconstruction"
    ]
    assert {"simulation", "law", "actuator", "resphys"} <= {*solid}
    assert {pair for pair in combinations(solid, 2) if apart(*pair) < 10.0} == set()
    assert {
        model for model in MODELS if model != "actuator" and apart("actuator", model) < 15.0
    } == set()
    assert apart("simulation", "actuator") > 30.0
