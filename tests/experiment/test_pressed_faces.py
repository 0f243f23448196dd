"""Open faces under pressure in the settings of a body."""

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys import MeshError, ResphysError, Simulator, box_hexahedra
from warp_resphys.experiment.actuators import drive_of, driven_parts
from warp_resphys.experiment.build import build_body
from warp_resphys.io.settings import parse
from warp_resphys.mesh import select_faces, write_mesh
from warp_resphys.settings.body import BodySettings

BOX = {"kind": "box_hexahedra", "size": [0.02, 0.02, 0.005], "divisions": [2, 2, 1]}


def body_of(faces, mesh=BOX, fixed=None, **chambers):
    """A body, by default held everywhere but in its middle."""
    fixed = {"z": [0.0, 0.005]} if fixed is None else fixed
    return parse(
        BodySettings,
        {"mesh": mesh, "fixed": fixed, "chambers": {"faces": faces, **chambers}},
        "body",
    )


def test_faces_by_place_and_by_the_name_of_a_surface(tmp_path):
    box = box_hexahedra((0.02, 0.02, 0.005), (2, 2, 1))
    lower, right = select_faces(box, z=0.0), select_faces(box, x=0.02)
    write_mesh(tmp_path / "box.msh", box, {"right side": right})
    settings = body_of(
        {"below": {"z": 0.0}, "side": "right side"}, {"kind": "file", "path": f"{tmp_path}/box.msh"}
    )
    body = build_body(settings)
    (pressure,) = body.energies
    for chamber, faces in zip(pressure.chambers, (lower, right), strict=True):
        np.testing.assert_array_equal(chamber.faces, faces)
    assert pressure.names == drive_of(settings, body).parts == ("below", "side")
    assert driven_parts(settings) == 2


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("count is 0, and faces has none: give the number", {"faces": {}}),
        (
            "the mesh has 0 closed chambers, but chambers.count is 1: "
            ".* name them in chambers.faces",
            {"count": 1},
        ),
        (
            r"chambers\.faces\.below: no vertex lies within 1e-09 m of z = 1 m",
            {"faces": {"below": {"z": 1.0}}},
        ),
        (
            r"chambers\.faces\.below: no face of the surface",
            {"faces": {"below": {"z": 0.0, "x": 0.0}}},
        ),
        (
            r"chambers\.faces\.below: only meshes from a file have named surfaces",
            {"faces": {"below": "lid"}},
        ),
    ],
)
def test_refusals(message, options):
    refuses(
        ResphysError,
        message,
        lambda: build_body(body_of(**{"faces": {"below": {"z": 0.0}}, **options})),
    )


def test_edges_that_can_move_and_unknown_surfaces_are_refused(tmp_path):
    body = build_body(body_of({"below": {"z": 0.0}}, fixed={"x": 0.0}))
    refuses(MeshError, "below has 6 open edges that can move", Simulator, body)
    box = box_hexahedra((0.02, 0.02, 0.005), (2, 2, 1))
    write_mesh(tmp_path / "box.msh", box, {"lid": select_faces(box, z=0.0)})
    settings = body_of({"below": "floor"}, {"kind": "file", "path": f"{tmp_path}/box.msh"})
    refuses(MeshError, "below: the mesh has no surface 'floor'; it has lid", build_body, settings)
