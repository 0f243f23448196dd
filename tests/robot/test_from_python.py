"""Robots of simulators of Python: saved, loaded, drawn,
mounted, environments, twins, without a run.
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import warp_resphys as wr
from support.chambered import chambered
from support.refusals import refuses
from warp_resphys import Body, InputError, Robot, Simulator, select_vertices
from warp_resphys.control.reduction import fingerprint
from warp_resphys.energies import ConvexMaterial, FibreFamily, Medium, Muscle
from warp_resphys.io.errors import DataFileError
from warp_resphys.learning.identification.search import Identification
from warp_resphys.learning.identification.uncertainty import Uncertainty

pytestmark = pytest.mark.filterwarnings("ignore::warp_resphys.ResphysWarning")  # few cells
GUIDES = [[x, 0.0, -0.006] for x in (0.0, 0.03, 0.06)]
ARM = (
    '<mujoco><option timestep=".01" gravity="0 0 -9.80709"/><worldbody><body name="arm"><joint '
    'axis="0 1 0" damping=".1"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" '
    'mass=".3"/></body></worldbody></mujoco>'
)
PLACES = {"tip": (0.06, 0.0, 0.01), "side": (0.045, 0.01, 0.0)}


def finger(**options):
    """A finger along x with a tendon below its axis."""
    mesh = wr.rod(centreline=[[0.0, 0.0, 0.0], [0.06, 0.0, 0.0]], radii=0.01, layers=2)
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), energies=[wr.Tendons({"pull": GUIDES})])
    return Simulator(
        body, wr.StableNeoHookean(200e3, 0.45, density=1070.0, stiffness_damping=0.02), **options
    )


@pytest.fixture(scope="module")
def robot():
    return Robot.of(
        finger(), PLACES, {"youngs_modulus": 300e3}, {"tendon_tension": (0.0, 2.0)}, "finger"
    )


def moved(robot, **inputs):
    with torch.no_grad():
        return robot.rollout(robot.begin(), 3, **inputs)


def test_a_saved_robot_moves_as_the_simulator_did(robot, tmp_path):
    again = wr.load(robot.save(tmp_path / "finger.safetensors"))
    assert repr(again) == repr(robot)
    assert again.inputs == robot.inputs
    assert again.inputs["tendon_tension"].high == (2.0,)
    motion, copy = moved(robot, tendon_tension=[1.0]), moved(again, tendon_tension={"pull": 1.0})
    assert torch.equal(copy.q, motion.q)
    assert torch.equal(copy.markers, motion.markers)
    assert fingerprint(again) == fingerprint(robot)
    simulator, values = robot.simulator, {"youngs_modulus": 300e3}
    start = simulator.static_equilibrium(parameters=values)
    alone = simulator.rollout(start, 3, wr.Inputs(tendon_tension=[1.0]), values)
    torch.testing.assert_close(motion.q, alone.q, rtol=0.0, atol=1e-9)
    bound = wr.bind_markers(simulator.body.mesh, [*PLACES.values()], [*PLACES])
    assert torch.equal(motion.markers[-1], bound(motion.q[-1]))
    recorded = wr.read_recording(motion.write_csv(tmp_path / "finger.csv"))
    np.testing.assert_allclose(recorded.positions, motion.markers[:, 0], atol=1e-9)


def test_what_was_changed_is_saved(robot, tmp_path):
    changed = (
        robot.with_parameters(youngs_modulus=150e3)
        .integrated_by("bdf2")
        .in_gravity((0.0, 1.0, -9.0))
    )
    again = wr.load(changed.save(tmp_path / "finger.safetensors"))
    assert float(again.parameters["youngs_modulus"]) == 150e3
    assert again.simulator.integrator == "bdf2"
    assert torch.equal(moved(again).q, moved(changed).q)
    several = robot.with_parameters(youngs_modulus=torch.tensor([1e5, 2e5]).double())
    refuses(InputError, "youngs_modulus has 2 values", several.save, tmp_path / "more.safetensors")


def test_what_identify_found_is_kept(tmp_path):
    """Values, their uncertainty, by which environments differ, and places of markers."""
    name = "youngs_modulus"
    uncertainty = Uncertainty({name: 2e4}, [[1.0]], {name: 1.0}, 0.1, {name: 2e5})
    offsets = {"tip": [0.0, 0.0, 1e-3], "side": [0.0, 0.0, 0.0]}
    placement = {"offsets": offsets, "shift": [0.0] * 3, "turn": [0.0] * 3, "centre": [0.0] * 3}
    found = Identification({"youngs_modulus": 3e5}, placement=placement, uncertainty=uncertainty)
    made = Robot.of(finger(), PLACES, found)
    again, plain = wr.load(made.save(tmp_path / "finger.safetensors")), Robot.of(finger(), PLACES)
    assert again.description.uncertainty == uncertainty
    seen, nominal = (one.observe(one.simulator.rest_state())[0] for one in (again, plain))
    np.testing.assert_allclose(seen - nominal, [offsets["tip"], offsets["side"]], atol=1e-12)


def boxes(**body):
    mesh = wr.box_hexahedra((0.06, 0.02, 0.02), (6, 2, 2))
    tip, stiff = np.arange(20, 24), np.arange(0, 4)
    named = wr.Mesh(
        mesh.vertices, mesh.cells, {"tip": tip, "stiff": stiff, "rest": np.arange(4, 20)}
    )
    return named, {"fixed": select_vertices(mesh, x=0.0), **body}


def with_chambers():
    return (
        chambered("hexahedron", {"stiffness": 50.0, "angles": (10.0, -10.0)}),
        wr.Corotated(2e5, 0.4),
        {"pressure": [2e3, 0.0]},
    )


def rigid_and_muscles():
    mesh, body = boxes(
        rigid={"tip": wr.Rigid(density=900.0)},
        point_masses=[wr.PointMass(0.01, [5, 6], [0.5, 0.5])],
    )
    muscles = wr.Muscles([Muscle(np.arange(4, 20), (1.0, 0.0, 0.0), "back")], stiffness=1e3)
    per_cell = torch.linspace(1e5, 2e5, 20, dtype=torch.float64)
    energies = [muscles, Medium(density=1000.0, linear=2.0)]
    return (
        Body(mesh, energies=energies, **body),
        wr.Corotated(per_cell, 0.4),
        {"muscle_stress": [3e3]},
    )


def regions_in_contact():
    mesh, body = boxes(mass="row_sum", volume_integration="full")
    rubber = ConvexMaterial(
        c10=2e4,
        bulk_1=1e6,
        ogden={4: 1e4},
        prony=[(5e3, 0.1)],
        fibres=[FibreFamily(azimuth=0.3, tension=8e3)],
    )
    contact = wr.Contact(
        {"floor": wr.HalfSpace(position=(0.0, 0.0, -0.002), axis=(0.0, 0.0, 1.0))}, friction=0.3
    )
    materials = {"tip": wr.StableNeoHookean(1e5, 0.4), "stiff": rubber, "rest": rubber}
    return Body(mesh, energies=[contact], **body), materials, {}


def half_with_tendons():
    mesh, body = boxes(symmetry=[wr.SymmetryPlane((0.0, 1.0, 0.0))])
    guides = [[x, 0.01, 0.005] for x in (0.0, 0.03, 0.06)]
    tendons = wr.Tendons([guides], friction=0.1, stiffness=[300.0])
    return (
        Body(mesh, energies=[tendons], **body),
        wr.Corotated(2e5, 0.4),
        {"tendon_contraction": [1e-3]},
    )


@pytest.mark.parametrize(
    "parts", [with_chambers, rigid_and_muscles, regions_in_contact, half_with_tendons]
)
def test_all_parts_of_a_body_are_saved(parts, tmp_path):
    body, material, inputs = parts()
    solver = wr.SolverSettings(relative_tolerance=1e-9)
    made = Robot.of(
        Simulator(body, material, gravity=(0.1, 0.0, -9.0), time_step=0.005, solver=solver)
    )
    again = wr.load(made.save(tmp_path / "body.safetensors"))
    assert again.simulator.settings == solver
    assert again.simulator.parameters == made.simulator.parameters
    first, second = (moved(one, **inputs) for one in (made, again))
    assert torch.equal(first.q, second.q)
    assert float((first.q[-1] - first.q[0]).abs().max()) > 1e-6 or not inputs


def test_a_simulator_of_single_precision_is_saved(tmp_path):
    again = wr.load(Robot.of(finger(dtype=torch.float32)).save(tmp_path / "finger.safetensors"))
    assert again.begin().q.dtype == torch.float32


def test_what_cannot_be_saved_or_is_no_robot_is_refused(robot, tmp_path):
    @dataclass(frozen=True)
    class Mine(wr.Tendons):
        pass

    body = replace(robot.simulator.body, energies=[Mine([GUIDES])])
    path, own = tmp_path / "own.safetensors", Robot.of(replace(robot.simulator, body=body))
    refuses(
        InputError,
        r"simulator.body.energies\[0\] is of the class .*Mine.*module of its own",
        own.save,
        path,
    )
    refuses(
        InputError,
        "simulator is of a scene",
        Robot.of,
        Simulator(wr.Scene({"a": body}), {"a": wr.Corotated()}),
    )
    refuses(InputError, "simulator is of type Body", Robot.of, body)
    refuses(InputError, "markers is an array of shape", Robot.of, robot.simulator, np.zeros((2, 3)))
    refuses(
        InputError,
        "no input .* 'pressure': it has",
        Robot.of,
        robot.simulator,
        ranges={"pressure": (0, 1)},
    )
    refuses(
        InputError,
        "ranges.tendon_tension is",
        Robot.of,
        robot.simulator,
        ranges={"tendon_tension": (1, 1)},
    )
    refuses(
        InputError,
        "parameter youngs_modulus is",
        Robot.of,
        robot.simulator,
        parameters={"youngs_modulus": [1.0]},
    )
    refuses(InputError, "make a Simulator of the other body", robot.on, robot.simulator.body.mesh)


@pytest.mark.parametrize(
    "target", ["pathlib.Path", "warp_resphys.io.atomic.atomic_path", "warp_resphys.Robot"]
)
def test_a_file_makes_no_other_objects(robot, tmp_path, target):
    path = robot.save(tmp_path / "finger.safetensors")
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    content = json.loads(header["metadata"])
    content["built"]["body"]["mesh"]["_target_"] = target
    save_file(tensors, path, {**header, "metadata": json.dumps(content)})
    refuses(DataFileError, "finger.safetensors: an object in it cannot be made", wr.load, path)


def test_a_robot_far_from_where_it_rested_steps_as_there(robot):
    forces = []
    for base in (np.zeros(6), (3.0, -2.0, 2.0, 0.0, 0.0, 0.0)):
        state = robot.begin(base=base)
        for _ in range(2):
            state = robot.step(state, base=base)
        forces.append(state.reaction.force[0].detach())
    torch.testing.assert_close(forces[0], forces[1], rtol=0.0, atol=1e-7)


def test_a_lost_robot_rests_on_its_own_base(robot):
    counted = wr.Robot(robot.description, on_failure="count")
    base = np.array([3.0, 0.0, 2.0, 0.0, 0.0, 0.5])
    thrown = np.zeros(counted.simulator.rest_positions.shape)
    thrown[-1] = 1e9
    state = counted.step(counted.begin(base=base), base=base, external_force=thrown)
    assert state.lost.tolist() == [True]
    turn = np.array(
        [[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]]
    )
    np.testing.assert_allclose(
        state.q[0], robot.simulator.body.vertices @ turn.T + base[:3], atol=1e-8
    )


def test_a_lost_scene_rests_on_its_bases(robot):
    hasty = Robot.of(finger(solver=wr.SolverSettings(on_failure="count", max_iterations=2)))
    poses = {"one": (0.0, 0.2, 0.0, 0.0, 0.0, 0.0), "two": np.zeros(6)}
    calm, scene = (
        wr.RobotScene({name: (one, pose) for name, pose in poses.items()}) for one in (robot, hasty)
    )
    base = np.array([2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pushed = np.zeros(robot.simulator.rest_positions.shape)
    pushed[-1] = 10.0
    inputs = {name: {"base": base} for name in poses}
    state = scene.step(
        calm.begin(inputs=inputs), {**inputs, "two": {"base": base, "external_force": pushed}}
    )
    assert state.lost.tolist() == [True]
    np.testing.assert_allclose(
        state.q[0], scene.simulator.rest_positions + torch.as_tensor(base[:3]), atol=1e-8
    )


def test_a_state_is_written_for_paraview(robot, tmp_path):
    motion, body = moved(robot, tendon_tension=[2.0]), robot.simulator.body
    written = meshio.read(body.write_vtk(tmp_path / "finger.vtu", motion.final))
    q = motion.final.q[0].numpy()
    np.testing.assert_allclose(written.points, q)
    np.testing.assert_allclose(written.point_data["displacement"], q - body.vertices)
    reaction = robot.simulator.reaction(motion.final).force[0]
    np.testing.assert_allclose(written.point_data["reaction"].sum(0), reaction, atol=1e-9)
    assert {*meshio.read(body.write_vtk(tmp_path / "rest.vtu")).point_data} == {"displacement"}
    refuses(InputError, "positions have shape", body.write_vtk, tmp_path / "a.vtu", motion.final, 1)
    refuses(InputError, "does not end in .vtu", body.write_vtk, tmp_path / "a.pvd")


def test_on_an_arm_in_five_lines():
    mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    mount = pytest.importorskip("warp_resphys.coupling").Mount
    simulator = finger()
    model = mujoco.MjModel.from_xml_string(ARM)
    arm = mount(Robot.of(simulator), model, "arm", (0.2, 0, 0, 0, 0, 0))
    state = arm.begin(mujoco.MjData(model))
    weight = 9.80709 * float(simulator.prepare().load_mass.sum())
    np.testing.assert_allclose(state.wrench[0, :3], [0.0, 0.0, -weight], atol=1e-6)
    state = arm.step(state, tendon_tension=[1.0])
    assert arm.data(state).qvel[0] > 0.0


def test_the_code_of_the_page_runs(tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    page = (Path(__file__).parents[2] / "docs" / "robot.md").read_text(encoding="utf-8")
    section = page.partition("## From a simulator in Python\n")[2].partition("\n## ")[0]
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(ARM.replace('name="arm"', 'name="flange"'))
    monkeypatch.setattr(wr, "film", lambda motion, path: None)
    names = {"wr": wr}
    for block in re.findall(r"```python\n(.*?)```", section, flags=re.DOTALL):
        exec(block.replace("layers=8", "layers=2"), names)
    assert names["mount"].data(names["state"]).qvel[0] > 0.0
    assert names["twin"].estimator.robot.labels == ("tip",)
    assert isinstance(names["arm"], mujoco.MjModel)


def test_as_a_twin_and_in_a_scene(robot):
    twin = wr.Twin(robot)
    for number in range(3):
        assert twin.take(
            0.01 * number, {label: place for label, place in PLACES.items()}, tendon_tension=[0.5]
        )
    assert np.abs(twin.now.markers - np.array([*PLACES.values()])).max() < 2e-3
    scene = wr.RobotScene(
        {"one": (robot, np.zeros(6)), "two": (robot, (0.0, 0.1, 0.0, 0.0, 0.0, 0.0))}
    )
    seen = scene.observe(scene.step(scene.begin(), {"one": {"tendon_tension": [1.0]}}))
    assert float((seen["two"] - seen["one"])[0, 0, 2]) > 1e-5


def test_as_an_environment(robot):
    making = pytest.importorskip("warp_resphys.environments.making", exc_type=ImportError)
    pairs = making.make_vector("swing_up", robot, 2, spread=0.0, seconds=0.1)
    seen, _ = pairs.reset(seed=3)
    assert seen.shape == (2, pairs.single_observation_space.shape[0])
    _, rewards, *_ = pairs.step(np.ones((2, 1), dtype=np.float32))
    assert np.isfinite(rewards).all()
    single = making.RobotEnv("swing_up", robot, spread=0.0, seconds=0.1)
    assert single.reset(seed=0)[0].shape == seen[0].shape
    bare = Robot.of(robot.simulator)
    refuses(
        InputError, "or give Robot.of the ranges of one input", making.make_vector, "reach", bare, 1
    )
    refuses(
        InputError, "only a run folder", making.make_vector, "reach", robot, 1, world="laboratory"
    )


def test_a_mask_with_a_seed_leaves_the_noise_of_others_alone(robot):
    making = pytest.importorskip("warp_resphys.environments.making", exc_type=ImportError)
    make = {"num_envs": 2, "spread": 0.0, "seconds": 0.2, "noise": 1e-3}
    whole, masked = (making.make_vector("swing_up", robot, **make) for _ in range(2))
    action, only = np.zeros((2, 1), dtype=np.float32), {"reset_mask": np.array([True, False])}
    before = [one.reset(seed=5)[0] for one in (whole, masked)]
    np.testing.assert_array_equal(*before)
    seen, _ = masked.reset(seed=7, options=only)
    np.testing.assert_array_equal(seen[1], before[0][1])
    after = [one.step(action)[0] for one in (whole, masked)]
    np.testing.assert_array_equal(after[0][1], after[1][1])
    assert np.abs(after[0][0] - after[1][0]).max() > 0.0
    again, _ = masked.reset(seed=np.array([7, 6]))
    np.testing.assert_array_equal(again[0], seen[0])
    for wrong in ("7", [1, 2, 3], -1, 0.5):
        refuses(
            InputError,
            "seed is .*: give a whole number from zero on, or 2",
            masked.reset,
            seed=wrong,
        )
