"""A finished run as a robot: it does what the evaluation did,
by names, with gradients, and from one file.
"""

import copy
import json
import pickle
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

import warp_resphys
from support.main_job import run_without_report
from support.played_run import check_robots
from support.refusals import refuses
from support.segment_run import TRACKED, place_segment
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.safe_files import read_json, write_json

# The short segment; what is unknown of its pressures is identified.
SEGMENT = """# @package _global_
defaults: [tiny, _self_]
data: {test: 2, horizons: []}
identify:
  substeps: 2
  integrator: bdf2
  seconds: 0.1
  parameters:
    pressure_factor: {lower: 0.5, upper: 1.5}
    pressure_delay: {lower: 0.0, upper: 0.05}
    pressure_rise: {lower: 0.001, upper: 0.1, logarithmic: true}
  first_guess: {pressure_factor: 0.9, pressure_delay: 0.012, pressure_rise: 0.02}
"""
COMMAND = ["experiment=unknown_pressures", TRACKED, "solver.relative_tolerance=1e-10"]
HIGH = 6e3  # Pa


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    place_segment(folder)
    (folder / "configs" / "experiment" / "unknown_pressures.yaml").write_text(SEGMENT)
    return run_without_report(folder, *COMMAND)


@pytest.fixture(scope="module")
def robot(arm):
    return warp_resphys.load(arm, "resphys")


def played(robot, steps):
    with torch.no_grad():
        return robot.rollout(robot.begin(), pressure=wave(steps))


def wave(steps, batch=1):
    times = torch.arange(steps, dtype=torch.float64)[:, None, None]
    phase = torch.arange(2 * batch, dtype=torch.float64).reshape(1, batch, 2)
    return HIGH * torch.sin(0.4 * times + 0.7 * phase).square()


@pytest.mark.slow
class TestRollouts:
    def test_every_model_does_what_the_evaluation_wrote(self, arm):
        check_robots(arm)

    def test_steps_are_a_rollout(self, robot):
        pressure = wave(5, 2)
        start = robot.begin(batch=2)
        with torch.no_grad():
            motion = robot.rollout(start, pressure=pressure)
            state = start
            for now in pressure:
                state = robot.step(state, pressure=now)
            assert torch.equal(state.q, motion.q[-1])
            assert torch.equal(state.reaction.forces, motion.reaction.forces[-1])
            constants = robot.constants
            weight = (constants.load_mass[..., None] * constants.gravity[:, None]).sum(1)
            torch.testing.assert_close(
                start.reaction.force, -weight.expand(2, -1), rtol=0.0, atol=1e-6
            )
            one = robot.rollout(start.select([1]), pressure=pressure[:, 1:])
            further = robot.rollout(motion.final, 2, pressure=[HIGH, 0.0])
        torch.testing.assert_close(one.q[:, 0], motion.q[:, 1], atol=1e-9, rtol=0.0)
        assert motion.q.shape == (6, 2, robot.simulator.body.n_vertices, 3)
        assert motion.markers.shape == (6, 2, 3, 3)
        assert motion.half_widths.shape == (6, 2, 3)
        assert float((motion.q[-1] - motion.q[0]).abs().max()) > 1e-3
        assert torch.equal(further.q[0], motion.q[-1])
        np.testing.assert_allclose(motion.times, robot.time_step * np.arange(6))

    def test_in_threads_and_as_a_copy_it_moves_as_alone(self, robot):
        alone = [played(robot, steps).q for steps in (3, 4, 5)]
        with ThreadPoolExecutor(3) as pool:
            threads = list(pool.map(lambda steps: played(robot, steps).q, (3, 4, 5)))
        copies = [pickle.loads(pickle.dumps(robot)), copy.deepcopy(robot), copy.copy(robot)]
        for number, expected in enumerate(alone):
            assert torch.equal(threads[number], expected)
            assert torch.equal(played(copies[number], 3 + number).q, expected)
        motion = copy.deepcopy(played(robot, 3))
        assert torch.equal(
            robot.step(motion.final).q, copies[0].step(pickle.loads(pickle.dumps(motion.final))).q
        )

    def test_its_markers_are_plotted(self, robot):
        motion = played(robot, 3)
        axes = motion.plot(axis="x")
        assert [text.get_text() for text in axes.get_legend().get_texts()] == list(robot.labels)
        moved = 1e3 * (motion.markers[:, 0, :, 0] - motion.markers[0, 0, :, 0]).numpy()
        np.testing.assert_allclose(np.stack([line.get_ydata() for line in axes.lines], 1), moved)
        refuses(InputError, "environment is 1", motion.plot, environment=1)
        plt.close(axes.figure)

    def test_a_settled_robot_stays_at_rest(self, robot):
        with torch.no_grad():
            rest = robot.settle(pressure={"chamber_1": HIGH})
            motion = robot.rollout(rest, 3, pressure=[HIGH, 0.0])
            begun = robot.begin(pressure={"chamber_1": HIGH})
        assert float((motion.q - rest.q).abs().max()) < 2e-6
        # Without the learned force it rests elsewhere.
        assert float((begun.q - rest.q).abs().max()) > 1e-5

    def test_leaving_the_training_range_is_reported(self, robot):
        q = robot.begin(2).q.clone()
        q[1, :, 0] += 0.03 * (q[1, :, 2] / 0.1) ** 2  # m: it was never bent so far
        with torch.no_grad():
            motion = robot.rollout(robot.state(q), 2)
        assert motion.left[-1].tolist() == [False, True]
        assert not motion.lost.any()


@pytest.mark.slow
class TestGradients:
    def test_of_inputs_states_and_parameters(self, robot):
        def tip(pressure, factor, lift):
            own = robot.with_parameters(
                youngs_modulus=factor * robot.parameters["youngs_modulus"], pressure_factor=factor
            )
            start = own.begin()
            start = own.state(
                start.q + lift * torch.tensor([0.0, 0.0, 1.0]) * (start.q[..., 2:] < -0.05), start.v
            )
            return own.rollout(start, pressure=pressure).markers[-1, 0, 0, 0]

        values = [
            wave(3)[:, 0] + 100.0,
            torch.ones(1, dtype=torch.float64),
            torch.zeros(1, dtype=torch.float64),
        ]
        values = [value.requires_grad_(True) for value in values]
        tip(*values).backward()
        with torch.no_grad():
            # Less of a step, and float32 forces round it away.
            for at, step in ((0, 30.0), (1, 1e-2), (2, 3e-5)):
                change = torch.zeros_like(values[at])
                change.view(-1)[0] = step
                ends = [
                    tip(*(x + s * change if i == at else x for i, x in enumerate(values)))
                    for s in (1.0, -1.0)
                ]
                difference = float(ends[0] - ends[1]) / (2.0 * step)
                assert float(values[at].grad.view(-1)[0]) == pytest.approx(difference, rel=1e-4)

    def test_each_environment_has_its_own_parameters(self, robot):
        moduli = robot.parameters["youngs_modulus"] * torch.tensor(
            [0.7, 1.0, 1.4], dtype=torch.float64
        )
        rises = torch.tensor([0.001, 0.02, 0.1], dtype=torch.float64)
        delays = torch.tensor([0.0, 0.013, 0.03], dtype=torch.float64)
        with torch.no_grad():
            own = robot.with_parameters(
                youngs_modulus=moduli, pressure_rise=rises, pressure_delay=delays
            )
            together = own.rollout(own.begin(3), pressure=wave(4))
            for row in range(3):
                one = robot.with_parameters(
                    youngs_modulus=moduli[row], pressure_rise=rises[row], pressure_delay=delays[row]
                )
                alone = one.rollout(one.begin(), pressure=wave(4))
                torch.testing.assert_close(alone.q[:, 0], together.q[:, row], atol=1e-9, rtol=0.0)
        assert float((together.q[-1, 0] - together.q[-1, 2]).abs().max()) > 1e-4


@pytest.mark.slow
class TestFiles:
    def test_a_table_is_read_as_a_recording(self, robot, tmp_path):
        motion = played(robot, 6)
        path = motion.write_csv(tmp_path / "motion.csv")
        header, *rows = path.read_text().splitlines()
        assert header.split(",")[:4] == ["time [s]", "T1.x [m]", "T1.y [m]", "T1.z [m]"]
        assert header.split(",")[-2:] == ["pressure.chamber_1 [Pa]", "pressure.chamber_2 [Pa]"]
        assert len(rows) == 7
        recording = warp_resphys.read_recording(path)
        assert tuple(recording.labels) == robot.labels
        np.testing.assert_allclose(recording.positions, motion.markers[:, 0].numpy(), atol=1e-9)

    def test_a_series_for_paraview(self, robot, tmp_path):
        import pyvista

        motion = played(robot, 3)
        reader = pyvista.get_reader(motion.write_vtk(tmp_path / "arm.pvd"))
        np.testing.assert_allclose(reader.time_values, motion.times)
        reader.set_active_time_value(motion.times[-1])
        body = reader.read()[0]
        assert body.n_cells == len(robot.simulator.body.mesh.cells)
        np.testing.assert_allclose(body.points, motion.q[-1, 0].numpy(), atol=1e-9)
        rest = robot.simulator.body.mesh.vertices
        np.testing.assert_allclose(
            body.point_data["displacement"], motion.q[-1, 0].numpy() - rest, atol=1e-9
        )
        dots = pyvista.get_reader(tmp_path / "arm_markers.pvd")
        dots.set_active_time_value(motion.times[-1])
        np.testing.assert_allclose(dots.read()[0].points, motion.markers[-1, 0].numpy(), atol=1e-9)

    def test_a_scene_in_usd(self, robot, tmp_path):
        pytest.importorskip("pxr", reason="the extra usd is not installed")
        from pxr import Usd, UsdGeom

        motion = played(robot, 3)
        for name in ("arm.usda", "arm.usd"):
            stage = Usd.Stage.Open(str(motion.write_usd(tmp_path / name)))
            assert UsdGeom.GetStageUpAxis(stage) == "Z"
            assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(
                motion.times[-1]
            )
            body = UsdGeom.Mesh(stage.GetPrimAtPath("/robot/body"))
            at = np.array(body.GetPointsAttr().Get(3.0))
            kept = np.unique(
                warp_resphys.core.mesh.volume_mesh.boundary_triangles(robot.simulator.body.mesh)
            )
            np.testing.assert_allclose(at, motion.q[3, 0].numpy()[kept], atol=1e-6)
            faces = np.array(body.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            corners = at[faces]
            volume = (
                np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
            )
            assert volume > 1e-5  # m^3: faces look outwards


@pytest.mark.slow
class TestBadInput:
    @pytest.mark.parametrize(
        ("call", "sentence"),
        [
            (lambda r, s: r.step(s, presure=[0.0]), "'presure'"),

            (lambda r, s: r.step(s, pressure={"3": 1.0}), "'3': it has 'chamber_1', 'chamber_2'"),
            (lambda r, s: r.step(s, pressure=[1.0, 2.0, 3.0]), r"pressure has shape \(1, 3\)"),
            (lambda r, s: r.step(s, pressure=[float("nan"), 0.0]), "pressure has values that are "
                                                                   "not finite"),

            (lambda r, s: r.step(s, base=[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]), "base moves by 500 mm "
                                                                          "in a step of"),
            (lambda r, s: r.rollout(s, pressure=[0.0, 0.0]), "steps"),
            (lambda r, s: r.with_parameters(youngs=1.0), "'youngs'.*youngs_modulus"),
            (lambda r, s: r.save("robot.pt"), ".safetensors"),
            (lambda r, s: r.rollout(s, 1).write_vtk("a.vtk"), ".pvd"),
            (lambda r, s: warp_resphys.recorded_trial(r, "t9"), "'t9': .* has 't000'"),
        ],
    )  # fmt: skip
    def test_calls(self, robot, call, sentence):
        refuses(InputError, sentence, call, robot, robot.begin())

    def test_models_and_files(self, arm, robot, tmp_path):
        refuses(
            InputError,
            r"'resfys': .* has 'simulation', .*'sysid'",
            warp_resphys.load,
            arm,
            "resfys",
        )
        kept = robot.save(tmp_path / "robot.safetensors")
        refuses(InputError, r"'sysid', but .* 'resphys'", warp_resphys.load, kept, "sysid")
        refuses(InputError, "no trials", warp_resphys.trial_names, warp_resphys.load(kept))
        kept.write_bytes(kept.read_bytes()[:-9])
        refuses(DataFileError, "not a complete safetensors file", warp_resphys.load, kept)

    def test_a_folder_without_a_run(self, tmp_path):
        refuses(DataFileError, "does not exist", warp_resphys.load, tmp_path / "nothing")
        refuses(DataFileError, "not a run folder", warp_resphys.load, tmp_path)
        (tmp_path / "pulls.csv").write_text("time [s]\n")
        with pytest.raises(
            DataFileError,
            match=r"pulls\.csv is no robot: name a run folder, or a \.safetensors file",
        ):
            warp_resphys.load(tmp_path / "pulls.csv")

    @pytest.mark.parametrize(
        ("file", "change", "sentence"),
        [
            ("stages/evaluate.json", {"versions": {"warp-resphys": "9.4.0"}}, r"9\.4\.0.*0\.1\.0"),
            ("stages/train_resphys.json", {"fingerprint": "other"}, "'train_resphys'"),
            ("stages/train_resphys.json", None, "'train_resphys' was not completed"),
            ("resphys.safetensors", None, "resphys.safetensors is missing or has changed"),
        ],
    )
    def test_an_unfinished_or_changed_run_is_refused(self, arm, tmp_path, file, change, sentence):
        folder = Path(shutil.copytree(arm, tmp_path / "run"))
        if change is None:
            (folder / file).unlink()
        else:
            write_json(folder / file, {**read_json(folder / file), **change})
        refuses(DataFileError, sentence, warp_resphys.load, folder)

    def test_a_simulator_can_be_loaded_before_the_run_is_evaluated(self, arm, tmp_path):
        folder = Path(shutil.copytree(arm, tmp_path / "run"))
        for name in (
            "stages/evaluate.json",
            "errors.json",
            "rollouts.h5",
            "stages/train_resphys.json",
        ):
            (folder / name).unlink()
        early, late = warp_resphys.load(folder, "sysid"), warp_resphys.load(arm, "sysid")
        assert early.description.parameters == late.description.parameters
        assert early.description.errors_mm is None
        name = warp_resphys.trial_names(early)[0]
        one, other = (warp_resphys.recorded_trial(robot, name) for robot in (early, late))
        torch.testing.assert_close(one.start.q, other.start.q)
        refuses(DataFileError, "was not completed", warp_resphys.load, folder)
        (folder / "stages/identify.json").unlink()
        refuses(DataFileError, "was not completed", warp_resphys.load, folder, "sysid")


@pytest.mark.slow
def test_its_description(robot, arm):
    text = repr(robot)
    advised = read_json(arm / "metrics.json")["recommended"]
    assert f"run, {advised} (recommended): " in repr(warp_resphys.load(arm))
    for part in (
        "run, resphys (",
        "3 markers",
        "pressure [Pa]: chamber_1, chamber_2",
        "pressure_delay: ",
        "error",
    ):
        assert part in text
    low, high = robot.inputs["pressure"].low, robot.inputs["pressure"].high
    assert low[0] >= 0.0
    assert 1e3 < high[0] <= 2.1e4
    errors = json.loads((arm / "errors.json").read_text())["errors_mm"]["resphys"]
    assert robot.description.errors_mm == errors


@pytest.mark.slow
def test_the_lines_of_the_readme(tmp_path, monkeypatch):
    """A beam of two silicones, which README.md simulates as one:
    the corrected robot is right under another pull.
    """
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"<!-- robot -->\n```python\n(.*?)```", text, flags=re.DOTALL)
    monkeypatch.chdir(tmp_path)
    phase = 0.04 * torch.arange(1, 81, dtype=torch.float64)
    record_pulls("pulls.csv", 3.0 * torch.sin(phase).square())
    record_pulls("others.csv", 1.5 - 1.5 * torch.cos(2.75 * phase))
    names = {}
    exec(compile(lines, "README.md", "exec"), names)
    other = warp_resphys.read_recording("others.csv")
    inputs = warp_resphys.Inputs(tendon_tension=torch.from_numpy(other.actuation[1:, None]))
    simulator, seen = names["simulator"], torch.from_numpy(other.positions)
    motion = warp_resphys.ObservedMotions.of(
        simulator, seen, simulator.rest_state(), inputs, observation=names["markers"]
    )
    uncorrected, identified, corrected = (
        warp_resphys.evaluate(simulator, motion, force, parameters=material).mean()
        for force, material in (
            (None, None),
            (None, names["material"]),
            (names["force"], names["material"]),
        )
    )
    assert corrected < 0.4 * identified < 0.4 * uncorrected
    assert corrected < 2e-4  # m


def record_pulls(path, tension):
    """Writes markers of a beam of a stiff and a soft silicone
    that a tendon pulls, with noise of 0.02 mm.
    """
    box = warp_resphys.box_hexahedra(size=(0.1, 0.03, 0.03), divisions=(8, 2, 2))
    root = box.vertices[box.cells].mean(axis=1)[:, 0] < 0.05
    halves = {"root": np.flatnonzero(root), "tip": np.flatnonzero(~root)}
    mesh = warp_resphys.quadratic(warp_resphys.Mesh(box.vertices, box.cells, halves))
    tendon = warp_resphys.Tendons([[[x, 0.015, 0.003] for x in (0.0, 0.05, 0.1)]])
    body = warp_resphys.Body(
        mesh, fixed=warp_resphys.select_vertices(mesh, x=0.0), energies=[tendon]
    )
    silicones = {
        name: warp_resphys.Corotated(modulus, 0.45, density=1070.0, stiffness_damping=0.01)
        for name, modulus in (("root", 400e3), ("tip", 150e3))
    }
    real = warp_resphys.Simulator(body, silicones, time_step=0.01)
    names = [f"marker{number}" for number in range(6)]
    places = [[x, y, 0.03] for x in (0.1, 0.07, 0.04) for y in (0.0, 0.03)]
    markers = warp_resphys.bind_markers(mesh, places, names)
    inputs = warp_resphys.Inputs(tendon_tension=tension[:, None, None])
    q = real.rollout(real.rest_state(), len(tension), inputs).q
    seen = torch.cat([markers(positions) for positions in q]).numpy()
    seen += 2e-5 * np.random.default_rng(0).standard_normal(seen.shape)
    head = ",".join(
        ["time [s]", *(f"{name}.{axis} [m]" for name in names for axis in "xyz"), "tendon [N]"]
    )
    columns = [0.01 * np.arange(len(seen)), seen.reshape(len(seen), -1), np.append(0.0, tension)]
    np.savetxt(path, np.column_stack(columns), "%.7f", ",", header=head, comments="")
