"""The page of all keys, and the JSON Schema for editors."""

import runpy
from pathlib import Path
from typing import get_args

import pytest
from jsonschema import Draft202012Validator, ValidationError
from omegaconf import OmegaConf

from support.configured import settings
from warp_resphys.core.fem.bodies import MASS_MODES
from warp_resphys.core.fem.integration_points import VOLUME_INTEGRATIONS
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.data.markers import KINDS
from warp_resphys.experiment.experiment import MODELS
from warp_resphys.io.settings import parse
from warp_resphys.learning.residuals.networks import ACTIVATIONS
from warp_resphys.settings.body import PhysicsSettings, SimulatorSettings
from warp_resphys.settings.control import Model
from warp_resphys.settings.editor_schema import editor_schema
from warp_resphys.settings.learning import NetworkSettings
from warp_resphys.settings.observed import MarkerSettings
from warp_resphys.settings.stage_keys import StageSettings

ROOT = Path(__file__).parents[1]


def test_the_page_of_all_keys_is_current():
    page = runpy.run_path(str(ROOT / "docs" / "extensions" / "settings_page.py"))["page"]()
    assert (ROOT / "docs" / "settings.md").read_text(encoding="utf-8").rstrip() == page.rstrip()


@pytest.fixture(scope="module")
def editor():
    schema = editor_schema()
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "conf" / "experiment").glob("*.yaml")), ids=lambda path: path.stem
)
def test_experiments_are_what_editors_expect(path, editor):
    content = OmegaConf.to_container(OmegaConf.load(path))
    # Their kind is elsewhere.
    content = {key: group for key, group in content.items() if key not in ("mesh", "data")}
    editor.validate(content)


def test_an_editor_marks_a_wrong_key(editor):
    with pytest.raises(ValidationError):
        editor.validate({"trainer": {"epoch": 3}})
    editor.validate({"markers": {"reference": {"_replace_": True, "a": [0, 0, 0]}}})


def test_choices_in_the_settings_are_those_in_the_code():
    pairs = [
        (SimulatorSettings, "integrator", INTEGRATORS),
        (PhysicsSettings, "mass", MASS_MODES),
        (PhysicsSettings, "volume_integration", VOLUME_INTEGRATIONS),
        (MarkerSettings, "bind", KINDS),
        (NetworkSettings, "activation", ACTIVATIONS),
    ]
    for group, key, words in pairs:
        assert {*get_args(group.model_fields[key].annotation)} == {*words}
    assert get_args(Model) == tuple(MODELS)


def test_a_stage_has_the_keys_that_it_reads_alone():
    run = settings()
    stage = StageSettings.reading(run, "simulation", "law", "parallel.batch", shared="..")
    assert (stage.simulation, stage.batch, stage.shared) == (
        run.simulation,
        run.parallel.batch,
        "..",
    )
    for key, read in {
        "seed": lambda: stage.seed,
        "processes": lambda: stage.parallel.processes,
    }.items():
        with pytest.raises(AttributeError, match=key):
            read()
    with pytest.raises(AttributeError, match="identify"):
        _ = stage.identify
    content = stage.content()
    assert {*content} == {"simulation", "law", "parallel", "shared"}
    assert (content["law"], content["parallel"]) == (run.plain()["law"], {"batch": None})
    assert parse(StageSettings, stage.plain()).content() == content
