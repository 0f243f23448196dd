import os
from pathlib import Path

import pytest
import torch
import warp as wp

wp.config.log_level = wp.LOG_WARNING
torch.set_num_threads(1)

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Recordings and meshes that are not part of the repository."""
    named = os.environ.get("WARP_RESPHYS_DATA")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no measured data: set WARP_RESPHYS_DATA to a folder with beam_mocap, segment_mocap, sopra_mesh")
    return folder


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Reference trajectories that are not part of the repository."""
    named = os.environ.get("WARP_RESPHYS_REFERENCE")
    folder = Path(named) if named else Path(__file__).parents[2] / "shared" / "reference"
    if not folder.is_dir():
        pytest.skip("no reference trajectories: set WARP_RESPHYS_REFERENCE to a folder with their .npz files")
    return folder
