"""The types of the public names as a type checker sees them:
mypy reads this file, and nothing runs it.
"""

from typing import Any, assert_type

import torch

import warp_resphys
from warp_resphys import Body, box_hexahedra
from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.learning.identification.search import Identification


def check(given: Any) -> None:
    """Types, and two mistakes, which must be seen: an `ignore` without an error is one."""
    simulator = warp_resphys.Simulator(Body(box_hexahedra()))
    assert_type(simulator, Simulator)
    assert_type(simulator.rollout(simulator.rest_state(), 3).q, torch.Tensor)
    assert_type(warp_resphys.identify(given, given, given), Identification)
    Body(mesh="beam.msh")  # type: ignore[arg-type]
    warp_resphys.Simulater  # type: ignore[attr-defined]  # noqa: B018
