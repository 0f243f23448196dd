"""Laws by the names of silicones, and from the files of runs."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import warp_resphys as wr
from warp_resphys.energies.catalogue import LAW_FORMAT, law_path, read_law

SHIPPED = sorted(path.stem for path in (Path(wr.__file__).parent / "laws").glob("*.json"))


def written(folder, **changes):
    """A law.json as a run writes it."""
    parameters = {"density": 1100.0, "mass_damping": 3.0, "c10": 40e3, "bulk_1": 5e6, "prony_modulus_1": 8e3}
    content = {"format": LAW_FORMAT, "model": "law", "parameters": parameters | {"prony_time_1": 0.1}}
    path = folder / "law.json"
    path.write_text(json.dumps(content | changes))
    return str(path)


def test_the_material_of_a_run_has_its_parameters_without_the_damping_of_the_robot(tmp_path):
    material = wr.read_material(written(tmp_path))
    assert isinstance(material, wr.energies.ConvexMaterial)
    assert material.values["c10"] == 40e3
    assert material.values["density"] == 1100.0
    assert material.values["prony_time_1"] == 0.1
    assert material.values["mass_damping"] == 0.0


@pytest.mark.parametrize("name", SHIPPED)
def test_a_silicone_of_the_package_is_stiff_as_silicones_are_and_says_where_it_comes_from(name):
    law, material = read_law(name), wr.read_material(name)
    ogden = [value for key, value in material.values.items() if key.startswith("ogden_")]
    shear = 2.0 * (material.values["c10"] + material.values["c01"]) + sum(ogden)
    assert 10e3 < shear < 300e3
    assert {"deviation", "stretches", "data", "versions", "units"} <= law.keys()
    assert law["accepted"]


def test_there_are_silicones_and_an_unknown_one_is_refused_with_their_names():
    assert "dragon_skin_10" in SHIPPED
    with pytest.raises(
        wr.DataFileError, match=r"no law dragon_skin_99: give the law\.json of a run, or one of .*dragon_skin_10"
    ):
        law_path("dragon_skin_99")


NUMBER = r"parameters\.c10 is .*: a law has a finite number there"
UNITS, STRETCHES = (
    "units is .*: give the unit of each parameter",
    "stretches is .*: give the least and the largest stretch",
)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        *(("parameters", {"c10": value, "bulk_1": 1e6}, NUMBER) for value in (True, "4e4", float("nan"))),
        *(("units", value, UNITS) for value in (None, "Pa")),
        *(
            ("stretches", pair, STRETCHES)
            for pair in ([True, 2.0], [1.1, 0.9], [0.0, 1.1], [0.9, math.inf], [0.9], 1.1)
        ),
        *(
            (key, value, "not a law of this version")
            for key, value in (("format", 0), ("parameters", {}), ("model", 3))
        ),
    ],
)
def test_a_file_that_is_no_law_is_refused(tmp_path, key, value, message):
    with pytest.raises(wr.DataFileError, match=rf"law\.json.*{message}"):
        wr.read_material(written(tmp_path, **{key: value}))


def test_cells_that_are_stretched_further_than_in_the_recordings_are_counted(tmp_path):
    mesh = wr.box_hexahedra((0.2, 0.1, 0.1), (2, 1, 1))
    half = mesh.vertices.copy()
    half[:, 0] += np.clip(half[:, 0] - 0.1, 0.0, None)  # The second of two cells is twice as long.
    states = np.stack([mesh.vertices, half])
    assert wr.energies.share_outside_law("dragon_skin_10", mesh, states) == 0.25
    assert wr.energies.share_outside_law(written(tmp_path, stretches=[0.5, 2.1]), mesh, states) == 0.0
    with pytest.raises(wr.DataFileError, match=r"law\.json has no stretches: identify the law again"):
        wr.energies.share_outside_law(written(tmp_path), mesh, states)
    with pytest.raises(wr.InputError, match="no finite state"):
        wr.energies.share_outside_law("dragon_skin_10", mesh, np.full_like(states, np.nan))
