"""A small experiment with control through its command line:
reduced models, plans, and who drives the laboratory.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
import torch

import warp_resphys
from support.command_line import sentence
from support.main_job import DRIVEN, IN_RUN, ROD, run, run_without_report
from support.refusals import refuses
from warp_resphys import Contact, HalfSpace, InputError, Twin
from warp_resphys.control import control_stages, sampling
from warp_resphys.control.control_files import (
    PLANNED,
    plans_file,
    read_motion,
    read_reduced,
    reduced_file,
)
from warp_resphys.control.control_stages import controllers_of, driven_settings, replay
from warp_resphys.control.controllers import Estimator
from warp_resphys.control.polynomials import SquaredPolynomial
from warp_resphys.control.reduction import reduce
from warp_resphys.control.task import Task
from warp_resphys.control.worlds import Laboratory, ReducedWorld
from warp_resphys.core.stepping.rollout import states
from warp_resphys.io.safe_files import read_array, read_hdf5
from warp_resphys.settings.control import ReductionSettings
from warp_resphys.studies.live_twin import TwinSettings
from warp_resphys.twin.reduced_estimator import ReducedEstimator

pytestmark = pytest.mark.slow
CONTROL = [
    "experiment=tendon_rod_control",
    *(*ROD, *DRIVEN, "data.steps=40", "mesh_check=null"),
    *("+simulation.prony_ratio_1=0.0", "+simulation.prony_time_1=0.05"),
    "+identify.parameters.tendon_tension_factor={lower:0.5,upper:1.5}",
    "+identify.parameters.tendon_tension_delay={lower:0.0,upper:0.05}",
    "+identify.parameters.tendon_tension_rise={lower:0.001,upper:0.1,logarithmic:true}",
    "+identify.first_guess={tendon_tension_factor:0.9,tendon_tension_delay:0.012,"
    "tendon_tension_rise:0.02}",
    "control.models=[sysid,resphys]",
    "control.shapes=[circle]",
    "control.seconds=[0.4]",
    "control.size=0.01",
    *("control.plan={corrections:2,reach:0.05}", "control.horizon=0.1"),
    *("control.feedback={gains:[5.0],settles:0.1}",),
    "control.reduction={modes:[1,4],equilibria:48,tangents:24,motions:3,seconds:2.0}",
    IN_RUN,
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One run for all tests of it, which are slow therefore; `test_pieces` takes its parts."""
    place = tmp_path_factory.mktemp("control")
    return run_without_report(place, *CONTROL)


@pytest.fixture(scope="module")
def robot(folder):
    return warp_resphys.load(folder, "resphys")


@pytest.fixture(scope="module")
def model(folder, robot):
    """The reduced model of the corrected simulator, with its network in float64."""
    learned = robot.description.learned
    range_ = learned.range_
    known = replace(learned, range_=type(range_)(range_.low.double(), range_.high.double()))
    known.network.double()
    yield read_reduced(folder / reduced_file("resphys"), known)
    learned.network.float()


def control_of(folder):
    """What controllers have followed."""
    return driven_settings(folder).control


def test_a_body_that_fails_or_begins_again_rests_and_the_other_goes_on(folder):
    laboratory = Laboratory(
        driven_settings(folder), folder, "tendon_tension", 2, seed=0, on_failure="count"
    )
    rest, commands = laboratory.markers(laboratory.rest), np.tile([1.0, 0.0, 0.0], (2, 1))
    state = laboratory.step(laboratory.rest, commands)
    assert not laboratory.lost(state).any()
    state = laboratory.rest.where(np.array([True, False]), state)
    np.testing.assert_array_equal(laboratory.markers(state)[0], rest[0])
    assert np.abs(laboratory.markers(state)[1] - rest[1]).max() > 1e-5
    state = laboratory.step(state, commands)
    assert not laboratory.lost(state).any()
    moved = np.abs(laboratory.markers(state) - rest).max((1, 2))
    assert 0.0 < moved[0] < moved[1]
    seen = laboratory.seen(state, 3)
    np.testing.assert_array_equal(laboratory.seen(state, 3), seen)
    assert 0.0 < np.abs(seen - laboratory.markers(state)).max() < 10.0 * laboratory.noise


def test_a_reduced_world_moves_as_the_model_does_and_a_failure_lasts_until_it_begins(model):
    world = ReducedWorld(model, 2)
    rest, commands = world.markers(world.rest), np.array([[0.4, 0.0, 0.0], [0.0, 0.3, 0.0]])
    *_, state = states(world.step, world.rest, [commands] * 4)
    assert not world.lost(state).any()
    for row in range(2):
        expected = model.respond(model.rest(), np.tile(commands[row], (4, 1, 1)))[-1, 0]
        np.testing.assert_allclose(world.markers(state)[row].ravel(), expected, atol=1e-9)
    assert np.abs(world.markers(state) - rest).max() > 1e-4
    furthest, world._furthest = world._furthest, 0.0
    failed = world.step(state, commands)
    assert world.lost(failed).all()
    world._furthest = furthest
    still = world.step(failed, commands)
    assert world.lost(still).all()
    np.testing.assert_array_equal(world.markers(still), rest)
    again = world.step(world.rest.where(np.array([True, False]), still), commands)
    assert world.lost(again).tolist() == [False, True]


class TestReducedModel:
    def test_it_moves_as_the_identified_robot_does(self, folder):
        """On motions that no part of it was fitted to."""
        quality = read_reduced(folder / reduced_file("sysid"), None).quality
        assert quality["window_motion_mm"] > 1.0
        assert quality["window_relative"] < 0.05

    def test_of_several_numbers_of_modes_the_best_is_taken(self, folder):
        """Of one, one of a pair of vibrations of a round rod is missing."""
        quality = read_reduced(folder / reduced_file("sysid"), None).quality
        assert quality["modes"] == 4
        assert list(quality["tried"]) == ["1", "4"]
        assert quality["window_relative"] == quality["tried"]["4"] < 0.5 * quality["tried"]["1"]

    def test_a_material_that_relaxes_keeps_its_branches(self, folder):
        """Small vibrations after a push are those of the full robot,
        and others without the branches.
        """
        robot = warp_resphys.load(folder, "sysid").with_parameters(prony_ratio_1=1.5)
        model = reduce(
            robot, ReductionSettings(modes=(4,), equilibria=20, tangents=20, motions=2, seconds=0.4)
        )
        assert model.times == (0.05,)
        start, speed = robot.begin(), 1e-2 * model.basis[:, 0].reshape(1, -1, 3)
        pushed = replace(start, v=robot.simulator.tensor(speed))
        q = robot.rollout(pushed, 30).q[:, 0].double().numpy()
        mass, shape = robot.constants.mass[0].double().numpy(), model.basis[:, 0].reshape(-1, 3)
        true = np.einsum("tni,n,ni->t", q[1:] - q[0], mass, shape)
        commands, rest = np.zeros((30, 1, 3)), model.rest()
        still = replace(rest, v=rest.v + 1e-2 * np.eye(4)[:1])
        elastic = replace(
            model,
            branches=SquaredPolynomial(0.0 * model.branches.coefficients, model.branches.order),
        )
        off, without = (
            np.linalg.norm((one.move(still, commands)[0] - rest.z)[:, 0, 0] - true)
            for one in (model, elastic)
        )
        assert off < 0.03 * np.linalg.norm(true)
        assert without > 0.2 * np.linalg.norm(true)

    def test_it_comes_to_rest_where_the_corrected_robot_does(self, robot, model):
        inputs = np.array([0.6, 0.0, 0.3])
        settled = robot.observe(robot.settle(1, tendon_tension=inputs)).flatten().numpy()
        hangs = robot.observe(robot.settle(1)).flatten().numpy()
        reduced = model.observe(model.rest(inputs))[0]
        assert np.linalg.norm(settled - hangs) > 5e-3
        assert np.linalg.norm(reduced - settled) < 0.05 * np.linalg.norm(settled - hangs)

    def test_the_estimator_recovers_state_and_bias(self, model):
        """From noiseless markers of the same model with shifted equilibria."""
        inputs, elsewhere = np.array([0.5, 0.2, 0.9]), np.array([2e-4, -1e-4, 5e-5, 0.0])
        estimator = Estimator(model, inputs, noise=1e-6)
        state = model.rest(inputs)
        for _ in range(150):
            state = model.transition(state, inputs, elsewhere[None])[0]
            estimator.predict(inputs)
            estimator.correct(model.observe(state)[0].reshape(-1, 3))
        np.testing.assert_allclose(estimator.state.z, state.z, atol=2e-6)
        np.testing.assert_allclose(estimator.bias, elsewhere, atol=2e-5)

    def test_friction_a_medium_obstacles_and_data_driven_robots_are_refused(
        self, robot, monkeypatch, folder
    ):
        sampling.check_reducible(robot)
        monkeypatch.setattr(sampling, "_OF_MEDIUM", ("density",))
        refuses(InputError, "density is no stiffness", sampling.check_reducible, robot)
        monkeypatch.setattr(sampling, "_OF_MEDIUM", ())
        body, energies = robot.simulator.body, robot.simulator.body.energies
        monkeypatch.setitem(
            vars(body), "energies", [*energies, Contact({"floor": HalfSpace(position=(0, 0, -9))})]
        )
        refuses(InputError, "in contact cannot be reduced", sampling.check_reducible, robot)
        monkeypatch.setitem(vars(body), "energies", [*energies, SimpleNamespace(memory=("slide",))])
        refuses(InputError, "with memory", sampling.check_reducible, robot)
        refuses(
            InputError,
            "no stiffness",
            reduce,
            warp_resphys.load(folder, "simfree"),
            ReductionSettings(),
        )

    def test_a_path_out_of_reach_is_named_with_the_nearest_point(self, folder, model, robot):
        far = control_of(folder).changed(centre=[0.0, 0.0, -0.35])
        task = Task(far, robot)
        refuses(
            InputError, r"path circle: .*-350.0\) mm is .* mm away", task.check_reach, model, 1e-3
        )


class TestReducedTwin:
    """A twin on the reduced model follows the full robot, from a state that it was not given."""

    noise, commands = 1e-4, (0.3, 0.0, 0.1)

    @pytest.fixture(scope="class")
    @classmethod
    def corrected(cls, folder):
        return warp_resphys.load(folder, "resphys")

    @pytest.fixture(scope="class")
    @classmethod
    def swing(cls, corrected):
        """Markers (T + 1, M, 3) of the robot, let go from a push
        while its tendons are commanded.
        """
        rest = corrected.simulator.rest_positions
        push = (
            0.02
            * torch.tensor([0.6, 0.8, 0.0]).to(rest)
            * (rest[:, 2:] < rest[:, 2].mean())
            / len(rest)
        )
        start = corrected.settle(tendon_tension=cls.commands, external_force=push)
        motion = corrected.rollout(start, 60, tendon_tension=cls.commands).markers[:, 0].numpy()
        return motion + cls.noise * np.random.default_rng(0).standard_normal(motion.shape)

    def test_it_looks_ahead(self, corrected, swing):
        twin = Twin(corrected, "reduced", horizon=0.1, noise=self.noise)
        for number, frame in enumerate(swing):
            twin.take(number * corrected.time_step, frame, tendon_tension=self.commands)
            if number > 10:
                twin.ahead()
        off, now = twin.disagreement, twin.now
        assert off.predictions == 40
        assert off.twin < 0.3 * off.held
        assert off.twin < 0.5 * off.simulator
        seen, last = corrected.observe(now.state)[0].numpy(), len(swing) * corrected.time_step
        places = twin._belief_at(twin._update()).places
        assert np.abs(seen + places - now.markers).max() < 1e-3
        stepped = corrected.observe(corrected.step(now.state, tendon_tension=self.commands))[
            0
        ].numpy()
        twin.take(last, tendon_tension=self.commands)
        moved = np.abs(twin.now.markers - now.markers).max()
        assert np.abs(stepped - seen - (twin.now.markers - now.markers)).max() < 0.6 * moved

    def test_it_is_a_setting(self, folder):
        settings = TwinSettings(
            horizon=0.1,
            patience=0.3,
            align=False,
            refine={},
            noise=2e-4,
            planned=True,
            engine="reduced",
        )
        twin = settings.twin(warp_resphys.load(folder, "resphys"))
        assert isinstance(twin.estimator, ReducedEstimator)
        assert (
            ", resphys, by its reduced model: steps of 10 ms, predictions 0.1 s ahead, no packet "
            "yet" in repr(twin)
        )
        with pytest.raises(InputError, match="no youngs_modulus to refine"):
            settings.changed(refine={"youngs_modulus": 1e3}).twin(twin.estimator.robot)
        with pytest.raises(
            InputError, match=r"robot is '.*': give the robot of a run, as warp_resphys\.load"
        ):
            Twin(str(folder), "reduced")


class TestPlans:
    def test_plans_stay_within_bounds_and_rates(self, folder):
        plan = read_motion(folder / plans_file("resphys"), PLANNED, "circle_0.4s")
        limits = control_of(folder).limits
        assert plan["inputs"].min() > limits.low - 1e-3
        assert plan["inputs"].max() < limits.high + 1e-3
        assert plan["inputs"].max() > 0.1
        steps = np.abs(np.diff(plan["inputs"], axis=0, prepend=0.0))
        assert steps.max() < 1.01 * limits.rate * 0.01

    def test_corrections_by_the_simulator_bring_it_closer(self, folder):
        errors = read_motion(folder / plans_file("resphys"), PLANNED, "circle_0.4s")["errors_mm"]
        assert len(errors) == 3
        assert errors.min() < 0.7 * errors[0]


class TestDriving:
    def test_all_controllers_drive_and_are_measured(self, folder):
        tracking = json.loads((folder / "control.json").read_text())["tracking"]["0.4"]
        names = ["open_sysid", "open_resphys", "receding_resphys", "receding_linear", "feedback_5"]
        assert list(tracking) == controllers_of(control_of(folder)) == names
        with read_hdf5(folder / "driven.h5", "driven") as file:
            path, points, inputs = (
                read_array(file, f"circle_0.4s/{key}") for key in ("path", "points", "inputs")
            )
        for row, name in enumerate(names):
            wanted = 1e3 * np.linalg.norm(points[row] - path, axis=1).mean()
            assert tracking[name]["mean_mm"] == pytest.approx(wanted)
            assert np.ptp(points[row], axis=0).max() > 1e-3
        plan = read_motion(folder / plans_file("resphys"), PLANNED, "circle_0.4s")
        np.testing.assert_allclose(inputs[1], plan["inputs"])

    def test_a_replay_repeats_the_motion(self, folder):
        names = ["receding_resphys", "feedback_5"]
        replayed = replay(folder, "circle_0.4s", names)
        with read_hdf5(folder / "driven.h5", "driven") as file:
            path, points = (read_array(file, f"circle_0.4s/{key}") for key in ("path", "points"))
        tips = np.stack([*replayed.points.values()])
        np.testing.assert_allclose(tips[:, 1:], points[[2, 4]], atol=1e-6)
        np.testing.assert_allclose(replayed.path, path)
        assert replayed.times == pytest.approx(0.01 * np.arange(len(path) + 1))
        bodies = np.stack([*replayed.positions.values()])
        assert bodies.shape[:2] == (2, len(path) + 1)
        assert replayed.triangles.max() < bodies.shape[2]
        tip = np.linalg.norm(bodies - tips[:, :, None], axis=3).min(axis=2)
        assert tip.max() < 0.01  # The markers move with the body.
        assert len(replay(folder, "circle_0.4s", names[:1], 0.05).times) == 6

    def test_a_film_of_it_is_a_command(self, folder, tmp_path, can_draw):
        place = f"file={tmp_path / 'film.mp4'}"
        code, err = run("view", "film", f"run={folder}", "motion=circle_0.4s", place, "seconds=0.1")
        assert code == 0, err
        header = next(imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4")))
        assert header["size"] == (1120, 480)  # Open loop on SysID and on ResPhys, side by side.
        assert header["duration"] == pytest.approx(0.12, abs=0.05)

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (["motion=square_1s"], "motion names square_1s"),
            (["motion=circle_0.4s", "controllers=[me]"], "controllers names me"),
            (["motion=circle_0.4s", "controllers=[a,b,c,d]"], "controllers names 4"),
            (
                ["motion=circle_0.4s", "trial=t000"],
                "trial is for films of trials, and motion for films of control: ",
            ),
            (["controllers=[open_sysid]"], "controllers drive motions"),
        ],
    )
    def test_invalid_options_of_a_film_are_refused(self, folder, change, said):
        assert said in sentence("view", "film", f"run={folder}", *change)

    def test_a_new_horizon_drives_again_but_plans_nothing_again(
        self, folder, monkeypatch, no_report
    ):
        monkeypatch.chdir(folder.parent)
        record = folder / "stages" / "plan_resphys.json"
        before, driven = record.stat().st_mtime_ns, []

        def stop(context, workers=None):
            driven.append(context.name)
            raise InputError("stopped.")

        monkeypatch.setattr(control_stages, "drive", stop)
        code, err = run(*CONTROL, "control.horizon=0.2")
        assert code != 0
        assert "stopped." in err
        assert record.stat().st_mtime_ns == before
        assert driven == ["drive"]
