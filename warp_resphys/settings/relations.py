"""Relations between the groups of a run, which are checked when its settings are made.

Each check raises a ValueError whose message begins with a dotted key, as in `io.settings`.
"""

from typing import Final

from ..io.errors import listed
from .data_kinds import ReleaseFromLoad
from .learning import LawSettings
from .run_keys import RunKeys

# Parameters of a law that tests of specimens do not show.
_OF_SPECIMENS: Final = {"density", "poissons_ratio"}
# Keys of laws from trials.
_OF_TRIALS: Final = ("families", "trials", "seconds", "max_evaluations", "tolerance")
_LEAST_STEPS: Final = 20  # of a path that is followed


def check_relations(run: RunKeys) -> None:
    """Checks all relations between the groups of a run."""
    _check_data(run)
    for model in ("resphys", "simfree"):
        run.training_of(model)
    _check_times(run)
    _check_base(run)
    _check_obstacles(run)
    _check_view(run)
    _check_law(run)
    _check_control(run)


def _check_data(run: RunKeys) -> None:
    """Checks that groups fit the kind of the data."""
    if (run.markers is None) != (run.recorded is None):
        if run.markers is None:
            raise ValueError(
                "markers is null, but data.kind is recorded: name the markers, with their places."
            )
        raise ValueError(
            f"data.kind is {run.data.kind!r}, "
            "in which all vertices are observed: leave markers null."
        )
    if run.pictures is not None:
        if run.identify is None:
            raise ValueError(
                "identify is null, but data.kind is pictures: name parameters to identify."
            )
        return
    if run.material_tests is not None:
        if run.law is None:
            raise ValueError(
                "law is null, but data.kind is material_tests: give its terms, "
                "law={terms: [ogden_3]}."
            )
        lost = _OF_SPECIMENS - {*run.simulation.values}
        if lost:
            raise ValueError(
                f"simulation lacks {min(lost)}, which tests of specimens do not show: give it."
            )
        more = {*run.simulation.values} - _OF_SPECIMENS
        if more:
            raise ValueError(
                f"simulation has {min(more)}, which tests of specimens identify, "
                "or lack: leave it out."
            )
        unset = LawSettings()
        idle = [key for key in _OF_TRIALS if getattr(run.law, key) != getattr(unset, key)]
        if idle:
            raise ValueError(
                f"law.{idle[0]} is for laws from trials, "
                "and data.kind is material_tests: leave it out."
            )
        if run.material_tests.scaled and run.law.file is None:
            raise ValueError(
                "law.file is null, but data.scaled multiplies a law: name it: "
                "law.file=ecoflex_00_30."
            )
        return
    if run.tip is None:
        raise ValueError(
            "tip is null: name the vertices whose mean motion is reported, such as {x: 0.1}."
        )
    if run.shapes and (run.recorded is not None or (run.identify is None and run.law is None)):
        why = "nothing is identified" if run.recorded is None else "data.kind is recorded"
        raise ValueError(
            f"shapes are bodies with the identified material of a simulated target, but {why}: "
            "leave shapes out."
        )
    if run.recorded is None and run.target is None:
        raise ValueError(
            "target is null: give the simulation that stands in for the real body, "
            "such as its material."
        )
    if run.is_laboratory and run.laboratory is None:
        raise ValueError("data.folder is not set: give the folder of the recordings.")
    if run.mesh_check is not None and run.markers is None:
        raise ValueError("mesh_check compares markers, but markers is null: leave it null, too.")
    if run.ablation is not None and run.reconstruction is None:
        raise ValueError(
            "reconstruction is none, but ablation reconstructs forces: choose one of its methods."
        )
    if run.ablation is not None:
        weights = run.data.weights_g.observed if isinstance(run.data, ReleaseFromLoad) else ()
        if len(weights) != 1:
            raise ValueError(
                f"data.weights_g.observed is {list(weights)}: "
                "it must be a list of one weight, in g."
            )


def _check_times(run: RunKeys) -> None:
    """Checks that the time step resolves the configured frequencies."""
    data, trials = run.recorded, {} if run.laboratory is None else run.laboratory.trials
    frequencies = {
        f"{key}.swings.{name}.frequency": swing.frequency
        for key, motion in run.motions().items()
        for name, swing in (motion.swings or {}).items()
    }
    waves = {name: trial.waves for name, trial in trials.items() if trial.waves is not None}
    frequencies |= {
        f"laboratory.trials.{name}.waves.frequency": wave.frequency for name, wave in waves.items()
    }
    frequencies |= {} if data is None or data.cutoff is None else {"data.cutoff": data.cutoff}
    for key, frequency in frequencies.items():
        if 2.0 * frequency * run.time_step >= 1.0:
            raise ValueError(
                f"{key} is {frequency:g} Hz: it must be below {0.5 / run.time_step:g} Hz, half "
                "of the steps."
            )


def _check_base(run: RunKeys) -> None:
    """Checks that a base that moves is fixed."""
    moved = [key for key in run.motions() if key.endswith("base_motion")]
    moved += ["data.base_motion"] if run.data.base_motion is not None else []
    for prefix, body in run.bodies.items():
        if moved and body.fixed is None:
            raise ValueError(
                f"{moved[0]} moves the fixed vertices, but {prefix}fixed is null: "
                "name some, or leave it out."
            )


def _check_obstacles(run: RunKeys) -> None:
    """Checks that the obstacles that move exist, and are recorded by markers of their own."""
    common = run.data.obstacle_motion
    recorded = [name for name, motion in common.items() if motion == "recorded"]
    keys = {f"data.obstacle_motion.{name}": name for name in recorded}
    keys |= {key: key.rpartition(".")[2] for key in run.motions() if ".obstacle_motion." in key}
    for key, name in keys.items():
        for prefix, body in run.bodies.items():
            if name not in body.obstacles:
                has = listed([*body.obstacles]) if body.obstacles else "none"
                raise ValueError(
                    f"{key} is of {name!r}, but {prefix}obstacles has {has}: choose one of them."
                )
            if not body.obstacles[name].moves:
                raise ValueError(
                    f"{key} moves {name!r}: set {prefix}obstacles.{name}.moves to true."
                )
    if recorded and run.markers is not None:
        taken = {*run.markers.tracked, *run.markers.reference, *run.markers.rigid_bodies}
        if run.markers.labels == "assigned":
            raise ValueError(
                f"data.obstacle_motion.{recorded[0]} is recorded by a marker of its name, but "
                "markers.labels is assigned: use recordings with names, or give the motion."
            )
        both = [name for name in recorded if name in taken]
        if both:
            raise ValueError(
                f"data.obstacle_motion.{both[0]} is recorded by a marker of its name, which is "
                "one of the body, too: give the obstacle another name."
            )


def _check_view(run: RunKeys) -> None:
    """Checks that the recordings show what the settings need of the positions of markers."""
    data, markers = run.recorded, run.markers
    placement = None if run.identify is None else run.identify.placement
    if (
        placement is not None
        and placement.mounting is not None
        and (markers is None or not markers.rigid_bodies)
    ):
        raise ValueError(
            "identify.placement.mounting is of rigid bodies, "
            "and markers.rigid_bodies is empty: leave it out."
        )
    if data is None or markers is None:
        return
    if data.base_motion == "reference" and len(markers.reference) < 3:
        raise ValueError(
            "data.base_motion is reference: name three markers or more, not on a line, in "
            "markers.reference."
        )
    if markers.plane is not None and data.axes is None:
        raise ValueError(
            "markers.plane is set, but data.axes is not: name the axes of the recordings along "
            "which the body's x, y and z are, which define the axis that is not observed."
        )
    if markers.frame == "own" and (
        data.base_motion is not None or data.obstacle_motion or run.motions()
    ):
        raise ValueError(
            "markers.frame is own, but base_motion and obstacle_motion need to know where the "
            "body is: take one of them out."
        )
    whole = markers.plane is None and markers.frame == "body"
    if not whole and placement is not None:
        raise ValueError(
            "identify.placement is set, but with markers.plane, or markers.frame own, recordings "
            "do not determine positions of markers and pose of the body: set it to null."
        )


def _check_law(run: RunKeys) -> None:
    """Checks the law beside the material that it takes the place of."""
    if run.law is not None and run.simulation.regions:
        raise ValueError(
            "law: the simulator has materials by region, "
            "and one law is for one material: leave law out."
        )
    if run.law is not None and run.law.file is None and run.simulation.model == "law":
        raise ValueError(
            "law: simulation.model is law already: identify its parameters in "
            "identify.parameters, or take another one."
        )


def _check_control(run: RunKeys) -> None:
    """Checks control beside the data and the models."""
    control, data = run.control, run.recorded
    if control is None:
        return
    if data is None or run.markers is None or data.folds is not None:
        raise ValueError(
            "control is for a robot with markers and inputs, of one split of its trials: set "
            "control=none, or data.folds=null."
        )
    simulated: list[str] = [model for model in run.models if model != "simfree"]
    for key, models in (("models", control.models), ("receding", control.receding)):
        unknown = [model for model in models if model not in simulated]
        if unknown:
            raise ValueError(
                f"control.{key} has {unknown[0]}: this experiment has {', '.join(simulated)}."
            )
    if not {*control.receding} <= {*control.models}:
        raise ValueError(
            f"control.receding must be among control.models, which are {', '.join(control.models)}."
        )
    missing = [label for label in control.tracked if label not in run.markers.tracked]
    if missing:
        tracked = ", ".join(run.markers.tracked)
        raise ValueError(f"control.tracked names '{missing[0]}': markers.tracked has {tracked}.")
    limits = control.limits
    if not limits.low < limits.high or (
        data.input_limit is not None and limits.high > data.input_limit
    ):
        raise ValueError(
            f"control.limits are from {limits.low:g} to {limits.high:g}: they must rise, to "
            f"data.input_limit of {data.input_limit:g} at most, "
            "the largest input of the training."
        )
    short = [seconds for seconds in control.seconds if seconds < _LEAST_STEPS * run.time_step]
    if short:
        raise ValueError(
            f"control.seconds has {short[0]:g}: a path takes {_LEAST_STEPS} steps at least."
        )
    if run.network.core is not None:
        raise ValueError(
            "control evaluates perceptrons alone: set control=none, or network.core=null."
        )
    if run.obstacles or run.self_contact:
        raise ValueError(
            "control plans with a reduced model, which has no contact: set control=none, or "
            "obstacles={} and self_contact=null."
        )
    if (
        run.is_laboratory
        and run.laboratory is not None
        and any(x.payload for x in run.laboratory.trials.values())
    ):
        raise ValueError("control does not support payloads: remove them from laboratory.trials.")
