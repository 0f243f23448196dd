"""One small run with a laboratory, for all tests of environments."""

import pytest

from support.main_job import run_without_report
from warp_resphys.control.reduction import fingerprint
from warp_resphys.environments import making

RUN = [
    "experiment=tendon_rod",
    *("mesh.layers=3", "mesh.nodes=20", "laboratory.mesh.layers=4", "laboratory.mesh.nodes=20"),
    *("data.steps=30", "data.sequences=5", "data.train=3", "data.validation=1", "data.test=1", "data.horizons=[]"),
    *("data.rest_seconds=0.01", "data.cutoff=20.0", "parallel={processes:1,batch:3}", "timing=false"),
    *("laboratory.sequences.rest=0.01", "laboratory.sequences.correlation_time=0.06"),
    *("identify.trials=1", "identify.seconds=0.1", "identify.max_evaluations=3", "trainer={epochs:4,rollout_every:2}"),
    *("network={position_modes:2,velocity_modes:2,force_modes:2,width:8}", "trainer.batch_size=16"),
    "actuation.filter_time_constants=[0.1]",
]


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    making.register()
    return run_without_report(tmp_path_factory.mktemp("environments"), *RUN)


@pytest.fixture(scope="session", autouse=True)
def sampled_places():
    """The reachable places of every robot so far, which are not sampled again."""
    sample, kept = making._reach, {}

    def sampled(robot, *arguments):
        if (key := fingerprint(robot) + repr(arguments)) not in kept:
            kept[key] = sample(robot, *arguments)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "_reach", sampled)
        yield kept
