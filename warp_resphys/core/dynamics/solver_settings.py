"""Settings of the solver of a step."""

from typing import Annotated, Literal

from pydantic import Field

from ...io.settings import Natural, NotNegative, Settings, setting
from ..linalg.solver_names import LinearSolverName

SolverName = Literal["quasi_newton", "newton", "projective_dynamics"]


class SolverSettings(Settings):
    """Settings of the solver of a step, `dynamics.nonlinear_solver`."""

    name: SolverName = setting("quasi_newton", "method")
    relative_tolerance: Annotated[float, Field(gt=0.0, le=0.1)] = setting(
        1.0e-8, "residual over the forces in balance"
    )
    absolute_tolerance: NotNegative = setting(
        1.0e-12, "residual at which a step is always solved", "N"
    )
    max_iterations: Natural = setting(500, "iterations after which a step fails")
    memory: Natural = setting(12, "number of pairs that L-BFGS keeps")
    linear_solver: LinearSolverName = setting("auto", "linear solver; pardiso needs a CPU")
    factors: Literal["double", "single"] = setting(
        "double", "precision of factors and L-BFGS pairs; results stay accurate"
    )
    on_failure: Literal["raise", "count"] = setting(
        "raise", "effect of a failed step; count continues"
    )
