"""The types of the public names, for type checkers."""

import re

import pytest

import warp_resphys

SCRIPT = """
import warp_resphys
from warp_resphys import Body, box_hexahedra

simulator = warp_resphys.Simulator(Body(box_hexahedra()))
reveal_type(warp_resphys.Simulator)
reveal_type(simulator.rollout(simulator.rest_state(), 3).q)
reveal_type(warp_resphys.identify)
Body(mesh="beam.msh")
warp_resphys.Simulater
"""


# What torch and matplotlib have of their own takes half a minute to analyse.
OPTIONS = """
[mypy]
follow_imports = silent
ignore_missing_imports = true
mypy_path = {folder}
[mypy-torch.*,matplotlib.*]
follow_imports = skip
"""
TORCH = """
from typing import Any
class Tensor: ...
def __getattr__(name: str) -> Any: ...
"""


def test_completion_lists_the_public_names_alone():
    assert sorted(dir(warp_resphys)) == sorted(
        [*warp_resphys.__all__, "energies", "learning", "mesh", "pictures", "__version__"]
    )


@pytest.mark.slow
def test_a_type_checker_knows_the_public_names(tmp_path):
    api = pytest.importorskip("mypy.api")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch" / "__init__.pyi").write_text(TORCH, encoding="utf-8")
    options = tmp_path / "options.ini"
    options.write_text(OPTIONS.format(folder=tmp_path), encoding="utf-8")
    out, *_ = api.run([str(script), f"--config-file={options}", f"--cache-dir={tmp_path / 'cache'}"])
    revealed = re.findall(r'Revealed type is "(.+)"', out)
    assert revealed[0].endswith("-> warp_resphys.dynamics.simulator.Simulator")
    assert revealed[1].startswith("torch.")
    assert "-> warp_resphys.learning.identification.search.Identification" in revealed[2].replace('"', "")
    assert len(re.findall(r"error: .*\[(?:arg-type|attr-defined)\]", out)) == 2, out
