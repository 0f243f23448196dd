"""The interface of an energy: values of its parts, its memory, and where its points act."""

import numpy as np
import pytest
import torch

from warp_resphys import Body
from warp_resphys.energies.base import EnergySite, Memory, PointSet
from warp_resphys.energies.launcher import Launcher
from warp_resphys.energies.muscles import Muscle, Muscles
from warp_resphys.energies.part_terms import PartPoints, PartTerm
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.stepping.constants import Constants
from warp_resphys.stepping.integrators import INTEGRATORS

MESH = box_hexahedra((0.04, 0.02, 0.02), (4, 1, 1))
MUSCLES = Muscles([Muscle([0, 1, 2], (1.0, 0.0, 0.0), "long"), Muscle([3], (0.0, 1.0, 0.0), "short")], 1e4)


def test_values_of_a_parameter_go_to_the_parts():
    quantity = next(q for q in MUSCLES.parameters if not q.shape)
    for given, expected in (([[3.0]], [[3.0, 3.0]]), ([[1.0, 2.0], [3.0, 4.0]], [[1.0, 2.0], [3.0, 4.0]])):
        assert MUSCLES.per_part(quantity, torch.tensor(given)).tolist() == expected
    with pytest.raises(InputError, match=quantity.name):
        MUSCLES.per_part(quantity, torch.ones(1, 3))


def test_energies_of_points_are_summed_by_part():
    (points,) = MUSCLES.points(MESH)
    assert isinstance(points, PartPoints)
    launcher = Launcher(2, torch.device("cpu"))
    everywhere = slice(0, points.n_points)
    s = PointSet(launcher, points, len(MESH.vertices), everywhere, everywhere)
    term = MUSCLES.term(launcher, [s])
    assert isinstance(term, PartTerm)
    volumes = term.sum_parts(torch.as_tensor(points.weights)[None])  # that of a cell is 1e-6 of the box of 4
    np.testing.assert_allclose(volumes, [[3 * 4e-6, 4e-6]], rtol=1e-12)
    start, incident = s.start.numpy(), s.incident.numpy()
    for vertex in range(len(MESH.vertices)):
        own = incident[start[vertex] : start[vertex + 1]]
        assert set(own) == set(np.flatnonzero(points.nodes.ravel() == vertex))


@pytest.mark.parametrize(
    "values", [torch.zeros(2, 4).double(), torch.zeros(3, 3).double(), torch.zeros(2, 3), torch.full((2, 3), torch.nan)]
)
def test_a_memory_of_another_shape_or_type_is_refused(values):
    memory, like = Memory("slack", "m", (3,), "string"), torch.zeros(1).double()
    memory.check(torch.zeros(2, 3).double(), 2, like)
    with pytest.raises(InputError, match="slack"):
        memory.check(values, 2, like)


def test_volumes_of_a_body_among_others():
    body = Body(MESH)
    rest = torch.zeros(len(MESH.vertices) + 5, 3)
    site = EnergySite(body, 5, (), rest, INTEGRATORS["bdf2"], 0.01)
    for volumes in (site.mass_volume, site.load_volume):
        assert not volumes[:5].nnz
        assert volumes.sum() == pytest.approx(0.04 * 0.02 * 0.02, rel=1e-12)


def test_constants_of_another_number_of_environments_are_refused():
    one = torch.ones(1, 3)
    constants = Constants(one, one, one, one, {"stiffness": torch.ones(4, 2), "absent": None})
    assert constants.batch == 4
    constants.check_batch(4)
    with pytest.raises(InputError, match="4 environments"):
        constants.check_batch(2)
