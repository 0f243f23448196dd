"""Gymnasium environments on small runs: seeds, resets in all modes,
refusals, and two fingers as a gripper.
"""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import warp_resphys
from support.refusals import refuses
from warp_resphys import InputError, Robot, State
from warp_resphys.control.worlds import World
from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.data.registration import kabsch
from warp_resphys.environments.making import TASKS, make_vector
from warp_resphys.environments.policies import ScriptedGrasp, errors_mm
from warp_resphys.environments.tasks import FollowTask, Reach, ReachTask
from warp_resphys.environments.vector import ActionMapping, Camera, RobotVectorEnv, VectorOptions
from warp_resphys.studies.live import LiveRobot

QUICK = {"seconds": 0.2, "action_time": 0.05}  # four actions


@pytest.fixture(scope="module", autouse=True)
def _drawing_processes_are_used_again(used_again):
    with used_again():
        yield


def played(environment, steps=6, seed=3):
    """Observations, rewards and ends of some steps of the same random actions."""
    random = np.random.default_rng(0)
    observations, rewards, ends = [environment.reset(seed=seed)[0]], [], []
    for _ in range(steps):
        actions = random.uniform(-1.0, 1.0, environment.action_space.shape).astype(np.float32)
        seen, reward, terminated, truncated, _ = environment.step(actions)
        observations.append(seen)
        rewards.append(reward)
        ends.append(terminated | truncated)
    return np.stack(observations), np.stack(rewards), np.stack(ends)


@pytest.mark.slow
class TestGymnasium:
    @pytest.mark.usefixtures("can_draw")
    @pytest.mark.parametrize(
        "task", [task for task in TASKS if task not in ("grasp", "pick_and_place")]
    )
    def test_its_checker_passes(self, folder, task):
        name = "".join(word.capitalize() for word in task.split("_"))
        environment = gym.make(
            f"warp_resphys/{name}-v0", run=folder, render_mode="rgb_array", **QUICK
        )
        # The pictures are alike.
        check_env(environment.unwrapped, skip_render_check=task != "reach")
        environment.close()

    def test_a_vector_of_them_is_made_by_name(self, folder):
        environment = gym.make_vec("warp_resphys/Reach-v0", num_envs=3, run=folder, **QUICK)
        seen, info = environment.reset(seed=0)
        assert environment.num_envs == 3
        assert seen in environment.observation_space
        assert info == {}
        assert seen.dtype == np.float32

    @pytest.mark.parametrize("world", ["simulator", "laboratory"])
    def test_a_seed_determines_an_episode(self, folder, world, sampled_places):
        first = make_vector("follow", folder, 2, world=world, **QUICK)
        if world == "simulator":
            sampled_places.clear()
        second = make_vector("follow", folder, 2, world=world, **QUICK)
        one, two, again = played(first), played(second), played(first)
        for expected, repeated in zip(one, two, strict=True):
            np.testing.assert_array_equal(expected, repeated)
        np.testing.assert_allclose(one[0], again[0], atol=1e-3 if world == "laboratory" else 1e-6)
        other = played(second, seed=4)[0]
        assert np.abs(other - one[0]).max() > 0.01

    def test_a_robot_does_not_depend_on_those_beside_it(self, folder):
        few, many = (make_vector("reach", folder, count, **QUICK) for count in (2, 4))
        few.reset(seed=5)
        many.reset(seed=5)
        action = np.zeros((4, 3), dtype=np.float32)
        np.testing.assert_allclose(few.step(action[:2])[0], many.step(action)[0][:2], atol=1e-4)


@pytest.mark.slow
class TestResets:
    def test_the_next_step_begins_anew(self, folder):
        environment = make_vector("reach", folder, 2, **QUICK)
        seen, rewards, ends = played(environment, 6)
        np.testing.assert_array_equal(ends, [[False] * 2] * 3 + [[True] * 2] + [[False] * 2] * 2)
        np.testing.assert_array_equal(rewards[4], [0.0, 0.0])
        # Markers, before commands and goals.
        width = environment.single_observation_space.shape[0] - 12
        assert np.abs(seen[4][:, :width]).max() > 0.05
        assert np.abs(seen[5][:, :width]).max() < 0.02

    def test_the_same_step_begins_anew_and_keeps_the_last_observation(self, folder):
        environment = make_vector(
            "reach", folder, 2, autoreset_mode=AutoresetMode.SAME_STEP, **QUICK
        )
        environment.reset(seed=1)
        action = np.ones((2, 3), dtype=np.float32)
        action[:, 1:] = -1.0
        for _ in range(4):
            seen, _, _, truncated, info = environment.step(action)
        assert truncated.all()
        assert info["_final_obs"].all()
        assert np.abs(info["final_obs"][0][:9]).max() > 0.05
        assert np.abs(seen[0][:9]).max() < 0.02

    def test_a_finished_episode_must_be_reset_without_autoreset(self, folder):
        environment = make_vector(
            "reach", folder, 2, autoreset_mode=AutoresetMode.DISABLED, **QUICK
        )
        environment.reset(seed=1)
        action = np.zeros((2, 3), dtype=np.float32)
        for _ in range(4):
            moved = environment.step(action)[0]
        refuses(InputError, "reset_mask", environment.step, action)
        seen, _ = environment.reset(options={"reset_mask": np.array([True, False])})
        np.testing.assert_array_equal(seen[1], moved[1])
        assert np.abs(seen[0] - moved[0]).max() > 0.05


class TestWorlds:
    @pytest.mark.slow
    def test_parameters_are_those_of_the_identification(self, folder):
        environment = make_vector("reach", folder, 4, spread=1.0, noise=0.0, **QUICK)
        environment.reset(seed=0)
        world = environment.world
        drawn = world.robot.parameters["youngs_modulus"].numpy()
        description = world.robot.description
        assert np.ptp(drawn) > 0.0
        deviation = description.uncertainty.deviation["youngs_modulus"]
        assert np.abs(drawn - description.parameters["youngs_modulus"]).max() < 4.0 * deviation
        same = make_vector("reach", folder, 4, spread=0.0, noise=0.0, **QUICK)
        seen = played(same, 2)[0]
        np.testing.assert_allclose(seen[0][:, :9], 0.0, atol=1e-6)

    @pytest.mark.slow
    def test_commands_change_no_faster_than_they_can(self, folder):
        environment = make_vector("reach", folder, 1, action_time=0.01, seconds=0.2)
        environment.reset(seed=0)
        seen = environment.step(np.ones((1, 3), dtype=np.float32))[0]
        at = 2 * 18
        np.testing.assert_allclose(seen[0, at : at + 3], -1.0 + 2.0 * 0.1, atol=1e-6)

    def test_a_figure_has_no_end_and_no_jump(self):
        places = np.random.default_rng(0).normal(size=(30, 3)) * [0.03, 0.02, 0.004]
        task = FollowTask(1, 200, Reach(places, np.zeros((30, 3))), 0.05)
        task.begin(0, np.random.default_rng(1))
        steps = np.linalg.norm(np.diff(task.goals[0], axis=0), axis=1)
        assert steps.min() > 0.0
        assert steps.max() < 0.05 * np.ptp(task.goals[0], axis=0).max() * 10.0


class Brittle(World):
    """A point that moves to its command at once, and fails
    in the second of the five steps of its third action.
    """

    def __init__(self):
        self.count, self.time_step, self.input, self.parts, self.number = 2, 0.01, "place", 1, 0
        self.rest = State(torch.zeros(2, 1, 3), torch.zeros(2, 1, 3))

    def step(self, state, commands):
        self.number += 1
        q = torch.zeros(2, 1, 3)
        q[:, 0, :1] = torch.as_tensor(commands)
        return State(q, state.v).with_memory(
            {"lost": state.lost | torch.tensor([self.number == 12, False])}
        )

    def markers(self, state):
        return state.q.numpy()


def test_a_failure_in_any_step_of_an_action_ends_the_episode():
    places = np.random.default_rng(0).normal(size=(8, 3))
    reach = Reach(places, np.zeros((8, 1)))
    mapping = ActionMapping(np.zeros(1), np.ones(1), np.full(1, 10.0), np.zeros(1), 5)
    robots = RobotVectorEnv(Brittle(), ReachTask(2, 6, reach), mapping, np.eye(3), 6)
    robots.reset(seed=0)
    steps = [robots.step(np.ones((2, 1), dtype=np.float32)) for _ in range(5)]
    _, rewards, terminated, _, infos = zip(*steps, strict=True)
    np.testing.assert_array_equal(
        terminated, [[False] * 2] * 2 + [[True, False]] + [[False] * 2] * 2
    )
    assert rewards[2][0] == -10.0
    assert rewards[3][0] == 0.0  # The next step resets it.
    np.testing.assert_allclose(
        infos[3]["error_mm"][0], 1e3 * np.linalg.norm(robots.task.goals[0, 0])
    )
    for options, said in (
        (VectorOptions(forces=True), "forces need a simulator"),
        (VectorOptions(squeeze=0.1), "squeeze is for fingers"),
    ):
        arguments = (Brittle(), robots.task, mapping, np.eye(3), 6, options)
        refuses(InputError, said, RobotVectorEnv, *arguments)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["simulator", "laboratory"])
def test_the_force_at_the_base_is_the_weight_at_rest_and_observed_last(folder, world):
    plain, felt = (
        make_vector("reach", folder, 2, world=world, **QUICK, forces=forces)
        for forces in (False, True)
    )
    (seen, rewards, _), (more, same, _) = played(plain), played(felt)
    np.testing.assert_array_equal(more[..., :-3], seen)
    np.testing.assert_array_equal(rewards, same)
    begun = np.linalg.norm(more[[0, 5], :, -3:], axis=-1)  # in the first steps of two episodes
    np.testing.assert_allclose(begun, 9.80709 / 9.81, rtol=1e-4)
    assert np.abs(more[1:4, :, -3:] - more[0, :, -3:]).max() > 0.05


class TestPictures:
    @pytest.mark.slow
    @pytest.mark.usefixtures("can_draw")
    @pytest.mark.parametrize("world", ["simulator", "laboratory"])
    def test_they_show_body_markers_and_goal_where_these_are(self, folder, world):
        environment = make_vector("reach", folder, 2, world=world, render_mode="rgb_array", **QUICK)
        environment.reset(seed=2)
        first = environment.render()
        assert len(first) == 2
        assert all(
            picture.shape == (480, 480, 3) and picture.dtype == np.uint8 for picture in first
        )
        for _ in range(3):
            environment.step(np.array([[1.0, -1.0, -1.0], [-1.0, -1.0, 1.0]], dtype=np.float32))
        later = environment.render()
        blue, red = (
            [
                np.argwhere(pixels[..., one] > pixels[..., other] + 40.0)
                for pixels in map(np.int64, (*first, *later))
            ]
            for one, other in ((2, 0), (0, 2))
        )
        assert min(map(len, blue)) > 1000  # the body
        assert min(map(len, red)) > 20  # the goal
        # The first robot moved.
        assert np.linalg.norm(blue[0].mean(axis=0) - blue[2].mean(axis=0)) > 2.0
        # The second moved elsewhere.
        assert np.linalg.norm(blue[2].mean(axis=0) - blue[3].mean(axis=0)) > 2.0
        # The goal stays in place.
        np.testing.assert_allclose(red[0].mean(axis=0), red[2].mean(axis=0), atol=8.0)
        environment.close()

    @pytest.mark.slow
    @pytest.mark.usefixtures("can_draw")
    def test_a_camera_looks_from_the_side_and_has_up_upwards(self):
        corners = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.0]])
        heights = []
        for up in (1.0, -1.0):
            camera = Camera(np.array([0.0, 0.0, up]), corners, ObstacleSurface())
            nothing = np.zeros((0, 3), dtype=np.int64)
            (pixels,) = camera.pictures(
                nothing, corners[None], corners[None, :1], [corners[1:2]], [""]
            )
            camera.close()
            red = np.argwhere(pixels[..., 0] > pixels[..., 2] + 40.0)
            assert len(red) > 20
            heights.append(red[:, 0].mean() / len(pixels))
        assert heights[0] < 0.3 < 0.7 < heights[1]  # The goal is above the marker, or below it.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"task": "dance"}, "'dance'"),
        ({"action_time": 0.015}, "action_time"),
        ({"tracked": ["Nose"]}, "tracked"),
        ({"task": "swing_up", "world": "laboratory"}, "swing_up"),
    ],
)
def test_invalid_arguments_are_refused(folder, change, said):
    refuses(
        InputError,
        said,
        make_vector,
        **{"task": "reach", "run": folder, "num_envs": 1, **QUICK, **change},
    )


@pytest.mark.slow
def test_steps_need_a_reset_and_actions_their_shape(folder):
    environment = make_vector("reach", folder, 2, **QUICK)
    refuses(InputError, "not reset", environment.step, np.zeros((2, 3), dtype=np.float32))
    environment.reset(seed=0)
    refuses(
        InputError, r"actions have shape \(3,\)", environment.step, np.zeros(3, dtype=np.float32)
    )


@pytest.fixture(scope="module")
def robot(folder):
    return warp_resphys.load(folder, "resphys")


@pytest.mark.slow
def test_a_trial_commands_its_inputs(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[-1])
    motion = live.trial.play(robot)
    (name,) = [name for name in live.trial.inputs if name in robot.inputs]
    given = np.asarray(live.trial.inputs[name]).reshape(-1, len(robot.inputs[name].parts))
    assert np.ptp(given, axis=0).max() > 0.0
    shown = live.trial.shown(motion)
    for number in range(live.trial.steps):
        assert live.step()
        np.testing.assert_allclose(live.inputs[name], given[number])
        np.testing.assert_allclose(live.positions, motion.q[number + 1, 0], rtol=0.0, atol=1e-9)
        for frame in np.flatnonzero(np.isclose(live.trial.times, live.time, atol=1e-9)):
            np.testing.assert_allclose(live.markers, shown[frame], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(
                live.measured, live.trial.markers[frame], rtol=0.0, atol=1e-9
            )


@pytest.mark.slow
def test_measured_markers_are_interpolated_linearly_between_frames(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[0])
    times, seen = live.trial.times, live.trial.markers
    live.time = 0.75 * times[3] + 0.25 * times[4]
    np.testing.assert_allclose(live.measured, 0.75 * seen[3] + 0.25 * seen[4], rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_markers_observed_in_their_own_frame_are_shown_on_the_body(robot):
    description = robot.description
    own = Robot(replace(description, markers=description.markers.changed(frame="own")))
    plain, turned = LiveRobot(Robot(description)), LiveRobot(own)
    name, driven = next(iter(robot.inputs.items()))
    for live in (plain, turned):
        live.play_trial(None)
        live.set_input(name, 0, 0.5 * driven.high[0])
        for _ in range(10):
            live.step()
    observed = own.observe(turned.state)[0].numpy()
    np.testing.assert_allclose(turned.positions, plain.positions, rtol=0.0, atol=1e-9)
    assert np.abs(observed - plain.markers).max() > 1e-4
    np.testing.assert_allclose(turned.markers, plain.markers, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(
        kabsch(observed, plain.markers).apply(observed), plain.markers, atol=1e-8
    )


@pytest.mark.slow
@pytest.mark.usefixtures("can_draw")
def test_gymnasiums_checker_passes(fingers):
    environment = gym.make(
        "warp_resphys/Grasp-v0",
        run=fingers,
        model="sysid",
        seconds=0.2,
        action_time=0.05,
        render_mode="rgb_array",
    )
    check_env(environment.unwrapped)
    environment.close()


@pytest.mark.slow
@pytest.mark.parametrize("world", ["simulator", "laboratory"])
def test_a_firm_grasp_lifts_the_ball_and_a_loose_one_does_not(fingers, world):
    grippers = make_vector("grasp", fingers, 2, "sysid", world, seconds=1.0)
    policies = ScriptedGrasp(1.0), ScriptedGrasp(0.05)

    def firm_and_loose(seen):
        return np.stack([policy(seen)[row] for row, policy in enumerate(policies)])

    errors = errors_mm(grippers, firm_and_loose, 0)
    firm, loose = errors[-1]
    assert firm < 8.0  # of 20 mm
    assert loose > 18.0


@pytest.mark.slow
def test_fingers_feel_the_ball_and_pay_for_a_squeeze(fingers):
    plain, felt = (
        make_vector(
            "grasp", fingers, 1, "sysid", seconds=1.0, noise=0.0, forces=bool(cost), squeeze=cost
        )
        for cost in (0.0, 0.2)
    )
    policy = ScriptedGrasp(1.0)
    seen, more = plain.reset(seed=0)[0], felt.reset(seed=0)[0]
    np.testing.assert_array_equal(more[:, -6:], 0.0)  # no step led to the start
    for _ in range(plain.actions):
        action = policy(seen)
        (seen, reward, *_), (more, paid, *_) = plain.step(action), felt.step(action)
        np.testing.assert_array_equal(more[:, :-6], seen)
        left, right = more[0, -6:].reshape(2, 3).astype(np.float64)
        # Friction of 0.8 holds half of the ball.
        excess = max(0.5 * (left - right)[0] - 0.5 / 0.8, 0.0)
        np.testing.assert_allclose(paid, reward - 0.2 * excess, atol=1e-5)
    assert excess > 0.2
    weight = float(felt.world._scene.constants.load_mass.sum()) / 0.01 * 9.80709 / 9.81
    # Of the fingers and the ball in the air.
    assert (left + right)[2] == pytest.approx(weight, rel=0.01)


@pytest.mark.slow
def test_grippers_are_what_they_are_alone_and_begin_anew(fingers):
    together, alone = (
        make_vector("grasp", fingers, n, "resphys", seconds=0.3, noise=0.0) for n in (3, 1)
    )
    actions = np.array([[[-0.5, -1.0], [0.4, 0.0], [1.0, 1.0]]] * 4, dtype=np.float32)
    first = together.reset(seed=0)[0]
    alone.reset(seed=1)
    for action in actions:
        seen, own = together.step(action)[0], alone.step(action[1:2])[0]
    np.testing.assert_allclose(seen[1], own[0], atol=1e-5)
    assert np.abs(seen - first).max() > 0.1
    np.testing.assert_array_equal(together.reset(seed=0)[0], first)


@pytest.mark.slow
def test_what_cannot_grasp_is_refused(fingers, folder):
    refuses(
        InputError,
        "contact, which reduced models lack",
        make_vector,
        "grasp",
        fingers,
        1,
        world="reduced",
    )
    refuses(InputError, "this robot has front, left, right", make_vector, "grasp", folder, 1)
