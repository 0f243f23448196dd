"""Which linear solver for which size: time and memory of a step and its gradient, and how they grow."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal

import numpy as np

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..fem.body import Body
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.memory import peak_memory_gib
from ..io.progress import Progress
from ..io.settings import Many, Natural, Positive, Settings, Some, Word, parse, setting
from ..linalg.choice import LinearSolverName
from ..mesh.tetrahedra import fill_surface
from ..settings.mesh import LengthUnit
from .beam import BeamStudy, Divisions, beam_mesh, clamped
from .tables import Sheet, show
from .timing import TimedRollout, run_in_new_process

FIGURES: Final = ("forward_s", "adjoint_s", "memory_gib")
_FITTED: Final = 3  # largest sizes that exponents are fitted to
_HELD: Final = 0.05  # of the length of a body in a surface along x, from its smallest x
Element = Literal["hexahedron8", "tetrahedron4", "tetrahedron10"]


class SizeCase(Settings):
    """A body and a linear solver; a box by its divisions, the inside of a surface by the length of edges."""

    element: Element
    poissons_ratio: float
    divisions: Divisions | None = None
    length: Positive | None = setting(None, unit="m")
    linear_solver: LinearSolverName


class SizeStudy(BeamStudy):
    """The configuration ``benchmark_sizes``, which explains its keys."""

    elements: Some[Element]
    hexahedron_divisions: Some[Divisions]
    tetrahedron_divisions: Some[Divisions]
    surface: Word | None
    units: LengthUnit
    lengths: Many[Positive] = setting(unit="m")
    linear_solvers: Some[LinearSolverName]
    time_step: Positive = setting(unit="s")
    steps: Natural
    relative_tolerance: Positive
    longest: Positive = setting(unit="s")
    device: Word

    def cases(self) -> list[SizeCase]:
        """All cases, of each element, Poisson's ratio and solver in the order of size.

        Raises:
            InputError: a surface and hexahedra, or no lengths for a surface.
        """
        if self.surface is not None and ("hexahedron8" in self.elements or not self.lengths):
            raise InputError("a surface is filled with tetrahedra of given lengths: set elements and lengths.")
        boxes = {"hexahedron8": self.hexahedron_divisions}
        sizes: dict[str, list[dict[str, Any]]] = {
            element: [{"length": length} for length in self.lengths]
            if self.surface is not None
            else [{"divisions": counts} for counts in boxes.get(element, self.tetrahedron_divisions)]
            for element in self.elements
        }
        return [
            SizeCase.model_validate({"element": element, "poissons_ratio": ratio, "linear_solver": solver, **size})
            for element in self.elements
            for ratio in self.poissons_ratios
            for size in sizes[element]
            for solver in self.linear_solvers
        ]

    def body(self, case: SizeCase) -> Body:
        """The body of a case, fixed at the smallest x."""
        if self.surface is None or case.length is None:
            assert case.divisions is not None
            return clamped(beam_mesh(case.element, self.size, case.divisions))
        order = 1 if case.element == "tetrahedron4" else 2
        mesh = fill_surface(self.surface, case.length, self.units, order)
        x = mesh.vertices[:, 0]
        return Body(mesh, fixed=np.flatnonzero(x <= x.min() + _HELD * np.ptp(x)))


class SizeTask(Settings):
    """A case and its study, for a process of its own."""

    study: SizeStudy
    case: SizeCase


def size_study(study: SizeStudy, folder: Path) -> None:
    """Prints a table and the exponents for every element and Poisson's ratio, and writes size_study.json.

    Every case runs in its own process, whose memory is measured. The row of a case that fails or takes longer than
    ``longest`` holds the error; larger cases of its element, Poisson's ratio and solver are skipped.
    """
    rows: list[dict[str, Any]] = []
    given_up = set()
    cases = study.cases()
    with Progress("sizes", len(cases), "cases") as progress:
        for case in cases:
            kind = (case.element, case.poissons_ratio, case.linear_solver)
            if kind not in given_up:
                try:
                    task = SizeTask(study=study, case=case).plain()
                    _, result = run_in_new_process(measure, task, timeout=study.longest)
                except (TimeoutError, RuntimeError) as error:
                    result = {"failed": str(error)}
                    given_up.add(kind)
                rows.append({**case.plain(), **result})
                write_json(folder / "size_study.json", {"hardware": hardware(), "study": study.plain(), "rows": rows})
            progress.advance()
    for element in study.elements:
        for ratio in study.poissons_ratios:
            same = [row for row in rows if row["element"] == element and row["poissons_ratio"] == ratio]
            powers = {name: fit.values() for name, fit in exponents(same).items()}
            fits = [f"{name} {', '.join(f'{power:.2f}' for power in fit)}" for name, fit in powers.items()]
            show(
                _table(f"{element}, nu {ratio:g}, steps of {1e3 * study.time_step:g} ms", same),
                f"Exponents of forward, adjoint and memory over the largest {_FITTED} sizes: {'; '.join(fits)}.\n",
            )


def measure(values: dict[str, Any]) -> dict[str, Any]:
    """Seconds of a step and of its gradient with respect to the start, work of the solver, memory of the process.

    The first step and gradient compile kernels and make layouts, and are not timed.

    Args:
        values: a `SizeTask` as plain data.
    """
    task = parse(SizeTask, values)
    study, case = task.study, task.case
    body = study.body(case)
    solver = SolverSettings(relative_tolerance=study.relative_tolerance, linear_solver=case.linear_solver)
    material = Corotated(study.youngs_modulus, case.poissons_ratio)
    simulator = Simulator(body, material, study.time_step, solver=solver, device=study.device)
    TimedRollout(simulator, simulator.rest_state(), 1).measure()
    timed = TimedRollout(simulator, simulator.rest_state(), study.steps)
    for _ in range(study.repeats):
        timed.measure()
    _, forward, adjoint = timed.a_step(median)
    return {
        "unknowns": timed.unknowns,
        "forward_s": forward,
        "adjoint_s": adjoint,
        "memory_gib": peak_memory_gib(),
        "iterations": timed.iterations,
        "factorisations": timed.factorisations,
    }


def _table(title: str, rows: Sequence[Mapping[str, Any]]) -> Sheet:
    columns = (
        "size {size} | linear solver {linear_solver} | unknowns {unknowns} | forward [s] {forward_s:.4g} | "
        "adjoint [s] {adjoint_s:.4g} | memory [GiB] {memory_gib:.2f} | iterations {iterations:.1f} | "
        "factorisations {factorisations:.1f}"
    )
    rows = [{**row, "size": _size(row)} for row in rows]
    measured = Sheet.of(title, columns, [row for row in rows if "failed" not in row])
    lines = iter(measured.rows)
    failed = [row.get("failed") and [row["size"], row["linear_solver"], row["failed"], *[""] * 5] for row in rows]
    return replace(measured, rows=[line or next(lines) for line in failed])


def _size(row: Mapping[str, Any]) -> str:
    """Divisions of a box, or edges in a surface, in words."""
    return " x ".join(map(str, row["divisions"])) if row["divisions"] else f"{1e3 * row['length']:g} mm"


def exponents(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Fits exponents of time and memory against the number of unknowns to the three largest sizes, by solver."""
    powers: dict[str, dict[str, float]] = {}
    for solver in dict.fromkeys(row["linear_solver"] for row in rows):
        largest = [row for row in rows if row["linear_solver"] == solver and "failed" not in row][-_FITTED:]
        if len(largest) >= 2:
            size = np.log([row["unknowns"] for row in largest])
            powers[solver] = {
                key: float(np.polyfit(size, np.log([row[key] for row in largest]), 1)[0]) for key in FIGURES
            }
    return powers
