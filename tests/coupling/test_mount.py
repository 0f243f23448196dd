"""Robots on bodies of MuJoCo models: rigid bodies, heavy robots,
momentum, statics, batches, scenes, refusals.
"""

import re
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warp_resphys
from support.configured import settings
from support.refusals import refuses
from warp_resphys import RobotScene, box_hexahedra
from warp_resphys.experiment.build import build_mesh
from warp_resphys.io.errors import InputError
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import MaterialSettings, SimulatorSettings

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

from warp_resphys.coupling import Mount, base_pose  # noqa: E402
from warp_resphys.coupling.mount import _WEIGHTS  # noqa: E402

SIZE, DIVISIONS, MASS = (0.1, 0.02, 0.02), (3, 1, 1), 0.04  # m, cells, kg
STIFF, SOFT = 1e8, 2e5  # Pa
# Too stiff, too few cells.
pytestmark = pytest.mark.filterwarnings("ignore::warp_resphys.ResphysWarning")
SLIDE = '<joint name="joint" type="slide" axis="1 0 0" stiffness="{stiffness}"/>'
HINGE = '<joint name="joint" type="hinge" axis="0 1 0"/>'
HANGING = np.pi / 2 + np.arctan(0.2)  # angle of the hinge with the middle of the beam below it
TURNED = (0.03, -0.02, 0.05, 0.4, -0.3, 0.2)


@cache
def beam(time_step=0.005, youngs_modulus=SOFT, gravity=-9.81, damping=0.0, on_failure="raise"):
    """A beam of 40 g along x, clamped at x = 0."""
    run = settings(
        f"mesh={{kind:box_hexahedra,size:{[*SIZE]},divisions:{[*DIVISIONS]}}}",
        "integrator=implicit_euler",
        f"time_step={time_step}",
        f"gravity=[0,0,{gravity}]",
        f"simulation.youngs_modulus={youngs_modulus}",
        "simulation.density=1000",
        f"simulation.stiffness_damping={damping}",
        "simulation.mass_damping=0",
    )
    own = MaterialSettings.model_validate({**run.simulation.plain(), "model": "corotated"})
    made = Description(
        "beam", "sysid", SimulatorSettings.of(run), own, box_hexahedra(SIZE, DIVISIONS)
    )
    return Robot(made, on_failure=on_failure)


def model(joint, time_step=0.005, mass=0.04, gravity=-9.81, inside="", outside=""):
    """A box on a joint."""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{time_step}" gravity="0 0 {gravity}"/><worldbody><body '
        f'name="box">{joint}<geom type="sphere" size=".01" mass="{mass}" '
        f'contype="0"/>{inside}</body></worldbody>{outside}</mujoco>'
    )


def rigid(robot):
    """MJCF of the rigid body with the masses of a robot's vertices."""
    mass, x = robot.constants.mass[0].numpy(), robot.simulator.rest_positions.numpy()
    middle = mass @ x / mass.sum()
    arm = x - middle
    shape = (arm**2).sum(1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None]
    full = shape * mass[:, None, None]
    xx, yy, zz, xy, xz, yz = full.sum(0)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return (
        f'<body name="beam"><inertial pos="{middle[0]} {middle[1]} {middle[2]}" '
        f'mass="{mass.sum()}" fullinertia="{xx} {yy} {zz} {xy} {xz} {yz}"/></body>'
    )


def at(model, *positions):
    """Data of a model at rest in a pose."""
    data = mujoco.MjData(model)
    data.qpos[: len(positions)] = positions
    mujoco.mj_forward(model, data)
    return data


def swing(joint, start, about, time_step, substeps, mass, seconds):
    """Joint positions and forces along x of a stiff robot,
    and those of MuJoCo's rigid body with tiny steps.
    """
    robot = beam(time_step, STIFF)
    mount = Mount(robot, model(joint, time_step / substeps, mass), "box")
    state = mount.begin(at(mount.model, about + start))
    fine = model(joint, 5e-5, mass, inside=rigid(robot))
    data = at(fine, about + start)
    rows = []
    for _ in range(round(seconds / time_step)):
        state = mount.step(state)
        mujoco.mj_step(fine, data, round(time_step / 5e-5))
        mujoco.mj_rnePostConstraint(fine, data)
        ours, theirs = mount.data(state).qpos[0] - about, data.qpos[0] - about
        rows.append((ours, theirs, state.wrench[0, 0], -data.cfrc_int[fine.body("beam").id, 3]))
    return np.array(rows).T


def period(positions, time_step):
    """Time between the first two falls through zero."""
    (falls,) = np.nonzero((positions[:-1] > 0) & (positions[1:] <= 0))
    times = falls + positions[falls] / (positions[falls] - positions[falls + 1])
    return time_step * (times[1] - times[0])


@pytest.mark.parametrize(
    ("joint", "start", "about", "substeps", "mass"),
    [
        (SLIDE.format(stiffness=40), 0.02, 0.0, 5, 0.004),
        pytest.param(HINGE, 0.1, HANGING, 1, 0.04, marks=pytest.mark.slow),
        pytest.param(HINGE, 0.1, HANGING, 5, 0.4, marks=pytest.mark.slow),
    ],
    ids=["slide, light", "hinge", "hinge, heavy"],
)
def test_a_stiff_robot_swings_like_a_rigid_body(joint, start, about, substeps, mass):
    """Period, and reaction over motion, to 1 % at 5 ms.

    The error of the motion is proportional to the step.

    Implicit Euler damps the turning of the robot itself, so the reactions are those of a smaller
    swing.
    """
    errors = []
    for time_step in (0.01, 0.005):
        ours, theirs, force, wanted = swing(
            joint, start, about, time_step, substeps, mass, 0.4 if mass < 0.01 else 0.8
        )
        errors.append(np.abs(ours - theirs).max())
    assert period(ours, 0.005) == pytest.approx(period(theirs, 0.005), rel=5e-3)
    assert np.ptp(force[10:]) / np.ptp(ours[10:]) == pytest.approx(
        np.ptp(wanted[10:]) / np.ptp(theirs[10:]), rel=1e-2
    )
    assert errors[1] < 0.65 * errors[0]
    assert errors[1] < 0.25 * start


def kicked(ratio, youngs_modulus, steps, robot=None):
    """Largest twist of a free body, by step, whose robot is kicked at its tip."""
    robot = robot or beam(0.005, youngs_modulus, 0)
    mount = Mount(robot, model("<freejoint/>", mass=MASS / ratio, gravity=0), "box")
    state, force = mount.begin(at(mount.model)), np.zeros(robot.simulator.rest_positions.shape)
    force[-1] = 0.02, 0.05, 0.05
    twists = []
    for number in range(steps):
        state = mount.step(state, external_force=force * (number < 4))
        twists.append(np.abs(state.velocity).max())
    return np.array(twists)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "youngs_modulus"), [(0.1, 3e4), (0.1, 3e6), (1.0, 3e5), (10.0, 3e4), (10.0, 3e6)]
)
def test_robots_without_damping_are_stable_at_all_ratios_of_mass(ratio, youngs_modulus):
    twists = kicked(ratio, youngs_modulus, 300)
    assert twists[150:].max() < 1.05 * twists[:150].max()
    assert twists[200:].max() < 1.02 * twists[100:200].max()


def test_a_heavy_robot_is_stable_with_its_response_and_diverges_without(monkeypatch):
    twists = kicked(10.0, 3e5, 60)
    assert twists[40:].max() < twists[:40].max()
    begin = Mount.begin

    def without(self, data):
        state = begin(self, data)
        state.response[:] = 0.0
        return state

    monkeypatch.setattr(Mount, "begin", without)
    refuses(InputError, "base moves by", kicked, 10.0, 3e5, 60)


@pytest.mark.parametrize(
    ("ratio", "seconds"),
    [pytest.param(0.5, 0.6), *(pytest.param(r, 2.2, marks=pytest.mark.slow) for r in (0.1, 5.0))],
)
def test_a_free_body_and_its_robot_keep_their_momentum(ratio, seconds):
    robot = beam(0.005, SOFT, 0, 5e-3)
    mount = Mount(robot, model("<freejoint/>", mass=MASS / ratio, gravity=0), "box")
    state, push = mount.begin(at(mount.model)), np.zeros(robot.simulator.rest_positions.shape)
    push[-1], impulse, errors = (0.01, 0.02, 0.03), np.zeros(3), []
    mass = robot.constants.mass[0].numpy()
    for number in range(round(seconds / 0.005)):
        force = push * max(0.0, np.sin(np.pi * min(number, 40) / 40)) ** 2
        state, impulse = mount.step(state, external_force=force), impulse + 0.005 * force.sum(0)
        arm = mount.data(state)
        mujoco.mj_subtreeVel(mount.model, arm)
        whole = (
            mount.model.body_subtreemass[0] * arm.subtree_linvel[0]
            + mass @ state.robot.v[0].numpy()
        )
        errors.append(np.linalg.norm(whole - impulse))
    assert np.linalg.norm(mass @ state.robot.v[0].numpy() - impulse) > 0.05 * np.linalg.norm(
        impulse
    )
    assert max(errors[42:]) < 1e-2 * np.linalg.norm(impulse)


ARM = (
    '<mujoco><option timestep=".005" gravity="0 0 -9.81"/><worldbody><body name="upper"><joint '
    'name="one" axis="0 1 0" damping="4"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" '
    'mass=".5"/><body name="flange" pos=".3 0 0"><joint name="two" axis="0 1 0" '
    'damping="4"/><geom type="sphere" size=".02" pos=".05 0 0" '
    'mass=".1"/></body></body></worldbody><actuator><position joint="one" kp="200"/><position '
    'joint="two" kp="200"/></actuator></mujoco>'
)


def held(robot, pose, angles):
    """An arm that holds a robot: the mount, its state after a second,
    and the torques of statics at the joints.
    """
    mount = Mount(robot, mujoco.MjModel.from_xml_string(ARM), "flange", pose)
    data = at(mount.model, *angles)
    data.ctrl[:] = angles
    state = mount.begin(data)
    for _ in range(120):
        state = mount.step(state)
    data = mount.data(state)
    weights = robot.simulator.prepare().load_mass[0].numpy() * 9.81
    arms = state.robot.q[0].numpy()[:, :1] - data.xanchor[:, 0]
    # About y, a weight at x turns by x times it.
    return mount, state, data.qfrc_bias - weights @ arms


def test_the_joints_of_an_arm_at_rest_hold_it_and_the_robot():
    """Torques of the actuators against the moments of all weights, to 0.5 %."""
    mount, state, wanted = held(beam(damping=5e-3), TURNED, (0.2, -0.6))
    assert np.abs(state.velocity).max() < 1e-3
    torques = mount.data(state).actuator_force
    np.testing.assert_allclose(torques, wanted, rtol=5e-3)


def test_a_batch_moves_as_its_arms_do_alone():
    mount = Mount(beam(), model(HINGE), "box", TURNED)
    starts = [at(mount.model, angle) for angle in (0.3, 1.2)]
    both, alone = mount.begin(starts), [mount.begin(start) for start in starts]
    force = np.zeros((2, *beam().simulator.rest_positions.shape))
    force[1, -1, 1] = 0.05
    for _ in range(5):
        both = mount.step(both, external_force=force)
        alone = [mount.step(one, external_force=own) for one, own in zip(alone, force, strict=True)]
    for name in ("arm", "pose", "wrench"):
        np.testing.assert_allclose(
            getattr(both, name),
            np.concatenate([getattr(one, name) for one in alone]),
            rtol=1e-6,
            atol=1e-7,
        )
    start = mount.begin(starts)
    mixed = start.where(np.array([True, False]), both)
    np.testing.assert_array_equal(mixed.arm, [start.arm[0], both.arm[1]])
    torch.testing.assert_close(mixed.robot.q, torch.stack([start.robot.q[0], both.robot.q[1]]))


def test_an_arm_goes_on_without_a_robot_that_is_lost():
    robot = beam(on_failure="count")
    mount = Mount(robot, model(HINGE, gravity=-9.81), "box")
    state = mount.begin([at(mount.model, 0.3)] * 2)
    thrown = np.zeros((2, *robot.simulator.rest_positions.shape))
    thrown[1, -1] = 1e9
    state = mount.step(state, external_force=thrown)
    speed = state.velocity[1, 4]
    for _ in range(3):
        state = mount.step(state)
    assert state.robot.lost.tolist() == [False, True]
    assert np.abs(state.wrench[0]).max() > 0.1
    assert np.abs(state.wrench[1]).max() == 0.0
    assert state.velocity[1, 4] == pytest.approx(speed)  # of a ball about its middle


def test_one_way_a_robot_follows_the_arm_in_one_line():
    robot, arm = beam(), mujoco.MjModel.from_xml_string(ARM)
    data = at(arm, 0.2, -0.6)
    data.ctrl[:] = 0.3, -0.5
    state = robot.begin(base=base_pose(arm, data, "flange", TURNED))
    for _ in range(3):
        mujoco.mj_step(arm, data)
        state = robot.step(state, base=base_pose(arm, data, "flange", TURNED))
    mujoco.mj_forward(arm, data)
    flange = data.body("flange")
    frame = flange.xmat.reshape(3, 3)
    turned = np.empty(9)
    quaternion = np.empty(4)
    mujoco.mju_axisAngle2Quat(
        quaternion, np.array(TURNED[3:]) / np.linalg.norm(TURNED[3:]), np.linalg.norm(TURNED[3:])
    )
    mujoco.mju_quat2Mat(turned, quaternion)
    rest, fixed = robot.simulator.rest_positions.numpy(), robot.simulator.fixed.numpy()
    wanted = (rest[fixed] @ turned.reshape(3, 3).T + TURNED[:3]) @ frame.T + flange.xpos
    np.testing.assert_allclose(state.q[0, fixed], wanted, atol=1e-12)


def test_robots_of_a_scene_move_together():
    """Two beams, one of them turned: twice the reaction of one, about an origin between them."""
    robot = beam()
    poses = {"left": (0.01, 0, 0, 0, 0, 0), "right": (-0.01, 0.02, 0, 0, 0, np.pi)}
    scene = Mount(
        RobotScene({name: (robot, pose) for name, pose in poses.items()}),
        model(HINGE),
        "box",
        TURNED,
    )
    state = scene.begin(at(scene.model, 0.3))
    pairs = []
    for name in poses:
        scene_rest = scene.robot.state_of(state.robot, name)
        pairs.append(np.linalg.norm(scene_rest.q[0].diff(dim=0).numpy()))
    assert pairs[0] == pytest.approx(
        np.linalg.norm(robot.simulator.rest_positions.diff(dim=0).numpy()), rel=0.05
    )
    np.testing.assert_allclose(
        state.wrench[0, :3], [0.0, 0.0, -2 * MASS * 9.81], rtol=1e-6, atol=1e-6
    )
    state = scene.step(
        state, left={"external_force": np.zeros(robot.simulator.rest_positions.shape)}
    )
    ours = scene.robot.scene.vertex_slice("left")
    fixed = robot.simulator.fixed.numpy()
    pose = base_pose(scene.model, scene.data(state), "box", TURNED)
    wanted = robot.step(robot.begin(base=pose), base=pose).q[0, fixed].numpy()
    moved = state.robot.q[0, ours].numpy()[fixed]
    # The shift of its pose.
    assert np.linalg.norm(moved - wanted, axis=1) == pytest.approx(0.01, rel=1e-6)
    refuses(InputError, "there is no robot 'top' in the scene", scene.step, state, top={})


@pytest.mark.slow
def test_an_arm_feels_the_ball_that_its_gripper_lifts():
    """Two fingers close on a ball on a table, and the arm lifts it.

    Then its torques are those of statics to 0.5 %.
    """
    run = settings("experiment=finger", "integrator=implicit_euler")
    finger = Robot(
        Description(
            "finger", "simulation", SimulatorSettings.of(run), run.simulation, build_mesh(run.mesh)
        )
    )
    gripper = pytest.importorskip(
        "warp_resphys.environments.grippers", exc_type=ImportError
    ).gripper
    scene, arm = gripper(finger), mujoco.MjModel.from_xml_string(ARM)
    arm.opt.timestep = 0.002  # a fifth of the gripper's
    arm.body("upper").pos[:] = -0.3, 0.0, 0.2
    mount = Mount(scene, arm, "flange", (0.0, 0.0, -0.2, 0.0, 0.0, 0.0))
    state = mount.begin(at(arm))
    fingers = -state.wrench[0, 2]
    for number in range(110):
        pull, lift = min(number / 25, 1.0) * 2.0, min(max(number - 30, 0) / 50, 1.0) * 0.0667
        state = mount.step(
            state, [-lift, lift], **{name: {"tendon_tension": pull} for name in scene.robots}
        )
    q, data = state.robot.q[0].numpy(), mount.data(state)
    ball, weights = scene.scene.vertex_slice("ball"), scene.constants.load_mass[0].numpy() * 9.80709
    assert q[ball, 2].mean() > scene.simulator.rest_positions[ball, 2].mean() + 0.018
    assert -state.wrench[0, 2] == pytest.approx(fingers + weights[ball].sum(), rel=5e-3)
    wanted = data.qfrc_bias - weights @ (q[:, :1] - data.xanchor[:, 0])
    np.testing.assert_allclose(data.actuator_force, wanted, rtol=5e-3, atol=2e-3)


PUSHED = (
    '<mujoco><option timestep="0.01" gravity="0 0 -9.81"/><worldbody><body name="arm"><joint '
    'name="j" axis="0 1 0" damping="1"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" '
    'mass=".3"/><body name="flange" pos=".2 0 0"><geom type="sphere" size=".02" mass=".2"/><body '
    'name="tool" pos="0 0 .05" euler="0 0 90"/></body></body><body name="hand" mocap="true" '
    'pos="0 0 .5"><geom type="sphere" size=".01"/><body '
    'name="palm"/></body></worldbody><actuator><position joint="j" kp="60" '
    'kv="1"/></actuator></mujoco>'
)


def settled(mount, data, steps=130):
    state = mount.begin(data)
    for _ in range(steps):
        state = mount.step(state, [0.0])
    return state, mount.data(state)


def test_a_push_on_the_flange_acts_beside_the_robot():
    """2 N upward at 0.2 m relieve the servo by 0.4 N m, 0.382 degrees.

    A moment of 0.3 N m about y loads it.
    """
    mount = Mount(beam(0.01, damping=0.02), mujoco.MjModel.from_xml_string(PUSHED), "flange")
    torques, angles, forces = [], [], []
    for force, moment in ((0.0, 0.0), (2.0, 0.0), (0.0, 0.3)):
        data = mujoco.MjData(mount.model)
        data.xfrc_applied[mount.model.body("flange").id, [2, 4]] = force, moment
        state, arm = settled(mount, data)
        torques.append(arm.actuator_force[0])
        angles.append(np.degrees(arm.qpos[0]))
        forces.append(arm.xfrc_applied[mount.model.body("flange").id, 2] - state.wrench[0, 2])
    np.testing.assert_allclose(forces, [0.0, 2.0, 0.0], atol=1e-12)
    assert angles[0] - angles[1] == pytest.approx(np.degrees(0.4 / 60.0), rel=5e-3)
    np.testing.assert_allclose(np.diff(torques), [0.4, -0.7], rtol=5e-3)


def test_a_robot_with_tilted_gravity_is_turned_by_the_tilt():
    """As it was recorded: with the pull of its own frame,
    which is the model's on an upright body.
    """
    pull = np.array([-0.281, 0.153, -9.802])
    level = beam(gravity=-np.linalg.norm(pull))
    robot = level.in_gravity(pull)
    arm = mujoco.MjModel.from_xml_string(ARM)
    arm.opt.gravity[:] = level.simulator.gravity
    mount = Mount(robot, arm, "flange", (0.1, 0, 0, 0, 0, 0))
    state = mount.begin(at(arm))
    np.testing.assert_allclose(state.wrench[0, :3], MASS * arm.opt.gravity, atol=1e-6)
    turn = Rotation.from_rotvec(state.pose[0, 3:])
    np.testing.assert_allclose(turn.apply(pull), arm.opt.gravity, atol=1e-9)
    assert np.degrees(turn.magnitude()) == pytest.approx(1.87, abs=0.01)
    recorded = robot.begin()
    moved = turn.inv().apply(state.robot.q[0].numpy() - state.pose[0, :3])
    np.testing.assert_allclose(moved, recorded.q[0], atol=1e-7)
    np.testing.assert_allclose(mount.robot.simulator.gravity, arm.opt.gravity, atol=1e-9)
    steep = level.in_gravity(np.linalg.norm(pull) * np.array([np.sin(0.2), 0.0, -np.cos(0.2)]))
    refuses(
        InputError,
        "10 degrees apart at most, or mount robot.in_gravity",
        Mount,
        steep,
        arm,
        "flange",
    )
    scene = RobotScene({"left": (robot, np.zeros(6))})
    refuses(InputError, "give the robots of the scene poses", Mount, scene, arm, "flange")


def test_the_pose_of_a_base_is_that_of_the_positions_whatever_was_computed():
    arm = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(arm)
    np.testing.assert_allclose(
        base_pose(arm, data, "flange", TURNED)[:3], [0.33, -0.02, 0.05], atol=1e-12
    )
    mujoco.mj_forward(arm, data)
    data.qpos[:] = 0.2, -0.6
    np.testing.assert_array_equal(
        base_pose(arm, data, "flange"), base_pose(arm, at(arm, 0.2, -0.6), "flange")
    )
    assert data.xpos[arm.body("flange").id, 2] == 0.0  # the data are left as they were


def test_bodies_that_no_force_moves_or_without_mass_are_refused():
    robot, arm = beam(0.01), mujoco.MjModel.from_xml_string(PUSHED)
    refuses(InputError, "'hand' is a mocap body.*base_pose", Mount, robot, arm, "hand")
    refuses(InputError, "'palm' is a mocap body, or fixed to one", Mount, robot, arm, "palm")
    with pytest.raises(
        InputError, match="'tool' has no mass: mount the robot on 'flange'"
    ) as caught:
        Mount(robot, arm, "tool", (0.01, 0, 0, 0, 0, 0))
    pose = [float(x) for x in re.search(r"pose \[(.*)\]", str(caught.value))[1].split(",")]
    np.testing.assert_allclose(pose, [0.0, 0.01, 0.05, 0.0, 0.0, np.pi / 2], atol=1e-5)
    Mount(robot, arm, "flange", pose)
    frame = (
        '<link name="tool0"/><joint name="f" type="fixed"><parent link="tool"/><child '
        'link="tool0"/></joint></robot>'
    )
    fused = mujoco.MjModel.from_xml_string(URDF.replace("</robot>", frame))
    refuses(
        InputError, "'tool0'.*fuses a link on a fixed joint of a URDF", Mount, robot, fused, "tool0"
    )


URDF = (
    '<robot name="r"><link name="base"/><link name="tool"><inertial><mass value="0.1"/><inertia '
    'ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" '
    'type="continuous"><parent link="base"/><child link="tool"/><axis xyz="0 1 '
    '0"/></joint></robot>'
)


def test_an_arm_from_urdf():
    arm = mujoco.MjModel.from_xml_string(URDF)
    arm.opt.timestep = 0.0025
    mount = Mount(beam(), arm, "tool")
    state = mount.step(mount.begin(at(arm, 0.0)))
    assert mount.data(state).qvel[0] > 0.1  # falls under the weight of the robot


def test_what_cannot_be_mounted_is_refused(monkeypatch):
    robot, arm = beam(), mujoco.MjModel.from_xml_string(ARM)
    refuses(
        InputError,
        "no body 'flnge', did you mean 'flange'.*'world', 'upper', 'flange'",
        Mount,
        robot,
        arm,
        "flnge",
    )
    refuses(InputError, "the body 'world' cannot move", Mount, robot, arm, "world")
    refuses(InputError, "give six numbers", Mount, robot, arm, "flange", (0, 0))
    refuses(InputError, "the model is a str", Mount, robot, "arm.xml", "flange")
    refuses(InputError, "iterations is 1", Mount, robot, arm, "flange", iterations=1)
    refuses(InputError, r"steps of 5 ms and the robot of 4 ms", Mount, beam(0.004), arm, "flange")
    refuses(
        InputError,
        r"gravity is .* in the model and \[0.0, 0.0, 0.0\]",
        Mount,
        beam(gravity=0),
        arm,
        "flange",
    )
    refuses(
        InputError,
        r"integrated_by\('implicit_euler'\)",
        Mount,
        robot.integrated_by("bdf2"),
        arm,
        "flange",
    )
    mount, moving = Mount(robot, arm, "flange"), at(arm)
    state = mount.begin(moving)
    refuses(
        InputError,
        r"ctrl has shape \(3,\): give \(2,\) or \(1, 2\)",
        mount.step,
        state,
        [0.0, 0.0, 0.0],
    )
    moving.qvel[0] = 1.0
    refuses(InputError, "the arm moves", mount.begin, moving)
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    refuses(InputError, r"pip install 'warp-resphys\[mujoco\]'", Mount, robot, arm, "flange")


def test_the_code_of_the_page_runs(monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "coupling.md").read_text(encoding="utf-8")
    monkeypatch.setattr(warp_resphys, "load", lambda run: beam(gravity=-9.80709))
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(block, names)
    assert names["state"].wrench[0, 2] < 0.0


def growth(masses, stiffness, ratio, weights):
    """Spectral radius of the scheme for a chain of masses,
    of one unit together, on a body of 1 / ratio; H = 1.
    """
    count, memory = masses + 1, len(weights) - 1
    mass = np.diag([0.5, *[1.0] * (masses - 1), 0.5]) / masses
    spring = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    spring[0, 0] = spring[-1, -1] = 1.0
    hessian = mass + masses * stiffness * spring
    inverse = np.linalg.inv(hessian[1:, 1:])

    def follow(q, v, base):
        load = mass @ (q + v)
        new = np.concatenate([[base], inverse @ (load[1:] - hessian[1:, 0] * base)])
        return new, new - q, (hessian @ new - load)[0]

    q, v, response = np.zeros(count), np.zeros(count), []
    for number in range(memory + 1):
        q, v, reaction = follow(q, v, number + 1.0)
        response.append(reaction)
    response = weights * np.array(response)

    def step(state):
        (q, v), (last, before), past = (
            state[: 2 * count].reshape(2, -1),
            state[2 * count :][:2],
            state[2 * count + 2 :],
        )
        explained = response[1:] @ past
        a = -(explained + 2.0 * last - before) / (1.0 / ratio + response[0])
        q, v, reaction = follow(q, v, q[0] + v[0] + a)
        remainder = reaction - response[0] * a - explained
        return np.concatenate([q, v, [remainder, last], np.concatenate([[a], past])[:memory]])

    return np.abs(
        np.linalg.eigvals(np.transpose([step(row) for row in np.eye(2 * count + 2 + memory)]))
    ).max()


def test_the_scheme_is_stable_for_chains_of_masses_with_a_memory_that_fades():
    cases = list(product((1, 8, 40), 10.0 ** np.arange(-4, 5), (0.1, 10.0, 100.0)))
    assert max(growth(*case, _WEIGHTS) for case in cases) < 1.0 + 1e-4  # a triple eigenvalue 1
    assert max(growth(*case, np.ones_like(_WEIGHTS)) for case in cases) > 1.02
    assert max(growth(*case, _WEIGHTS[:1]) for case in cases) > 1.02
