"""Learned forces that are accurate and yet refused:
without equilibrium, away from rest, or felt by a sensor.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.clamped import clamped
from warp_resphys.learning.acceptance import Acceptance
from warp_resphys.learning.observed_motions import Identified, ObservedMotions
from warp_resphys.learning.residuals.correction import Learned
from warp_resphys.learning.scores import HeldOutTest, text_of

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
TIP = wr.select_vertices(MESH, x=0.1)
CABLE = wr.Tendons([[[0.0, 0.01, 0.02], [0.05, 0.01, 0.02], [0.1, 0.01, 0.02]]])
STEPS = 20


class HandMade(torch.nn.Module):
    """A force at the tip as a function of its height and of the inputs,
    in place of a trained network.
    """

    def __init__(self, push, acts="internal"):
        super().__init__()
        self.rest, self.linear = torch.as_tensor(MESH.vertices), torch.zeros(1, dtype=torch.float64)
        self.push, self.acts = push, acts

    def encode(self, q, v, context):
        heights = q[:, TIP, 2].mean(1, keepdim=True)
        return heights if context is None else torch.cat([heights, context], 1)

    def decode(self, inputs):
        force = torch.zeros(len(inputs), *self.rest.shape, dtype=torch.float64)
        force[:, TIP, 2] = self.push(inputs)[:, None]
        return [force]


@pytest.fixture(scope="module")
def recorded():
    """A beam at rest that a tendon then bends, which stays bent; a force sensor at its clamp."""
    simulator = wr.Simulator(
        clamped(MESH, energies=[CABLE]),
        wr.Corotated(264e3, 0.45, stiffness_damping=0.2),
        time_step=0.05,
    )
    ramp = torch.linspace(0.0, 1.0, STEPS, dtype=torch.float64).mul(4.0).clamp_max(1.0)
    tension = ramp[:, None, None] * torch.tensor([[0.5], [1.0]], dtype=torch.float64)
    resting = wr.Inputs(tendon_tension=torch.zeros(2, 1, dtype=torch.float64))
    start = simulator.static_equilibrium(resting)
    motion = simulator.rollout(start, STEPS, wr.Inputs(tendon_tension=tension))
    clamp = wr.ForceSensor(axes=("fx", "fy", "fz"), noise=1e-3)
    read = torch.stack(
        [clamp(simulator.reaction(start)), *(clamp(one) for one in _by_step(motion))]
    )
    given = {"resting": resting, "inputs": wr.Inputs(tendon_tension=tension)}
    given |= {"sensors": {"clamp": clamp}, "loads": {"clamp": read}}
    return simulator, ObservedMotions.of(simulator, motion.q, **given)


def _by_step(motion):
    held = motion.reaction
    return [type(held)(held.vertices, f, p) for f, p in zip(held.forces, held.places, strict=True)]


def objections(recorded, push, acts="internal", sensing=False):
    simulator, motions = recorded
    if not sensing:
        motions = replace(motions, sensors={}, trials=replace(motions.trials, loads={}))
    names = motions.trials.names
    return Acceptance(simulator, motions, Identified(), 0.3).objections(
        Learned(HandMade(push, acts)), names, names
    )


def turning(inputs, where):
    """A push that turns round at a height, where there is then no equilibrium."""
    return -0.02 * torch.sign(inputs[:, 0] - where)


def test_a_small_force_is_accepted(recorded):
    assert (
        objections(recorded, lambda inputs: 1e-4 * torch.ones(len(inputs), dtype=torch.float64))
        == []
    )


def test_a_force_without_equilibrium_at_rest_is_refused(recorded):
    simulator, _ = recorded
    height = float(simulator.static_equilibrium().q[0, TIP, 2].mean())
    (first, *_) = objections(recorded, lambda inputs: turning(inputs, height))
    assert first == "at rest the robot has no equilibrium with it"


def test_a_force_without_equilibrium_under_the_inputs_of_one_trial_is_refused(recorded):
    """Its tension is 1 N; the force does nothing below 0.8 N."""
    simulator, _ = recorded
    pulled = wr.Inputs(tendon_tension=torch.ones(1, 1, dtype=torch.float64))
    height = float(simulator.static_equilibrium(pulled).q[0, TIP, 2].mean())
    (only,) = objections(
        recorded, lambda inputs: torch.where(inputs[:, 1] > 0.8, turning(inputs, height), 0.0)
    )
    assert (
        only
        == "under constant inputs of the training ('motion 1') the robot has no equilibrium with it"
    )


def test_a_force_that_moves_a_resting_body_is_refused(recorded):
    found = objections(
        recorded, lambda inputs: torch.full((len(inputs),), 0.05, dtype=torch.float64)
    )
    assert [text.split(" the robot is ")[0] for text in found] == [
        "at rest",
        "under constant inputs of the training",
    ]
    assert all(text.endswith(" mm without") for text in found)


def test_a_force_that_a_sensor_would_feel_is_refused(recorded):
    push = lambda inputs: torch.full((len(inputs),), 2e-3, dtype=torch.float64)  # noqa: E731
    assert objections(recorded, push, sensing=True) == []
    (felt,) = objections(recorded, push, "external", sensing=True)
    assert felt.startswith("the predicted readings of the force sensor clamp are off by 0.00")


def test_the_refusal_is_in_the_test():
    test = HeldOutTest(
        trials=["a"], split="validation", error_mm=1.0, below_mm=2.0, used=False, refused=["why"]
    )
    assert text_of(test).endswith("2 mm; it is refused: why")
    assert not np.isnan(test["error_mm"])
