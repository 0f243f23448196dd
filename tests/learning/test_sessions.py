"""Values of parts in each session, and those of a session that only test trials show,
from their first frames.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.refusals import refuses
from warp_resphys.data.input_response import RESPONSES
from warp_resphys.io.errors import InputError
from warp_resphys.io.settings import parse
from warp_resphys.learning.comparison import Comparison, Model
from warp_resphys.learning.identification.search import Identification
from warp_resphys.report.identification_section import first_frames_text, trials_table
from warp_resphys.settings.learning import Bounds, IdentifySettings, Prior, ReleaseSettings

MESH = wr.box_hexahedra(size=(0.1, 0.02, 0.02), divisions=(5, 1, 1))
ROUTES = {
    side: [[x, y, 0.02] for x in (0.0, 0.05, 0.1)] for side, y in (("left", 0.0), ("right", 0.02))
}
BODY = wr.Body(MESH, fixed=wr.select_vertices(MESH, x=0.0), energies=[wr.Tendons(ROUTES)])
ROBOT = wr.Simulator(
    BODY, wr.Corotated(264e3, 0.45, density=1070.0, stiffness_damping=3e-3), time_step=0.01
)
MARKERS = wr.bind_markers(
    MESH, [[0.1, 0.0, 0.02], [0.1, 0.02, 0.02], [0.06, 0.02, 0.0]], ["a", "b", "c"]
)
STEPS, FIRST = 20, 0.1  # s
SESSIONS = ("monday", "monday", "friday", "friday")
GAINS = {"monday": (1.4, 0.8), "friday": (1.1, 1.2)}  # true tensions over those of the log
PULLS = ((0.3, 0.1), (0.0, 0.3), (0.2, 0.3), (0.3, 0.0))  # N at the end of each trial
PRIOR = Prior(mean=1.0, deviation=0.2)
RANGES = {
    "tendon_tension_factor": Bounds(lower=0.5, upper=2.0, prior=PRIOR, per=("part", "session"))
}
NAMES = [f"motion {number}" for number in range(4)]


def recorded(pulls=PULLS):
    """Motions of a robot whose winches pull with other gains on another day."""
    ramp = torch.linspace(0.0, 1.0, STEPS, dtype=torch.float64)[:, None, None]
    logged = ramp * torch.tensor(pulls, dtype=torch.float64)
    gains = torch.tensor([GAINS[session] for session in SESSIONS], dtype=torch.float64)
    q = ROBOT.rollout(
        ROBOT.static_equilibrium(batch=4), STEPS, wr.Inputs(tendon_tension=gains * logged)
    ).q
    seen = torch.stack([MARKERS(positions) for positions in q])
    options = {"observation": MARKERS, "release": ReleaseSettings(window=FIRST)}
    motions = wr.ObservedMotions.of(ROBOT, seen, inputs=wr.Inputs(tendon_tension=logged), **options)
    return replace(motions, trials=replace(motions.trials, sessions=SESSIONS))


def identified(motions, held_out=NAMES[2:]):
    return wr.identify(ROBOT, motions, RANGES, names=NAMES[:2], held_out=held_out)


@pytest.fixture(scope="module")
def motions():
    return recorded()


@pytest.fixture(scope="module")
def found(motions):
    return identified(motions)


def values(identification, session):
    return [identification.of_trials[f"tendon_tension_factor_{side}@{session}"] for side in ROUTES]


def test_first_frames_of_a_new_session_give_its_gains(motions, found):
    assert values(found, "monday") == pytest.approx(GAINS["monday"], rel=5e-3)
    assert values(found, "friday") == pytest.approx(GAINS["friday"], rel=0.02)
    assert found.first_frames == {"friday": dict.fromkeys(NAMES[2:], FIRST)}
    known = wr.evaluate(ROBOT, motions, names=NAMES[2:], parameters=found)
    as_before = wr.evaluate(
        ROBOT, motions, names=NAMES[2:], parameters=identified(motions, held_out=())
    )
    first = np.arange(STEPS + 1) * 0.01 <= FIRST + 1e-9
    assert np.isnan(known[first]).all()
    assert np.isfinite(as_before).all()
    assert known[~first].mean() < 0.05 * as_before[~first].mean()
    assert Identification.from_plain(found.plain()) == found


def test_later_frames_of_a_new_session_change_nothing(motions, found):
    observed = motions.trials.observed.copy()
    observed[2:, 11:] += 0.01
    later = replace(motions, trials=replace(motions.trials, observed=observed))
    assert identified(later).of_trials == found.of_trials


def test_what_first_frames_do_not_show_is_as_in_the_identified_sessions():
    shown = identified(recorded((*PULLS[:2], (0.2, 0.0), (0.3, 0.0))))
    left, right = values(shown, "friday")
    assert left == pytest.approx(GAINS["friday"][0], rel=0.02)
    assert right == pytest.approx(GAINS["monday"][1], rel=1e-3)  # and not the mean of the prior
    assert shown.parameters["tendon_tension_factor_right"] == pytest.approx(
        GAINS["monday"][1], rel=1e-3
    )
    assert shown.of_trials_deviation["tendon_tension_factor_right@friday"] == pytest.approx(
        PRIOR.deviation, rel=0.01
    )


def test_first_frames_count_in_no_error_and_predictions_without_physics_are_shifted(motions, found):
    table = Comparison(
        {"sysid": Model(ROBOT, found)}, motions, NAMES[:2], {"1": NAMES[2:]}, horizons=(0.1, 0.2)
    )
    content = table.errors()
    later = 1e3 * wr.evaluate(ROBOT, motions, names=NAMES[2:], parameters=found)[11:].mean()
    assert content["errors_mm"]["sysid"]["mean"] == pytest.approx(later)
    assert content["first_frames"] == found.first_frames
    assert [*content["horizons"]] == ["0.2"]
    observed = motions.trials.observed[2:]
    offset = (observed[:, :11] - observed[:, :1]).mean((0, 1))
    assert table.simulated["rest"] == pytest.approx(
        observed[:, :1] + offset + np.zeros_like(observed)
    )
    assert content["free_fits"]["sysid"][0]["values"]["scale"] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    "name", [*(f"tendon_tension_{word}" for word in RESPONSES), "tendon_stiffness"]
)
def test_all_that_parts_may_have_may_differ_between_sessions(motions, name):
    # N: on all octaves of the characteristic
    wave = 40.0 * np.sin(0.2 * np.arange(STEPS)) ** 2 + np.zeros((4, 2, 1))
    logged = replace(
        motions, trials=replace(motions.trials, inputs={"tendon_tension": wave.swapaxes(1, 2)})
    )
    one, other = ROBOT.tensor([0.7]), ROBOT.tensor([0.02])
    for trials, mine, theirs in ((NAMES[:2], one, other), (NAMES[2:], other, one)):
        replay = logged.replay(ROBOT, trials)
        mixed = acting(replay, {f"{name}_left": one, f"{name}_left@friday": other})
        assert distance(mixed, acting(replay, {f"{name}_left": mine})) < 1e-12
        assert distance(mixed, acting(replay, {f"{name}_left": theirs})) > 1e-3


def acting(replay, parameters):
    """Tensions, and stiffnesses of the tendons."""
    constants, inputs, _ = replay.prepare(parameters)
    stiffness = next(
        energy["tendon_stiffness"] for energy in constants.values if "tendon_stiffness" in energy
    )
    return inputs.actuation["tendon_tension"], stiffness


def distance(one, other):
    return max(float((a - b).abs().max()) for a, b in zip(one, other, strict=True))


def test_the_report_has_a_table_of_parts_and_sessions_and_a_sentence(found):
    table = trials_table(found)
    assert (table.columns, [row.head for row in table.rows]) == (
        ["Tendon tension factor left", "Tendon tension factor right"],
        ["monday", "friday"],
    )
    sentence = (
        "Values of session friday are estimated from the first 0.1 s "
        "of its trials, which do not count"
    )
    assert table.note.endswith(f"{sentence} in the errors.")
    more = {f"{name.replace('tension_factor', 'tension_zero')}": 0.01 for name in found.of_trials}
    table = trials_table(replace(found, of_trials={**found.of_trials, **more}))
    assert (table.columns, len(table.rows)) == (["monday", "friday"], 4)
    assert first_frames_text({"x": {"x": 0.2}}).startswith(
        "Values of held-out trials are estimated from the first 0.2"
    )
    assert not first_frames_text({})


def test_wrong_input_is_refused(motions, found):
    def changed(**values):
        return replace(motions, trials=replace(motions.trials, **values))

    hidden, some = motions.trials.observed.copy(), motions.trials.observed.copy()
    hidden[2:, :11], some[3, :11] = np.nan, np.nan
    said = (
        r"no marker is seen in the first 0\.1 s of 'motion 2', 'motion 3', "
        "from which values of the session 'friday'"
    )
    refuses(InputError, said, identified, changed(observed=hidden))
    assert identified(changed(observed=some)).first_frames == {"friday": {"motion 2": FIRST}}
    said = (
        "per names session, but the trial 'motion 1' has none: "
        r"set data\.trials\.motion 1\.session"
    )
    refuses(InputError, said, identified, changed(sessions=("monday", "", "friday", "friday")))
    whole = replace(found, first_frames={"friday": dict.fromkeys(NAMES[2:], 1.0)})
    compared = Comparison({"sysid": Model(ROBOT, whole)}, motions, NAMES[:2], {"1": NAMES[2:]})
    refuses(
        InputError,
        "values of 'motion 2' are estimated from all of it, so that nothing is left",
        compared.errors,
    )
    for per in ("chamber", ["part", "week"], ["session", "trial"]):
        limits = {"tendon_tension_factor": {"lower": 0.5, "upper": 2.0, "per": per}}
        said = (
            rf"factor\.per is {re.escape(repr(per))}: it must be one of all, .* "
            r"or \[part, session\] or \[part, trial\]"
        )
        refuses(InputError, said, parse, IdentifySettings, {"parameters": limits}, "identify")
    refuses(
        InputError,
        "per names session, but there is no prior",
        Bounds,
        lower=0.5,
        upper=2.0,
        per=["part", "session"],
    )
