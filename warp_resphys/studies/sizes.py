"""Which linear solver for which size: time and memory of a step and its adjoint, and how they grow."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import warp as wp

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..experiment.schema import NATURAL, POSITIVE, Kind, check
from ..fem.body import Body
from ..io.errors import ResphysError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.memory import peak_memory_gib
from ..io.progress import Progress, be_quiet
from ..linalg.choice import LINEAR_SOLVERS
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .benchmark import now
from .command import WORDS, show, table_of

FIGURES: Final = ("forward_s", "adjoint_s", "memory_gib")
_ELEMENTS: Final = ("hexahedron8", "tetrahedron10")
_DIVISIONS: Final = Kind(
    lambda value: isinstance(value, list) and bool(value) and all(isinstance(d, list) and len(d) == 3 for d in value),
    "a list of divisions, three whole numbers each",
)
_FITTED: Final = 3  # largest sizes that exponents are fitted to
_CHILD: Final = "import sys; from warp_resphys.studies.sizes import measured; measured(sys.stdin.read())"


def size_study(config: Mapping[str, Any], folder: Path) -> None:
    """Prints a table and the exponents for every element and Poisson's ratio, and writes size_study.json.

    Every case has a process of its own, so that its memory is its own too. One that fails or takes longer than
    ``longest`` leaves a word in its row, and larger ones of its kind are left out.

    Raises:
        InputError: a value that cannot be used.
    """
    _check(config)
    rows: list[dict[str, Any]] = []
    given_up: set[tuple[str, float, str]] = set()
    cases = list(_cases(config))
    with Progress("sizes", len(cases), "cases") as progress:
        for case in cases:
            kind = (case["element"], case["poissons_ratio"], case["linear_solver"])
            if kind not in given_up:
                row = {**case, **_in_a_process(case, config["longest"])}
                rows.append(row)
                write_json(folder / "size_study.json", {"hardware": hardware(), "rows": rows})
                if "failed" in row:
                    given_up.add(kind)
            progress.advance()
    for element in config["elements"]:
        for ratio in config["poissons_ratios"]:
            mine = [r for r in rows if r["element"] == element and r["poissons_ratio"] == ratio]
            show(_table(f"{element}, nu {ratio:g}, steps of {1e3 * config['time_step']:g} ms", mine), _fits(mine))


def _check(config: Mapping[str, Any]) -> None:
    for key in ("hexahedron_divisions", "tetrahedron_divisions"):
        check(key, config[key], _DIVISIONS)
    for key in ("steps", "repeats"):
        check(key, config[key], NATURAL)
    for key in ("time_step", "longest", "relative_tolerance", "youngs_modulus"):
        check(key, config[key], POSITIVE)
    check(
        "elements",
        config["elements"],
        Kind(lambda value: WORDS.fits(value) and {*value} <= {*_ELEMENTS}, f"some of {', '.join(_ELEMENTS)}"),
    )
    check(
        "linear_solvers",
        config["linear_solvers"],
        Kind(lambda value: WORDS.fits(value) and {*value} <= {*LINEAR_SOLVERS}, f"some of {', '.join(LINEAR_SOLVERS)}"),
    )


def _cases(config: Mapping[str, Any]) -> Sequence[dict[str, Any]]:
    shared = ("size", "youngs_modulus", "time_step", "steps", "repeats", "relative_tolerance", "device")
    divisions = dict(zip(_ELEMENTS, (config["hexahedron_divisions"], config["tetrahedron_divisions"]), strict=True))
    return [
        {
            "element": element,
            "poissons_ratio": ratio,
            "divisions": each,
            "linear_solver": solver,
            **{key: config[key] for key in shared},
        }
        for element in config["elements"]
        for ratio in config["poissons_ratios"]
        for each in divisions[element]
        for solver in config["linear_solvers"]
    ]


def _in_a_process(case: Mapping[str, Any], longest: float) -> dict[str, Any]:
    """What `measured` prints of a case, or why it does not."""
    try:
        run = subprocess.run(
            [sys.executable, "-c", _CHILD],
            input=json.dumps(case),
            capture_output=True,
            text=True,
            check=False,
            timeout=longest,
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"more than {longest:g} s"}
    if run.returncode != 0:
        return {"failed": run.stderr.strip().splitlines()[-1] if run.stderr.strip() else f"exit code {run.returncode}"}
    found: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return found


def measured(text: str) -> None:
    """Prints as JSON what a case takes: a beam that falls from its straight shape, and the gradient by its start."""
    be_quiet()
    wp.config.log_level = wp.LOG_WARNING
    try:
        print(json.dumps(measure(json.loads(text))))
    except ResphysError as error:
        raise SystemExit(str(error)) from None


def measure(case: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds of a step and its adjoint, iterations and factorisations of a step, and the process's memory [GiB].

    What is made once, kernels and layouts, is not timed: a step and its adjoint go before.
    """
    mesh = _mesh(case)
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
    material = Corotated(case["youngs_modulus"], case["poissons_ratio"])
    settings = SolverSettings(
        "quasi_newton", relative_tolerance=case["relative_tolerance"], linear_solver=case["linear_solver"]
    )
    simulator = Simulator(body, material, case["time_step"], solver=settings, device=case["device"])
    rest = simulator.rest_state()
    device = rest.q.device
    forward, adjoint, reports = [], [], []
    for repeat in range(1 + case["repeats"]):
        q = rest.q.clone().requires_grad_(True)
        steps = case["steps"] if repeat else 1
        began = now(device)
        trajectory = simulator.rollout(State(q, rest.v), steps, Inputs())
        ended = now(device)
        torch.autograd.grad(trajectory.q[-1].square().sum(), q)
        forward.append((ended - began) / steps)
        adjoint.append((now(device) - ended) / steps)
        reports = trajectory.reports
    return {
        "unknowns": 3 * (body.n_vertices - len(simulator.fixed)),
        "forward_s": float(np.median(forward[1:])),
        "adjoint_s": float(np.median(adjoint[1:])),
        "memory_gib": peak_memory_gib(),
        "iterations": float(np.mean([float(each.iterations) for each in reports])),
        "factorisations": float(np.mean([float(each.factorisations) for each in reports])),
    }


def _mesh(case: Mapping[str, Any]) -> Mesh:
    if case["element"] == "hexahedron8":
        return box_hexahedra(case["size"], case["divisions"])
    return box_tetrahedra(case["size"], case["divisions"], order=2)


def _table(title: str, rows: Sequence[Mapping[str, Any]]) -> Any:
    cells = []
    for row in rows:
        name = row["linear_solver"]
        if "failed" in row:
            cells.append([" x ".join(map(str, row["divisions"])), name, row["failed"], *[""] * 5])
            continue
        figures = (f"{row['forward_s']:.4g}", f"{row['adjoint_s']:.4g}", f"{row['memory_gib']:.2f}")
        counts = (f"{row['iterations']:.1f}", f"{row['factorisations']:.1f}")
        cells.append([" x ".join(map(str, row["divisions"])), name, str(row["unknowns"]), *figures, *counts])
    headings = ["divisions", "linear solver", "unknowns", "forward [s]", "adjoint [s]", "memory [GiB]"]
    return table_of(title, [*headings, "iterations", "factorisations"], cells)


def exponents(rows: Sequence[Mapping[str, Any]], largest: int = _FITTED) -> dict[str, dict[str, float]]:
    """By solver, the powers of the unknowns that time and memory grow with, over the largest sizes measured."""
    found: dict[str, dict[str, float]] = {}
    for solver in dict.fromkeys(row["linear_solver"] for row in rows):
        mine = [row for row in rows if row["linear_solver"] == solver and "failed" not in row][-largest:]
        if len(mine) >= 2:
            size = np.log([row["unknowns"] for row in mine])
            found[solver] = {key: float(np.polyfit(size, np.log([row[key] for row in mine]), 1)[0]) for key in FIGURES}
    return found


def _fits(rows: Sequence[Mapping[str, Any]]) -> str:
    said = [
        f"{solver} {powers['forward_s']:.2f}, {powers['adjoint_s']:.2f}, {powers['memory_gib']:.2f}"
        for solver, powers in exponents(rows).items()
    ]
    return f"Exponents of forward, adjoint and memory over the largest {_FITTED} sizes: {'; '.join(said)}.\n"
