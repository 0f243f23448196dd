"""What tests of the core need, so that they run with the floors above it hidden.

pytest -p support.core_alone --confcutdir=tests/core tests/core
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import pytest
import torch
import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.init()
torch.set_num_threads(1)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    return request.param
