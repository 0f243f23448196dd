"""Arguments of another type, or in another place, than a function takes:
one sentence that says what to give.
"""

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.refusals import refuses
from warp_resphys import InputError, Inputs

MESH = wr.box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
TENDONS = wr.Tendons([[[x, 0.01, 0.005] for x in (0.0, 0.03, 0.06)]])
BODY = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0), energies=[TENDONS])
RUBBER = wr.Corotated(2e5, 0.4)
SIMULATOR = wr.Simulator(BODY, RUBBER)
STATE = SIMULATOR.rest_state()
ROBOT = wr.Robot.of(SIMULATOR)
STEPPED = SIMULATOR.step(STATE)
SEEN = wr.ObservedMotions.of(
    SIMULATOR, torch.stack([STATE.q[0], STEPPED.q[0].detach()]), start=STATE
)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: wr.SolverSettings("newton"), r"name it, as in SolverSettings\(name='newton'\)"),
        (lambda: wr.HalfSpace((0, 0, 1)), r"as in HalfSpace\(position=\(0, 0, 1\)\)"),
        (
            lambda: float(SIMULATOR.parameters["youngs_modulus"]),
            "youngs_modulus is declared here.*`defaults`",
        ),
        (lambda: wr.Simulator(MESH, RUBBER), "the body is of type Mesh: it must be .*Body"),
        (lambda: wr.Simulator(RUBBER, BODY), "the body is of type Corotated"),
        (
            lambda: wr.Simulator(BODY, "corotated"),
            "the material is of type str: .*Material or a mapping",
        ),
        (lambda: wr.Simulator(BODY, RUBBER, time_step="0.01"), "time_step is of type str"),
        (lambda: wr.Body(MESH.vertices), "Body: mesh is an array of shape"),
        (
            lambda: wr.Body(MESH, energies=TENDONS),
            "Body: energies is of type Tendons: it must be a list",
        ),
        (lambda: wr.Body(MESH, energies=[RUBBER]), r"Body: energies\[0\] is of type Corotated"),
        (
            lambda: wr.Body(MESH, rigid={"tip": 1000.0}),
            r"Body: rigid\['tip'\] is of type float: .*Rigid",
        ),
        (lambda: wr.Scene([BODY]), "Scene: bodies is of type list: it must be a mapping"),
        (
            lambda: wr.Contact(wr.HalfSpace(axis=(0, 0, 1))),
            "Contact: obstacles is of type HalfSpace",
        ),
        (
            lambda: wr.Pressure([np.zeros((2, 4), dtype=int)]),
            r"chambers\[0\] is an array of shape .*Chamber",
        ),
        (lambda: wr.bind_markers(BODY, [[0.06, 0.01, 0.02]], ["tip"]), "mesh is of type Body"),
        (
            lambda: wr.bind_markers(MESH, [[0.06, 0.01, 0.02]], "tip"),
            "names is of type str: it must be a list",
        ),
        (lambda: SIMULATOR.step(STATE.q), "the state is an array of shape .*State"),
        (
            lambda: SIMULATOR.step(STATE, Inputs(), [1.0]),
            "parameters is of type list: it must be a mapping",
        ),
        (lambda: SIMULATOR.rollout(STATE, Inputs()), "steps is of type Inputs: it must be int"),
        (
            lambda: SIMULATOR.rollout(3),
            "missing a required argument: 'steps': its arguments are state, steps, inputs",
        ),
        (lambda: SIMULATOR.static_equilibrium(STATE), "inputs is of type State: .*Inputs or None"),
        (
            lambda: SIMULATOR.reaction(STEPPED, Inputs()),
            "at is of type Inputs: it must be str or .*SymmetryPlane",
        ),
        (lambda: SIMULATOR.reaction(STEPPED.q), "state is an array of shape"),
        (lambda: STEPPED.reaction.at({}), "vertices is of type dict: it must be .*an array"),
        (lambda: SIMULATOR.state("rest"), "values are of type str: give numbers"),
        (
            lambda: ROBOT.step(STATE, {"tendon_tension": 1.0}),
            "Robot.step: too many positional arguments",
        ),
        (
            lambda: ROBOT.rollout(STATE, {"tendon_tension": 1.0}),
            "steps is of type dict: it must be int or None",
        ),
        (lambda: ROBOT.begin(STATE), "batch is of type State"),
        (lambda: ROBOT.in_gravity("z"), "gravity is z: it must be three finite accelerations"),
        (lambda: wr.Robot(SIMULATOR), "description is of type Simulator"),
        (
            lambda: wr.Robot.of(SIMULATOR, parameters=3),
            "parameters is of type int: .*Identified or a mapping or None",
        ),
        (lambda: wr.RobotScene([ROBOT]), "robots is of type list: it must be a mapping"),
        (lambda: wr.load(ROBOT), "path is of type Robot: it must be str or pathlib.Path"),
        (lambda: wr.film(STATE.q, "a.mp4"), "motion is an array of shape .*Motion"),
        (lambda: wr.identify(SEEN, SIMULATOR, {}), "simulator is of type ObservedMotions"),
        (
            lambda: wr.identify(
                SIMULATOR, SEEN, {"youngs_modulus": (1e5, 3e5)}, seed=np.array([1, 2])
            ),
            r"seed is an array of shape \(2,\): it must be int",
        ),
    ],
)
def test_a_sentence_says_what_to_give(call, said):
    refuses(InputError, said, call)


def test_what_is_like_a_type_is_taken(tmp_path):
    assert len(SIMULATOR.rollout(STATE, np.int64(2)).q) == 3
    assert len(SIMULATOR.reaction(STEPPED, (0,)).vertices) == 1
    assert len(SIMULATOR.reaction(STEPPED, torch.tensor([0, 1])).vertices) == 2
    assert len(wr.Body(MESH, fixed=range(4), energies=(TENDONS,)).fixed_vertices) == 4
    assert wr.load(ROBOT.save(str(tmp_path / "robot.safetensors"))).labels == ()
