"""Simulates reference trajectories from their own parameters and compares every vertex.

python scripts/verify.py FILE... [--solver quasi_newton] [--tolerance 1e-7] [--device cpu]

Exit code: 0 where every vertex of every file stays within 1e-8 m, 1 where one does not, 2 where a file cannot be used.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from warp_resphys.io.errors import ConvergenceError, ResphysError

LARGEST_ERROR = 1e-8  # m
SOLVERS = ("projective_dynamics", "quasi_newton", "newton")
TOLERANCE = 1e-7  # relative residual; every solver then stays within a tenth of the largest error
MAX_ITERATIONS = 50_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the largest vertex error of each file and solver.

    Args:
        arguments: of the command line; those of the process where left out.

    Returns:
        The exit code.
    """
    options = _parser().parse_args(arguments)
    try:
        return _verify(options)
    except ResphysError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="reference trajectory (.npz)")
    parser.add_argument(
        "--solver", action="append", choices=SOLVERS, help="may be repeated; all of them where left out"
    )
    parser.add_argument(
        "--tolerance", type=float, default=TOLERANCE, help=f"relative residual, default {TOLERANCE:.0e}"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda, default cpu")
    return parser


def _verify(options: argparse.Namespace) -> int:
    import warp as wp

    from warp_resphys.dynamics.nonlinear_solver import SolverSettings
    from warp_resphys.experiment.build import choose_device
    from warp_resphys.studies.verification import compare_with_reference, read_reference

    wp.config.log_level = wp.LOG_WARNING
    device = choose_device(options.device)
    references = {path: read_reference(path) for path in options.files}
    within = True
    print(f"{'file':32}{'solver':22}{'tolerance':>10}{'iterations':>12}{'largest error [m]':>20}")
    for path, reference in references.items():
        for name in options.solver or SOLVERS:
            settings = SolverSettings(name, relative_tolerance=options.tolerance, max_iterations=MAX_ITERATIONS)
            label = f"{path.stem:32}{name:22}{options.tolerance:10.0e}"
            try:
                result = compare_with_reference(reference, settings, device)
            except ConvergenceError as error:
                print(f"{label}  not converged: {error}")
                within = False
                continue
            passed = result.largest_error <= LARGEST_ERROR
            within &= passed
            verdict = "" if passed else f"  exceeds {LARGEST_ERROR:.0e}"
            print(f"{label}{result.iterations:12.1f}{result.largest_error:20.2e}{verdict}", flush=True)
    return 0 if within else 1


if __name__ == "__main__":
    sys.exit(main())
