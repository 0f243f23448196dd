"""Laws: identified from observed motions, their scores on trials, and the parameters that a refined law keeps."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from support.regions import beam
from warp_resphys import Body, Corotated, Inputs, ObservedMotions, Simulator, box_hexahedra, evaluate, select_vertices
from warp_resphys.energies import make_material
from warp_resphys.energies.catalogue import unit_of
from warp_resphys.io.errors import InputError
from warp_resphys.learning.identification.law import LawClass, branches_of, strong_names
from warp_resphys.learning.identification.law_scores import Score, tried_without_states
from warp_resphys.learning.identification.law_search import identify_law
from warp_resphys.settings.learning import LawSettings

SHEAR = 100e3  # Pa


def frames(seed, scale=1.0, count=400):
    """Mean squares of two trials, with noise of its own."""
    draw = np.random.default_rng(seed)
    return tuple(scale * (1.0 + 0.1 * draw.standard_normal(count)) for _ in range(2))


class TestScore:
    def test_its_error_is_the_root_of_the_mean_of_the_trials(self):
        score = Score((np.array([1.0, 3.0]), np.array([6.0, 6.0, 6.0])))
        assert score.error == pytest.approx(2.0)
        assert Score((np.array([1.0, np.nan]),)).error == math.inf

    def test_a_small_but_certain_gain_counts_and_an_uncertain_one_does_not(self):
        better, worse = Score(frames(0, 0.97)), Score(frames(1))
        assert better.beats(worse)
        assert not worse.beats(better)
        less, trial = np.where(np.arange(400) < 200, 0.9, 1.07), frames(0)  # in one half of the time alone
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
    law = {"c10": 0.0, "c01": 50e3, "ogden_3": 5.0, "bulk_1": 1e6, "shear_viscosity": 1e-3, "bulk_viscosity": 40.0}
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
    """Groups of the classes in the order of the search, the best last, and the parameters that each began with.

    Errors are those of the validation trials by group; a refinement finds the lost parameters to be zero.
    """
    began = []

    def refine(law):
        began.append(dict(law.parameters))
        kept = {name: value for name, value in law.parameters.items() if not name.startswith(tuple(lost))}
        kept["c10"] = 0.0 if "elastic" in law.groups else law.parameters["c10"]  # as if other terms took its place
        return Refined(LawClass(law.groups, kept, math.nan), Score((np.array([errors[law.groups] ** 2] * 2),)))

    settings = LawSettings(relaxation_times=(0.01, 1.0), terms=("c01", "ogden_3"), branches=3, families=1)
    mesh, guess = box_hexahedra((0.01, 0.2, 0.01), (1, 1, 1)), {"c10": 0.5 * SHEAR, "bulk_1": 60e3, **(guess or {})}
    return [own.law.groups for own in tried_without_states(refine, guess, settings, mesh)], began


def test_a_law_is_identified_from_observed_motions_and_simulates_on():
    """A Mooney-Rivlin beam, of which all vertices are seen; the simulator has a linear material of another modulus."""
    mesh = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))
    body, tip = Body(mesh, fixed=select_vertices(mesh, x=0.0)), select_vertices(mesh, x=0.08)
    truth = {"c10": 15e3, "c01": 25e3, "bulk_1": 1e6, "shear_viscosity": 60.0, "density": 1070.0}
    robot = Simulator(body, make_material("law", **truth), time_step=0.01)
    pulls = torch.tensor(
        [[0.2, 0.0, -0.1], [-0.15, 0.1, 0.0], [0.1, 0.0, 0.2], [0.1, 0.1, 0.1]], dtype=torch.float64
    )  # N
    pull = torch.zeros(4, len(mesh.vertices), 3, dtype=torch.float64)
    pull[:, tip] = pulls[:, None] / len(tip)
    with torch.no_grad():
        start = robot.static_equilibrium(Inputs(external_force=pull))
        motions = ObservedMotions.of(robot, robot.rollout(start, 30).q, start)
    simulator = Simulator(body, Corotated(150e3, 0.45, density=1070.0), time_step=0.01)
    settings = LawSettings(terms=["c01", "c20"], branches=0, families=0, trials=None)
    law = identify_law(simulator, motions, train=motions.trials.names[:3], validation=["motion 3"], settings=settings)
    assert law.accepted
    assert law.groups == ("elastic", "viscosity")
    assert {name: law.parameters[name] for name in truth} == pytest.approx(truth, rel=0.05)
    assert law.parameters.get("c20", 0.0) < 200.0
    assert law.validation["law"] < 0.01 * law.validation["below"]
    assert float(evaluate(law.simulator, motions, parameters=law.others).mean()) < 1e-5


def test_materials_of_regions_have_no_law():
    robot = Simulator(Body(beam()), {"beam": Corotated(), "cap": Corotated()})
    motions = ObservedMotions.of(robot, robot.rest_positions.expand(2, 1, -1, -1))
    with pytest.raises(InputError, match="a law describes one material"):
        identify_law(robot, motions)


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

    def test_a_group_of_which_nothing_is_left_is_not_tried_without(self):
        errors = {WHOLE: 1.0, ("branches", "fibres"): 2.0, ("elastic", "fibres"): 2.0}
        classes, began = search_from_markers(errors, lost=["fibre"])
        assert len(began) == 3
        assert classes[-1] == ("elastic", "branches")

    def test_creep_that_was_identified_stays_where_no_branches_do(self):
        creep = branches_of([2e4], [0.5])
        errors = {WHOLE: 1.0, ("branches", "fibres"): 1.0, ("fibres",): 1.0, (): 1.0}
        classes, began = search_from_markers(errors, creep)
        assert began[0]["prony_time_2"] == pytest.approx(0.01**0.75)  # the longer time is close to the known one
        assert "prony_time_3" not in began[0]
        assert classes[-1] == ()
        assert {name: value for name, value in began[-1].items() if name.startswith("prony")} == creep
