"""What tests of the core need, so that they run with the floors above it hidden.

pytest -p support.core_alone --confcutdir=tests/core tests/core
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import torch
import warp as wp

from support.devices import device

wp.config.log_level = wp.LOG_WARNING
wp.init()
torch.set_num_threads(1)
__all__ = ["device"]
