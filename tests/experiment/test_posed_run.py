"""Poses under tendons, recorded without header, names or order of their markers,
from a table to the report.
"""

import numpy as np
import pytest
import torch

import warp_resphys
from support.configured import settings
from support.main_job import finish, run_without_report
from support.played_run import check_robots
from support.report_page import FAILING
from warp_resphys.core.mesh.arm_dimensions import ArmMesh
from warp_resphys.core.stepping.inputs import Inputs
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.build import bound_markers, build_simulator, finer
from warp_resphys.io.safe_files import read_array, read_hdf5, read_json
from warp_resphys.learning.identification.search import Identification
from warp_resphys.report import render
from warp_resphys.report.identification_section import trials_table
from warp_resphys.settings.body import MaterialSettings
from warp_resphys.settings.meshing import FileMesh, HexahedralBox, RodMesh, ShippedArm

MODULUS = 420e3  # Pa, of the body that is recorded; the experiment expects 505 kPa
OFFSETS = {"first": 1e-3, "second": -8e-4}  # m, around the axis, by which its tendons run elsewhere
POSES = {
    "weak": (0.5, 0.0),
    "strong": (1.5, 0.0),
    "second": (0.0, 1.5),
    "other": (0.0, 1.0),
    "both": (1.0, 1.0),
}
TINY = [
    "experiment=tentacle",
    "mesh.layers=4",
    "mesh.nodes=20",
    "parallel.processes=1",
    "markers.patch=0.05",
    "tendons.routes.first.pieces=6",
    "tendons.routes.second.pieces=6",
    "data.folder=recordings",
    "data.folds=null",
    "data.train=[weak,strong,second]",
    "data.validation=[other]",
    "data.test=[both]",
    "identify.max_evaluations=6",
    "trainer={epochs:2,rollout_every:2,batch_size:16}",
    "network={position_modes:1,force_modes:2,width:8}",
    *("in_the_loop.epochs=1", "simfree.network.position_modes=1", "~identify.parameters.density"),
    # weak poses do not show them
    *(f"~identify.parameters.tendon_offset_2_{name}" for name in OFFSETS),
]


def trials(tensions=POSES, sessions=None):
    """Options with the trials of the poses."""
    named = {name: f", session: {session}" for name, session in (sessions or {}).items()}
    rows = (
        f"{n}: {{file: {n}.csv, inputs: {list(own)}{named.get(n, '')}}}"
        for n, own in tensions.items()
    )
    return ["data.trials=null", f"+data.trials={{{','.join(rows)}}}"]


@pytest.fixture(scope="module")
def poses():
    """(5, 5, 3) where the markers of the poses are in the frame of the body [m].

    Its tendons run elsewhere.
    """
    run = settings(*TINY, *trials())
    routes = {}
    for name, route in run.tendons.routes.items():
        guides = np.array(route.guides) + OFFSETS[name] * np.array(route.offsets[0])
        routes[name] = {"guides": guides.tolist(), "pieces": route.pieces}
    material = MaterialSettings(**{**run.simulation.plain(), "youngs_modulus": MODULUS})
    simulator = build_simulator(run.changed(tendons=run.tendons.changed(routes=routes)), material)
    places = np.array([*run.markers.tracked.values()])
    read = bound_markers(run.markers, simulator.body.mesh, places, tuple(run.markers.tracked))
    tensions = torch.tensor([*POSES.values()], dtype=torch.float64)
    at = read(simulator.static_equilibrium(Inputs(tendon_tension=tensions)).q).numpy()
    return np.concatenate(
        [at, np.broadcast_to([*run.markers.reference.values()], (len(at), 1, 3))], 1
    )


def write(folder, places_of_poses):
    """Files as a tracker writes them: no header, another order in each,
    y against the rod, 0.1 mm of noise.
    """
    folder.mkdir()
    draw = np.random.default_rng(0)
    for name, places in zip(POSES, places_of_poses, strict=True):
        # So that (x, z, -y) turns it back.
        turned = np.stack([places[:, 0], -places[:, 2], places[:, 1]], -1)
        row = turned[draw.permutation(5)] + [0.3, 0.4, -0.1]
        frames = row.ravel() + 1e-4 * draw.normal(size=(40, 15))
        table = np.column_stack([np.arange(40), np.arange(40) / 200.0, frames])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", fmt="%.6f")


def test_poses_of_unnamed_markers_identify_the_body(poses, folder, monkeypatch):
    monkeypatch.setattr(render, "COMMAND", FAILING)  # Bodies are drawn in tests of reports.
    write(folder / "recordings", poses)
    run = finish(*TINY, *trials())
    dataset = Trials.read(run / "dataset.h5")
    rows = [dataset.names.index(name) for name in POSES]
    assert set(dataset.begins) == {"static"}
    # Named and turned back.
    np.testing.assert_allclose(dataset.observed[rows, 0], poses[:, :4], atol=3e-4)
    np.testing.assert_allclose(
        dataset.inputs["tendon_tension"][rows, 0], [*POSES.values()], atol=1e-12
    )
    identified = read_json(run / "identification.json")["sysid"]["parameters"]
    assert identified["youngs_modulus"] == pytest.approx(MODULUS, rel=0.01)
    assert {name: identified[f"tendon_offset_1_{name}"] for name in OFFSETS} == pytest.approx(
        OFFSETS, abs=2e-4
    )
    page, metrics = (run / "report.html").read_text(), read_json(run / "metrics.json")
    assert "Tendon offset 1 first" in page
    errors = {name: summary["mean"] for name, summary in metrics["errors_mm"].items()}
    assert 5.0 * errors["sysid"] < errors["simulation"]
    assert {"simfree", "resphys"} <= errors.keys()
    # One pose is no test.
    assert metrics["networks"]["resphys"]["test"]["trials"] == ["weak", "strong", "second"]
    checked = metrics["mesh_check"]
    assert checked["cells"][1] == 1.5 * checked["cells"][0] == 30
    assert 0.1 < checked["moved_mm"] < 10.0
    assert "With 30 instead of 20 cells and the same parameters, SysID moves the markers by" in page
    check_robots(run)


@pytest.mark.slow
def test_sessions_have_their_markers_and_trials_their_gains(poses, tmp_path):
    """Between two sessions a marker moved by 4 mm; one tension is 7 % larger than its log says."""
    sessions = {
        "weak": "monday",
        "strong": "monday",
        "other": "friday",
        "second": "friday",
        "both": "friday",
    }
    logged = {**POSES, "strong": (1.5 / 1.07, 0.0)}
    moved = poses.copy()
    moved[
        [list(POSES).index(name) for name, session in sessions.items() if session == "friday"], 1, 2
    ] -= 4e-3
    write(tmp_path / "recordings", moved)
    gain = "{lower: 0.7, upper: 1.3, per: trial, prior: {mean: 1.0, deviation: 0.05}}"
    folder = run_without_report(
        tmp_path,
        *TINY,
        *trials(logged, sessions),
        f"+identify.parameters.tendon_tension_factor={gain}",
        *("mesh_check=null", "identify.max_evaluations=8"),
    )
    assert (
        dict(zip((data := Trials.read(folder / "dataset.h5")).names, data.sessions, strict=True))
        == sessions
    )
    found = read_json(folder / "identification.json")["sysid"]
    own = {
        name.removeprefix("tendon_tension_factor@"): value
        for name, value in found["of_trials"].items()
    }
    assert (
        own.keys()
        == {"weak", "strong", "second"}
        == {name.split("@")[1] for name in found["of_trials_deviation"]}
    )
    assert own["strong"] - 0.5 * (own["weak"] + own["second"]) > 0.03
    assert found["parameters"]["tendon_tension_factor"] == 1.0
    assert found["uncertainty"]["deviation"]["tendon_tension_factor"] == 0.05
    assert not any("@" in name for name in found["uncertainty"]["deviation"])
    monday, friday = (
        found["placement"]["sessions"][session]["offsets"] for session in ("monday", "friday")
    )
    further, other = (friday[marker][2] - monday[marker][2] for marker in ("M2", "M3"))
    # The frame of a session may be shifted, too.
    assert further - other == pytest.approx(-4e-3, abs=1.2e-3)
    table = trials_table(Identification.from_plain(found))
    assert [row.head for row in table.rows] == ["weak", "strong", "second"]
    # A new trial has a gain that is not known.
    with read_hdf5(folder / "rollouts.h5", "rollouts") as file:
        assert 1e3 * np.sqrt(read_array(file, "sysid_spread").max()) > 1.0
    robot = warp_resphys.load(folder, "sysid")
    assert "tendon_tension_factor@strong" not in robot.description.parameters
    shown = warp_resphys.recorded_trial(robot, "both")
    assert float(shown.errors_mm(shown.play(robot)).mean()) < 20.0


def test_a_finer_mesh_has_so_many_times_as_many_cells():
    box = HexahedralBox(kind="box_hexahedra", size=[0.1, 0.03, 0.03], divisions=[5, 2, 1])
    assert finer(box, 1.5) == box.changed(divisions=[8, 3, 2])
    rod = RodMesh(kind="rod", centreline=[[0, 0, 0], [0, 0, 1]], radii=0.1, layers=4)
    assert finer(rod, 2.0) == rod.changed(layers=8)
    arm = ArmMesh(kind="arm_generated", size=0.006)
    assert finer(arm, 2.0) == arm.changed(size=0.003)
    assert finer(arm.changed(layers=0.01), 2.0) == arm.changed(size=0.003, layers=0.005)
    assert finer(file := FileMesh(kind="file", path="a.vtk"), 2.0) == file.changed(order=2)
    shipped = [ShippedArm(kind="arm", name=f"arm_hexahedra_{size}") for size in (500, 1400, 2000)]
    assert [finer(arm, 1.5) for arm in shipped] == [*shipped[1:], shipped[2]]


@pytest.mark.slow
def test_intervals_of_another_session_come_from_poses_left_out_of_the_training(poses, tmp_path):
    """Without validation poses, and with markers that may sit 3.4 mm elsewhere
    in the session of the test pose.
    """
    write(tmp_path / "recordings", poses)
    sessions = dict.fromkeys(POSES, "monday") | {"both": "friday"}
    training = [
        "data.train=[weak,strong,second,other]",
        "data.validation=[]",
        "in_the_loop.hold_out=false",
    ]
    quick = ["mesh_check=null", "trainer.epochs=1"]
    folder = run_without_report(tmp_path, *TINY, *trials(POSES, sessions), *training, *quick)
    intervals = read_json(folder / "errors.json")["intervals"]
    assert intervals["calibrated_on"] == "left_out"
    found = read_json(folder / "identification.json")["sysid"]
    assert [*found["uncertainty"]["left_out"]] == ["weak", "strong", "second", "other"]
    assert found["placement"]["new_session"][0][0] == pytest.approx(
        0.005 * np.sqrt(0.25 + 1.0 / 5.0)
    )
    own = intervals["models"]["sysid"]
    assert own["coverage"] == 1.0  # The markers have not moved.
    assert own["half_width_mm"] > 1e3 * found["placement"]["new_session"][0][0]
