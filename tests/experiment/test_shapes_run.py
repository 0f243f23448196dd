"""The identified material on other bodies, through the command line."""

import json

import numpy as np
import pytest

from support.configured import check, composed
from support.main_job import IN_RUN, run_without_report
from warp_resphys.fem.stretches import share_outside
from warp_resphys.io.errors import InputError

BEAM = "{kind:box_hexahedra,size:[0.08,0.02,0.02],divisions:[4,1,1]}"
FINER = "{kind:box_hexahedra,size:[0.08,0.02,0.02],divisions:[8,2,2]}"
LONG = "{kind:box_hexahedra,size:[0.1,0.03,0.03],divisions:[4,1,1]}"
RANGES = "{youngs_modulus:{lower:50e3,upper:1e6,logarithmic:true},poissons_ratio:{lower:0.3,upper:0.4995}}"
# E and nu alone describe the target, so that SysID is exact on every body.
KNOWN = [
    "target.poissons_ratio=0.4",
    f"identify={{parameters:{RANGES},max_evaluations:12,tolerance:1e-10,seconds:0.2,trials:2}}",
    *("mesh.divisions=[4,1,1]", "data.steps=24", "data.weights_g.train=[60,140,200]"),
    *("data.weights_g.validation=[100]", "data.weights_g.test=[160]", "trainer.epochs=2", "trainer.rollout_every=2"),
    *("network.width=8", "timing=false", "hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN),
]
SHAPES = [
    f"+shapes.thin={{mesh:{BEAM},fixed:{{x:0.0}},held:{{weight_g:20,at:{{x:0.08}}}}}}",
    f"+shapes.finer={{mesh:{BEAM},target_mesh:{FINER},fixed:{{x:0.0}},held:{{weight_g:20,at:{{x:0.08}}}}}}",
    f"+shapes.twisted={{mesh:{BEAM},fixed:{{x:0.0}},held:{{twist_deg:40}}}}",
    f"+shapes.muscle={{mesh:{LONG},fixed:{{x:0.0}},inputs:[2e4],muscles:{{commanded:stress,stiffness:0.0,"
    "bundles:{low:{direction:[1,0,0],within:{z:[0.0,0.03]}}}}}",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return run_without_report(tmp_path_factory.mktemp("shapes"), *KNOWN, *SHAPES)


def results(folder):
    return json.loads((folder / "shapes.json").read_text())


@pytest.mark.slow
def test_an_exact_identification_is_exact_on_other_bodies(run):
    for name in ("thin", "twisted", "muscle"):
        found = results(run)[name]
        assert found["errors_mm"]["simulation"] > 0.01, name
        assert found["errors_mm"]["sysid"] < 1e-3 * found["errors_mm"]["simulation"], name
        assert found["moved_mm"] > 1.0
        assert "law" not in found["errors_mm"]


@pytest.mark.slow
def test_a_target_on_another_mesh_leaves_the_error_of_the_mesh(run):
    found = results(run)
    assert found["finer"]["vertices"] == found["thin"]["vertices"]
    assert found["finer"]["errors_mm"]["sysid"] > 100.0 * found["thin"]["errors_mm"]["sysid"]
    assert found["finer"]["moved_mm"] == pytest.approx(found["thin"]["moved_mm"], rel=0.3)


@pytest.mark.slow
def test_the_metrics_have_the_errors(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["shapes"] == results(run)


def test_stretches_outside_of_a_range_are_counted():
    stretches = np.array([[[1.2, 1.0, 0.9], [1.0, 1.0, 1.0]], [[1.05, 1.0, 0.7], [1.1, 1.0, 0.95]]])
    assert share_outside(stretches, 0.8, 1.15) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.0}}}}"], r"shapes\.a\.held is null, and so is inputs: give one of"),
        (
            [f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.0}},held:{{twist_deg:9}},inputs:[1.0]}}"],
            r"shapes\.a\.inputs is set, but held is set as well",
        ),
        (
            [f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.0}},held:{{weight_g:9}}}}"],
            r"shapes\.a\.held\.at is null: name the vertices that carry the weight",
        ),
        (
            [f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.0}},inputs:[1.0]}}"],
            r"shapes\.a: inputs are given, but it has neither chambers nor tendons nor commanded muscles",
        ),
        (
            [f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.5}},held:{{twist_deg:9}}}}"],
            r"shapes\.a: .*no vertex",
        ),
        (
            [f"+shapes.a={{mesh:{BEAM},fixed:{{x:0.0}},held:{{weight_g:9,at:{{x:0.0}}}}}}"],
            r"shapes\.a: held\.at selects fixed vertices only",
        ),
    ],
)
def test_what_cannot_work_is_refused_in_a_sentence(overrides, message):
    with pytest.raises(InputError, match=message):
        check(composed("experiment=law_beam", *overrides))


def test_nothing_to_put_on_other_bodies_is_refused():
    with pytest.raises(
        InputError, match=r"shapes are bodies with the identified material .* but nothing is identified"
    ):
        check(composed("experiment=beam_oscillation", "shapes=bodies"))
