"""Small runs with a laboratory, for all tests of environments."""

import pytest

from support.main_job import DRIVEN, ROD, run_without_report
from warp_resphys.control.reduction import fingerprint
from warp_resphys.environments import making

SHORT = [*DRIVEN, "data.steps=30", "mesh_check=null"]
RUN = ["experiment=tendon_rod", *ROD, *SHORT]
BOX = "boxes: [[[-0.007, -0.007, -0.08], [0.007, 0.007, 0.0]]]"
MESHES = [
    "mesh.size=0.014",
    f"laboratory.mesh={{kind: boxes, {BOX}, size: 0.01}}",
    "laboratory.time_step=0.01",
]
FINGER = ["experiment=finger", *MESHES, *SHORT]


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    making.register()
    return run_without_report(tmp_path_factory.mktemp("environments"), *RUN)


@pytest.fixture(scope="session")
def fingers(tmp_path_factory):
    making.register()
    return run_without_report(tmp_path_factory.mktemp("grasps"), *FINGER)


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
