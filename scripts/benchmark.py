r"""Times the simulator on this machine: medians over repeats
that take turns, beside a yardstick of LAPACK.

    python scripts/benchmark.py step                           one beam, by solver and material
    python scripts/benchmark.py batches --device cuda solver.factors=single
    python scripts/benchmark.py step experiment=sopra --materials configured
    python scripts/benchmark.py batches experiment=sopra_fibres fibres.stiffness=4e3 \
        time_step=0.02 integrator=bdf2 simulation.poissons_ratio=0.49 --materials configured \
        --batches 1 6 --pressure 6e4
    python scripts/benchmark.py sizes mesh=beam_tetrahedra --linear-solvers sparse pardiso
    python scripts/benchmark.py twin RUN engine=reduced        a twin on the trials of a run
    python scripts/benchmark.py gripper
    python scripts/benchmark.py mounts --substeps 1 5          robots on arms, over robots alone
    python scripts/benchmark.py reactions --repeats 400        forces of clamps, over steps without
    python scripts/benchmark.py peers --programs newton mujoco a block in contact, at equal error

Results are printed as tables, and added to a JSON file of the machine, where they replace those of
the same subcommand.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as the command does

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import torch
from benchmarks import gripper, mounted, peers, reactions, steps, twin_rate

from warp_resphys.commands import USER_ERROR
from warp_resphys.core.dynamics.nonlinear_solver import SOLVERS
from warp_resphys.core.linalg.choice import LINEAR_SOLVERS
from warp_resphys.experiment.build import choose_device
from warp_resphys.io.errors import ResphysError
from warp_resphys.io.machine import commit, hardware
from warp_resphys.io.progress import show
from warp_resphys.io.resuming import package_versions
from warp_resphys.io.safe_files import read_json, write_json
from warp_resphys.report.page import PageTable


def main(words: Sequence[str]) -> int:
    """Measures what the words of a command line ask for, and returns the exit code."""
    parser = command_line()
    arguments, settings = parser.parse_known_args(words)
    arguments.settings = settings
    for word in settings:
        if word.startswith("-") or "=" not in word or arguments.subcommand in ("gripper", "peers"):
            parser.error(f"unknown argument {word}")
    try:
        device = choose_device(arguments.device)
        if device.type == "cpu":
            torch.set_num_threads(1)  # as in runs
        results = arguments.measure(arguments)
    except ResphysError as error:
        print(f"error: {error}", file=sys.stderr)
        return USER_ERROR
    for title, rows in results.items():
        if isinstance(rows, float):
            show(f"{title}: {rows:.3g}")
        else:
            cells = [
                [f"{x:.4g}" if isinstance(x, float) else str(x) for x in row.values()]
                for row in rows
            ]
            show(PageTable.plain(title, [name.replace("_", " ") for name in rows[0]], cells))
    machine = hardware()
    place = machine["GPU" if device.type == "cuda" else "processor"]
    path = arguments.output / (re.sub(r"[^a-z0-9]+", "-", place.lower()).strip("-") + ".json")
    about = {
        "command": shlex.join(["python", "scripts/benchmark.py", *words]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit() or "not known",
        "hardware": machine,
        "versions": package_versions(),
    }
    write_json(
        path,
        {**(read_json(path) if path.is_file() else {}), arguments.subcommand: {**about, **results}},
    )
    print(f"Written: {path}")
    return 0


def command_line() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--device", default="cpu", help="cpu, cuda or cuda:1 (default: %(default)s)"
    )
    shared.add_argument(
        "--repeats", type=int, default=5, help="of every case (default: %(default)s)"
    )
    shared.add_argument(
        "--output",
        type=Path,
        default=Path("outputs/benchmark"),
        help="folder (default: %(default)s)",
    )
    body = argparse.ArgumentParser(add_help=False)
    body.add_argument("--materials", nargs="+", choices=steps.MATERIALS, default=["0.45", "0.499"])
    parts = parser.add_subparsers(dest="subcommand", required=True)
    step = parts.add_parser("step", parents=[shared, body], help="one body, by solver")
    batches = parts.add_parser("batches", parents=[shared, body], help="many bodies at once")
    for part, solvers, counts in (
        (step, ["quasi_newton", "newton"], [1]),
        (batches, ["quasi_newton"], None),
    ):
        part.set_defaults(measure=steps.measure_steps)
        part.add_argument("--solvers", nargs="+", choices=SOLVERS, default=solvers)
        part.add_argument("--batches", nargs="+", type=int, default=counts)
        part.add_argument(
            "--steps", type=int, default=60, help="of a roll-out (default: %(default)s)"
        )
        part.add_argument(
            "--pressure",
            type=float,
            default=steps.PRESSURE,
            help="of chambers [Pa] (default: %(default)s)",
        )
        part.add_argument(
            "--floor", action="store_true", help="the body is lifted, and falls on a floor"
        )
    sizes = parts.add_parser(
        "sizes", parents=[shared, body], help="by size of the body and linear solver"
    )
    sizes.set_defaults(measure=steps.measure_sizes)
    sizes.add_argument(
        "--linear-solvers",
        nargs="+",
        choices=LINEAR_SOLVERS,
        default=["banded", "sparse", "pardiso"],
    )
    sizes.add_argument("--refinements", nargs="+", type=float, default=[1.0, 2.0, 3.0, 4.0, 5.0])
    follow = parts.add_parser(
        "twin", parents=[shared], help="a twin that follows the trials of a run"
    )
    follow.set_defaults(measure=twin_rate.measure_twin)
    follow.add_argument("run", type=Path)
    follow.add_argument("--model", default="resphys")
    follow.add_argument("--trials", nargs="+", help="of the run (default: all)")
    follow.add_argument(
        "--every", type=float, default=0.03, help="time between two predictions [s]"
    )
    grasp = parts.add_parser("gripper", parents=[shared], help="grippers that lift a soft ball")
    grasp.set_defaults(measure=gripper.measure_grippers)
    grasp.add_argument("--batches", nargs="+", type=int, help="numbers of grippers")
    grasp.add_argument(
        "--fingers", nargs=3, type=int, default=[2, 2, 10], help="bricks of a finger"
    )
    grasp.add_argument("--factors", choices=["double", "single"], default="double")
    arms = parts.add_parser(
        "mounts", parents=[shared], help="robots on arms of MuJoCo, over robots alone"
    )
    arms.set_defaults(measure=mounted.measure_mounts)
    arms.add_argument(
        "--batches", nargs="+", type=int, default=[1], help="numbers of arms (default: 1)"
    )
    arms.add_argument(
        "--substeps", nargs="+", type=int, default=[1, 5], help="of MuJoCo in a step (default: 1 5)"
    )
    clamps = parts.add_parser(
        "reactions", parents=[shared], help="forces of clamps, over steps without them"
    )
    clamps.set_defaults(measure=reactions.measure_reactions)
    clamps.add_argument(
        "--bodies", nargs="+", choices=reactions.BODIES, default=[*reactions.BODIES]
    )
    clamps.add_argument(
        "--steps", type=int, default=20, help="of a roll-out (default: %(default)s)"
    )
    other = parts.add_parser(
        "peers", parents=[shared], help="beside Newton and MuJoCo, at equal error"
    )
    other.set_defaults(measure=peers.measure_peers)
    other.add_argument(
        "--programs", nargs="*", choices=["newton", "mujoco"], default=["newton", "mujoco"]
    )
    other.add_argument(
        "--divisions", nargs=3, type=int, default=[8, 6, 5], help="bricks of the block"
    )
    return parser


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
