"""Stage: the physical parameters that explain the training trials."""

from functools import cache

from ...io.files import write_json
from ...io.progress import Progress
from ...io.stages import StageContext
from ...learning.identification import Bounds
from ...learning.replay import Release, Replay
from ..measured.files import IDENTIFICATION
from ..measured.identify import evaluations_done, kept_of, landscape, remove_kept, search
from ..trajectories import evenly
from .scene import DrivenScene

_KIND = "simulation"


def identify_driven(context: StageContext) -> None:
    """Writes identification.json: the configured parameters, and the landscape over E and nu.

    A few of the training trials, and the beginning of each, tell enough: ``identify.trials`` and ``identify.seconds``.
    """
    settings = context.settings
    config = settings["identify"]
    scene = DrivenScene(settings, context.run_dir)
    train = tuple(evenly(list(settings["split"]["train"]), config["trials"]))
    bounds = {name: Bounds(**each) for name, each in config["parameters"].items()}

    @cache
    def replays(kind: str) -> tuple[Replay, Release]:
        del kind  # There is one simulator.
        return scene.replay(train)

    evaluations = config["starts"] * config["max_evaluations"]
    seconds = min(config["seconds"], scene.learned_steps * scene.simulator.time_step)
    with Progress(
        "identify", evaluations, "evaluations at most", evaluations_done(kept_of(context, _KIND))
    ) as progress:
        found = {"sysid": search(context, _KIND, bounds, replays, seconds, progress)}
    found["landscape"] = landscape(context, *replays(_KIND), bounds, found["sysid"]["parameters"], seconds)
    write_json(context.run_dir / IDENTIFICATION, found)
    remove_kept(context)
