"""Surfaces of geoms: on the geoms where these are, and closed."""

import numpy as np
import pytest

from warp_resphys.coupling.geoms import GeomSurfaces

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

GEOMS = {
    "sphere": ("0.03", lambda x: np.linalg.norm(x, axis=1) - 0.03),
    "capsule": (
        "0.02 0.05",
        lambda x: np.linalg.norm(x - np.clip(x, [0, 0, -0.05], [0, 0, 0.05]), axis=1) - 0.02,
    ),
    "cylinder": (
        "0.02 0.05",
        lambda x: np.maximum(np.linalg.norm(x[:, :2], axis=1) / 0.02, np.abs(x[:, 2]) / 0.05) - 1.0,
    ),
    "box": ("0.01 0.02 0.03", lambda x: (np.abs(x) / [0.01, 0.02, 0.03]).max(1) - 1.0),
}


@pytest.mark.parametrize("kind", GEOMS)
def test_a_surface_is_on_its_geom(kind):
    size, distance = GEOMS[kind]
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos=".3 -.1 .2" euler="20 40 '
        f'60"><freejoint/><geom type="{kind}" size="{size}" pos=".1 0 '
        '0"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    surfaces = GeomSurfaces(model)
    local = (surfaces.points(data) - data.geom_xpos[1]) @ data.geom_xmat[1].reshape(3, 3)
    np.testing.assert_allclose(distance(local), 0.0, atol=1e-12)
    np.testing.assert_allclose(local.max(0), -local.min(0), atol=1e-12)
    sides = surfaces.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, counts = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()
