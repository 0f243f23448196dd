"""Robots on bodies of MuJoCo models: the arm moves their base,
their reaction acts on the arm (extra ``mujoco``).
"""

from .mount import Mount as Mount
from .mount import MountedState as MountedState
from .mounting_body import base_pose as base_pose
