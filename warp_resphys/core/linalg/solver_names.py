"""Names of the linear solvers."""

from typing import Literal

LinearSolverName = Literal["auto", "banded", "tiled", "dense", "sparse", "pardiso"]
