"""Laws: the balance of forces gives their coefficients,
and those identified from motions have scores on trials.
"""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from support import regions
from support.refusals import refuses
from warp_resphys import (
    Body,
    InputError,
    Inputs,
    Simulator,
    SolverSettings,
    box_hexahedra,
    evaluate,
    select_vertices,
)
from warp_resphys.core.energies.catalogue import unit_of
from warp_resphys.core.energies.materials import Corotated
from warp_resphys.energies import make_material
from warp_resphys.learning.identification.law import (
    VISCOSITIES,
    LawClass,
    _parameters,
    branches_of,
    fit_classes,
    strong_names,
)
from warp_resphys.learning.identification.law_scores import tried_without_states
from warp_resphys.learning.identification.law_search import identify_law
from warp_resphys.learning.identification.weak_form import KnownMotion, NormalEquations, WeakForm
from warp_resphys.learning.observed_motions import ObservedMotions
from warp_resphys.learning.scores import Score
from warp_resphys.settings.learning import LawSettings

MESH = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))
TIP = select_vertices(MESH, x=0.08)
STIFF = {"c10": 3e4, "bulk_1": 3e6}  # Pa, of the weight
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
UNIT = {
    "c10": 1e5,
    "c20": 1e5,
    "bulk_1": 1e6,
    "ogden_4": 1e5,
    "shear_viscosity": 1e2,
    "prony_modulus_1": 1e5,
    "fibre_tension_1": 1e5,
}
TRUE = np.array([0.3, 0.25, 2.0, 0.2, 0.4, 0.15, 0.5])  # in these units
SHAPE = {"prony_time_1": 0.04, "fibre_azimuth_1": 0.6, "fibre_toe_1": 0.02}
REST = {f"fibre_{name}_1": 0.0 for name in ("elevation", "slack", "stiffening", "compression")}
CANDIDATES = [{name: unit} for name, unit in UNIT.items()]
PULLS = [(0.3, 0.0, -0.2), (-0.2, 0.2, 0.05)]  # N


def beam(parameters, integrator="implicit_euler"):
    """A beam of a law, all of whose parameters are given."""
    material = make_material("law", **parameters)
    return Simulator(BODY, material, time_step=0.005, solver=TIGHT, integrator=integrator)


def pulled(pulls):
    """(B, N, 3) nodal forces of pulls (B, 3) at the tip [N]."""
    force = torch.zeros(len(pulls), len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP] = torch.tensor(pulls, dtype=torch.float64)[:, None] / len(TIP)
    return force


def released(sim, pulls, steps=12):
    """Motions of beams that are released from pulls (B, 3) at the tip [N]."""
    with torch.no_grad():
        held = sim.static_equilibrium(Inputs(external_force=pulled(pulls)))
        return KnownMotion(sim.rollout(held, steps).q, held.v)


def simulator(values, integrator="implicit_euler"):
    """A beam whose forces are linear in `values`, in the order of `UNIT`."""
    parameters = dict(zip(UNIT, values * np.array([*UNIT.values()]), strict=True))
    return beam({**parameters, **SHAPE, **REST}, integrator)


def residual_of(forces, target):
    return np.linalg.norm(forces - target) / np.linalg.norm(target)


def fit(columns, target):
    """Coefficients of all columns, and their residual."""
    coefficients = NormalEquations.of(columns, target).fit(range(columns.shape[1]))
    return SimpleNamespace(
        coefficients=coefficients, residual=residual_of(columns @ coefficients, target)
    )


def unknown(integrator="implicit_euler"):
    return simulator(np.zeros(len(UNIT)), integrator)


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "midpoint"])
def balance(request):
    """Rows of a motion whose coefficients are known, and the simulator that has none of them."""
    motion = released(simulator(TRUE, request.param), PULLS)
    return WeakForm(unknown(request.param), [motion], SHAPE, STIFF, stride=2)


def test_known_coefficients_are_recovered_and_terms_that_the_law_does_not_have_get_none(balance):
    columns = balance.columns(CANDIDATES)
    # Steps, motions, free vertices, coordinates.
    assert columns.shape == (6 * 2 * 16 * 3, len(UNIT))
    found = fit(columns, balance.target)
    np.testing.assert_allclose(found.coefficients, TRUE, rtol=1e-4)
    assert found.residual < 1e-7
    assert residual_of(columns @ (1.1 * TRUE), balance.target) == pytest.approx(0.1, rel=1e-3)
    without = fit(balance.columns([*CANDIDATES[:3], *CANDIDATES[4:]]), balance.target)
    others = {"c01": 1e5, "c02": 1e5, "dilation": 1e5, "fibre_stiffening_1": 1e5}
    found = fit(
        balance.columns([*CANDIDATES, *({name: unit} for name, unit in others.items())]),
        balance.target,
    )
    np.testing.assert_allclose(found.coefficients[len(UNIT) :], 0.0, atol=1e-3)
    np.testing.assert_allclose(found.coefficients[: len(UNIT)], TRUE, rtol=0.02)
    assert without.residual > 1e4 * found.residual


def test_loads_during_the_motion_and_steps_between_two_rows_are_part_of_the_balance():
    """Rows of a larger stride are among those of every step."""
    sim = simulator(TRUE)
    motion = released(sim, PULLS[:1])
    fine, coarse = (
        WeakForm(unknown(), [motion], SHAPE, STIFF, stride).columns(CANDIDATES) for stride in (1, 4)
    )
    rows = fine.reshape(12, -1, len(UNIT))[::4].reshape(-1, len(UNIT))
    np.testing.assert_allclose(coarse, rows, rtol=0.0, atol=1e-12 * np.abs(rows).max())
    assert np.abs(fine[:, 5]).max() > 0.0
    sim = simulator(TRUE)
    inputs = Inputs(external_force=pulled([(0.0, 0.2, 0.0)]))
    with torch.no_grad():
        q = sim.rollout(sim.rest_state(), 12, inputs).q
    motion = KnownMotion(q, torch.zeros_like(q[0]), inputs)
    form = WeakForm(unknown(), [motion], SHAPE, STIFF)
    assert residual_of(form.columns(CANDIDATES) @ TRUE, form.target) < 1e-7
    unloaded = WeakForm(unknown(), [replace(motion, inputs=Inputs())], SHAPE, STIFF)
    assert residual_of(unloaded.columns(CANDIDATES) @ TRUE, unloaded.target) > 0.1


def test_a_fit_has_no_negative_coefficient():
    random = np.random.default_rng(0)
    columns = random.normal(size=(200, 4)) * [1.0, 1e-3, 1e4, 0.0]
    true = np.array([2.0, -3e3, 5e-5, 0.0])
    found = fit(columns, columns @ true)
    assert found.coefficients.min() == 0.0
    assert found.coefficients[1] == found.coefficients[3] == 0.0
    least = np.linalg.lstsq(columns[:, [0, 2]], columns @ true, rcond=None)[0]
    np.testing.assert_allclose(found.coefficients[[0, 2]], least, rtol=1e-6)
    equations = NormalEquations.of(columns, columns @ true)
    assert equations.residual(range(4), found.coefficients) == pytest.approx(
        found.residual, rel=1e-6
    )


@pytest.mark.parametrize(("motions", "stride"), [(0, 5), (1, 0)])
def test_nothing_to_balance_is_refused(motions, stride):
    sim = simulator(TRUE)
    still = KnownMotion(
        sim.rest_positions.expand(3, 1, -1, -1), torch.zeros_like(sim.rest_positions)[None]
    )
    refuses(
        InputError, "no step to balance", WeakForm, sim, [still] * motions, SHAPE, STIFF, stride
    )


TERMS, TIMES = ("c20", "c01", "ogden_4"), np.geomspace(0.01, 0.2, 8).tolist()
WIDE = [(0.4, 0.0, -0.15), (-0.2, 0.15, 0.05), (0.1, -0.1, 0.15)]  # N
HELD_OUT = [(0.25, 0.12, 0.12)]
NEO_HOOKEAN = {"c10": 30e3, "bulk_1": 2e6}


def classes(truth):
    """Classes without fibres that fit motions of a law, by their groups."""
    zero = dict.fromkeys((*TERMS, "c10", "bulk_1", "shear_viscosity", "prony_modulus_1"), 0.0)
    shape = {"prony_time_1": 0.05}
    unknown, true = beam({**zero, **shape}), beam(truth)
    forms = [
        WeakForm(unknown, [released(true, pulls)], shape, STIFF, 3) for pulls in (WIDE, HELD_OUT)
    ]
    laws = fit_classes(*forms, TERMS, TIMES, 0)
    sizes = [len(law.groups) for law in laws]
    assert sizes == sorted(sizes)
    assert laws[0].groups == ()
    assert laws[0].parameters.keys() == {"c10", "bulk_1"}
    return {law.groups: law for law in laws}


def test_terms_that_the_beam_has_are_found_and_no_others():
    truth = {**NEO_HOOKEAN, "ogden_4": 20e3, "shear_viscosity": 30.0}
    laws = classes(truth)
    found = laws["elastic", "viscosity"]
    assert found.parameters == pytest.approx(truth, rel=1e-3)
    assert found.residual < 1e-6
    assert laws["viscosity",].parameters["shear_viscosity"] == pytest.approx(30.0, rel=0.02)
    smaller = [law for groups, law in laws.items() if not {"elastic", "viscosity"} <= {*groups}]
    assert min(law.residual for law in smaller) > 100.0 * found.residual
    assert laws["viscosity",].residual < 0.1 * laws[()].residual


def test_a_branch_between_two_times_of_the_grid_and_neighbouring_times_are_one_branch():
    truth = {**NEO_HOOKEAN, "prony_modulus_1": 15e3, "prony_time_1": math.sqrt(TIMES[3] * TIMES[4])}
    laws = classes(truth)
    found = laws["branches",]
    assert {name for name in found.parameters if name.startswith("prony")} == {
        "prony_modulus_1",
        "prony_time_1",
    }
    assert found.parameters["prony_time_1"] == pytest.approx(truth["prony_time_1"], rel=0.05)
    assert found.parameters["prony_modulus_1"] == pytest.approx(15e3, rel=0.05)
    assert found.residual < 0.01 * laws[()].residual
    branches = [{"prony_modulus_1": 1e5, "prony_time_1": time} for time in (0.01, 0.015, 0.1, 0.4)]
    candidates = [{"c10": 1e5}, {"bulk_1": 1e5}, *branches, {"shear_viscosity": 1e2}]
    found = _parameters(candidates, np.array([0.4, 20.0, 0.1, 0.3, 0.2, 1e-5, 0.5]))
    assert {name: found[name] for name in ("c10", "bulk_1", "shear_viscosity")} == pytest.approx(
        {"c10": 4e4, "bulk_1": 2e6, "shear_viscosity": 50.0}
    )
    # The mean of the logarithms, weighted by the moduli.
    together = 0.01 ** (1 / 4) * 0.015 ** (3 / 4)
    branches = {
        "prony_modulus_1": 4e4,
        "prony_time_1": together,
        "prony_modulus_2": 2e4,
        "prony_time_2": 0.1,
    }
    assert {
        name: value for name, value in found.items() if name.startswith("prony")
    } == pytest.approx(branches)


SHEAR = 100e3  # Pa


def frames(seed, scale=1.0, count=400):
    """Mean squares of two trials, with noise of its own."""
    draw = np.random.default_rng(seed)
    return tuple(scale * (1.0 + 0.1 * draw.standard_normal(count)) for _ in range(2))


class TestScore:
    def test_its_error_is_the_root_of_the_mean_of_the_trials_and_a_small_but_certain_gain_counts(
        self,
    ):
        score = Score((np.array([1.0, 3.0]), np.array([6.0, 6.0, 6.0])))
        assert score.error == pytest.approx(2.0)
        assert Score((np.array([1.0, np.nan]),)).error == math.inf
        better, worse = Score(frames(0, 0.97)), Score(frames(1))
        assert better.beats(worse)
        assert not worse.beats(better)
        # In one half of the time alone.
        less, trial = np.where(np.arange(400) < 200, 0.9, 1.07), frames(0)
        better = Score(tuple(less * own for own in trial))
        assert better.error < Score(trial).error
        assert not better.beats(Score(trial))
        assert not Score(trial).beats(Score(trial))

    def test_of_static_poses_the_trials_are_compared_and_one_that_fails_loses(self):
        def score(*poses):
            return Score(tuple(np.array([x]) for x in poses))

        assert score(0.9, 1.8, 2.7).beats(score(1.0, 2.0, 3.0))
        assert not score(0.5, 1.4, 3.6).beats(score(1.0, 2.0, 3.0))
        assert score(0.8).beats(score(1.0))
        assert not score(0.99).beats(score(1.0))
        assert score(5.0).beats(score(np.inf))
        assert not score(np.inf).beats(score(5.0))


def test_terms_branches_and_families_that_hardly_resist_are_left_out_and_the_others_numbered_anew():
    law = {
        "c10": 0.0,
        "c01": 50e3,
        "ogden_3": 5.0,
        "bulk_1": 1e6,
        "shear_viscosity": 1e-3,
        "bulk_viscosity": 40.0,
    }
    law |= branches_of([1.0, 2e4], [0.01, 0.5]) | {"fibre_tension_1": 3.0, "fibre_toe_1": 0.02}
    law |= {"fibre_tension_2": 5e4, "fibre_toe_2": 0.03, "fibre_azimuth_2": 0.0}
    names = strong_names(law, SHEAR)
    kept = {name: law[old] for name, old in names.items()}
    assert kept == {
        **{"c10": 0.0, "c01": 50e3, "bulk_1": 1e6, "bulk_viscosity": 40.0},
        **{"prony_modulus_1": 2e4, "prony_time_1": 0.5},
        **{"fibre_tension_1": 5e4, "fibre_toe_1": 0.03, "fibre_azimuth_1": 0.0},
    }
    assert names["prony_time_1"] == "prony_time_2"


def test_branches_are_numbered_from_a_number():
    assert branches_of([1.0], [0.5], 3) == {"prony_modulus_3": 1.0, "prony_time_3": 0.5}
    units = {
        "c10": "Pa",
        "prony_time_3": "s",
        "bulk_viscosity": "Pa s",
        "mass_damping": "1/s",
        "stiffness_damping": "s",
    }
    assert {name: unit_of(name) for name in units} == units


@dataclass(frozen=True)
class Refined:
    """A refined law of a search whose errors are known."""

    law: LawClass
    score: Score


def search_from_markers(errors, guess=None, lost=()):
    """Groups of the classes in the order of the search, the best last,
    and the parameters that each began with.

    Errors are those of the validation trials by group; a refinement finds the lost parameters to be
    zero.
    """
    began = []

    def refine(law):
        began.append(dict(law.parameters))
        kept = {
            name: value
            for name, value in law.parameters.items()
            if not name.startswith(tuple(lost))
        }
        # As if other terms took its place.
        kept["c10"] = 0.0 if "elastic" in law.groups else law.parameters["c10"]
        return Refined(
            LawClass(law.groups, kept, math.nan), Score((np.array([errors[law.groups] ** 2] * 2),))
        )

    settings = LawSettings(
        relaxation_times=(0.01, 1.0), terms=("c01", "ogden_3"), branches=3, families=1
    )
    mesh = box_hexahedra((0.01, 0.2, 0.01), (1, 1, 1))
    guess = {"c10": 0.5 * SHEAR, "bulk_1": 60e3, **(guess or {})}
    return [own.law.groups for own in tried_without_states(refine, guess, settings, mesh)], began


@pytest.mark.parametrize("viscosity", [60.0, 0.0])
def test_a_law_is_identified_from_observed_motions_and_simulates_on(viscosity):
    """A Mooney-Rivlin beam, of which all vertices are seen.

    The simulator has a linear material of another modulus.
    """
    mesh = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))
    body, tip = Body(mesh, fixed=select_vertices(mesh, x=0.0)), select_vertices(mesh, x=0.08)
    truth = {
        "c10": 15e3,
        "c01": 25e3,
        "bulk_1": 1e6,
        "shear_viscosity": viscosity,
        "density": 1070.0,
    }
    robot = Simulator(body, make_material("law", **truth), time_step=0.01)
    newtons = [[0.2, 0.0, -0.1], [-0.15, 0.1, 0.0], [0.1, 0.0, 0.2], [0.1, 0.1, 0.1]]
    pulls = torch.tensor(newtons, dtype=torch.float64)
    pull = torch.zeros(4, len(mesh.vertices), 3, dtype=torch.float64)
    pull[:, tip] = pulls[:, None] / len(tip)
    with torch.no_grad():
        start = robot.static_equilibrium(Inputs(external_force=pull))
        motions = ObservedMotions.of(robot, robot.rollout(start, 30).q, start)
    simulator = Simulator(body, Corotated(150e3, 0.45, density=1070.0), time_step=0.01)
    settings = LawSettings(terms=["c01", "c20"], branches=0, families=0, trials=None)
    law = identify_law(
        simulator,
        motions,
        train=motions.trials.names[:3],
        validation=["motion 3"],
        settings=settings,
    )
    assert law.accepted
    assert law.groups == (("elastic", "viscosity") if viscosity else ("elastic",))
    assert viscosity or not {*VISCOSITIES} & law.parameters.keys()  # as its class has none
    assert {name: law.parameters.get(name, 0.0) for name in truth} == pytest.approx(truth, rel=0.05)
    assert law.parameters.get("c20", 0.0) < 200.0
    assert law.validation["law"] < 0.01 * law.validation["below"]
    assert float(evaluate(law.simulator, motions, parameters=law.others).mean()) < 1e-5


def test_materials_of_regions_have_no_law():
    robot = Simulator(Body(regions.beam()), {"beam": Corotated(), "cap": Corotated()})
    motions = ObservedMotions.of(robot, robot.rest_positions.expand(2, 1, -1, -1))
    refuses(InputError, "a law describes one material", identify_law, robot, motions)


WHOLE = ("elastic", "branches", "fibres")


class TestSearchFromMarkers:
    def test_it_begins_with_all_groups_and_takes_away_what_does_not_help(self):
        without = ("branches", "fibres")
        errors = {WHOLE: 1.0, without: 1.0, ("fibres",): 2.0, ("branches",): 3.0}
        classes, began = search_from_markers(errors)
        assert classes == [WHOLE, ("fibres",), ("branches",), without]
        assert began[0]["bulk_1"] >= 20.0 * SHEAR
        assert began[0]["fibre_azimuth_1"] == pytest.approx(np.pi / 2.0)  # along the longest side
        assert all(0.01 < began[0][f"prony_time_{k}"] < 1.0 for k in (1, 2))
        assert not any(name.startswith(("c01", "ogden")) for name in began[-1])
        assert began[1]["c10"] == 50e3  # in place of the elastic terms, which had taken its place

    def test_a_group_of_which_nothing_is_left_is_not_tried_without_and_identified_creep_stays(self):
        errors = {WHOLE: 1.0, ("branches", "fibres"): 2.0, ("elastic", "fibres"): 2.0}
        classes, began = search_from_markers(errors, lost=["fibre"])
        assert len(began) == 3
        assert classes[-1] == ("elastic", "branches")
        creep = branches_of([2e4], [0.5])
        errors = {WHOLE: 1.0, ("branches", "fibres"): 1.0, ("fibres",): 1.0, (): 1.0}
        classes, began = search_from_markers(errors, creep)
        # The longer time is close to the known one.
        assert began[0]["prony_time_2"] == pytest.approx(0.01**0.75)
        assert "prony_time_3" not in began[0]
        assert classes[-1] == ()
        assert {
            name: value for name, value in began[-1].items() if name.startswith("prony")
        } == creep
