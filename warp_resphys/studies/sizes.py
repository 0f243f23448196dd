"""Which linear solver for which size: time and memory of a step and its gradient, and how they grow."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Corotated
from ..io.files import write_json
from ..io.machine import hardware
from ..io.memory import peak_memory_gib
from ..io.progress import Progress
from ..io.settings import Natural, Positive, Some, Word, parse, setting
from ..linalg.choice import LinearSolverName
from .beam import BeamStudy, Divisions, beam_mesh, clamped
from .command import show
from .tables import Sheet
from .timing import TimedRollout, run_in_new_process

FIGURES: Final = ("forward_s", "adjoint_s", "memory_gib")
_FITTED: Final = 3  # largest sizes that exponents are fitted to
Element = Literal["hexahedron8", "tetrahedron10"]


class SizeCase(NamedTuple):
    """A beam and a linear solver."""

    element: Element
    poissons_ratio: float
    divisions: Sequence[int]
    linear_solver: LinearSolverName


class SizeStudy(BeamStudy):
    """The configuration ``benchmark_sizes``, which has what the keys mean, and their values."""

    elements: Some[Element]
    hexahedron_divisions: Some[Divisions]
    tetrahedron_divisions: Some[Divisions]
    linear_solvers: Some[LinearSolverName]
    time_step: Positive = setting(unit="s")
    steps: Natural
    relative_tolerance: Positive
    longest: Positive = setting(unit="s")
    device: Word

    def cases(self) -> list[SizeCase]:
        """All cases, larger ones of their kind after smaller ones."""
        divisions = {"hexahedron8": self.hexahedron_divisions, "tetrahedron10": self.tetrahedron_divisions}
        return [
            SizeCase(element, ratio, own, solver)
            for element in self.elements
            for ratio in self.poissons_ratios
            for own in divisions[element]
            for solver in self.linear_solvers
        ]


def size_study(config: Mapping[str, Any], folder: Path) -> None:
    """Prints a table and the exponents for every element and Poisson's ratio, and writes size_study.json.

    Every case has a process of its own, so that its memory is its own too. One that fails or takes longer than
    ``longest`` leaves a sentence in its row, and larger ones of its kind are left out.

    Raises:
        InputError: a value that cannot be used.
    """
    study = parse(SizeStudy, config)
    rows: list[dict[str, Any]] = []
    given_up = set()
    cases = study.cases()
    with Progress("sizes", len(cases), "cases") as progress:
        for case in cases:
            kind = (case.element, case.poissons_ratio, case.linear_solver)
            if kind not in given_up:
                values = {"study": study.plain(), "case": case._asdict()}
                try:
                    _, result = run_in_new_process(measure, values, timeout=study.longest)
                except (TimeoutError, RuntimeError) as error:
                    result = {"failed": str(error)}
                    given_up.add(kind)
                rows.append({**case._asdict(), **result})
                write_json(folder / "size_study.json", {"hardware": hardware(), "study": study.plain(), "rows": rows})
            progress.advance()
    for element in study.elements:
        for ratio in study.poissons_ratios:
            own = [row for row in rows if row["element"] == element and row["poissons_ratio"] == ratio]
            show(_table(f"{element}, nu {ratio:g}, steps of {1e3 * study.time_step:g} ms", own), _fits(own))


def measure(values: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds of a step and its gradient by the start, the work of the solver in a step, and the process's memory.

    Kernels and layouts are made by a first step and its gradient, which are not timed.

    Args:
        values: ``study``, the settings, and ``case``, the fields of a `SizeCase`, as plain data.
    """
    study, case = parse(SizeStudy, values["study"]), SizeCase(**values["case"])
    body = clamped(beam_mesh(case.element, study.size, case.divisions))
    solver = SolverSettings(relative_tolerance=study.relative_tolerance, linear_solver=case.linear_solver)
    material = Corotated(study.youngs_modulus, case.poissons_ratio)
    simulator = Simulator(body, material, study.time_step, solver=solver, device=study.device)
    TimedRollout(simulator, simulator.rest_state(), 1).measure()
    timed = TimedRollout(simulator, simulator.rest_state(), study.steps)
    for _ in range(study.repeats):
        timed.measure()
    forward, adjoint = timed.a_step(median)
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
        "divisions {divisions} | linear solver {linear_solver} | unknowns {unknowns} | forward [s] {forward_s:.4g} | "
        "adjoint [s] {adjoint_s:.4g} | memory [GiB] {memory_gib:.2f} | iterations {iterations:.1f} | "
        "factorisations {factorisations:.1f}"
    )
    rows = [{**row, "divisions": " x ".join(map(str, row["divisions"]))} for row in rows]
    measured = Sheet.of(title, columns, [row for row in rows if "failed" not in row])
    lines = iter(measured.rows)
    failed = [row.get("failed") and [row["divisions"], row["linear_solver"], row["failed"], *[""] * 5] for row in rows]
    return replace(measured, rows=[line or next(lines) for line in failed])


def exponents(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """By solver, the powers of the number of unknowns that time and memory grow with, over the three largest sizes."""
    powers: dict[str, dict[str, float]] = {}
    for solver in dict.fromkeys(row["linear_solver"] for row in rows):
        own = [row for row in rows if row["linear_solver"] == solver and "failed" not in row][-_FITTED:]
        if len(own) >= 2:
            size = np.log([row["unknowns"] for row in own])
            powers[solver] = {key: float(np.polyfit(size, np.log([row[key] for row in own]), 1)[0]) for key in FIGURES}
    return powers


def _fits(rows: Sequence[Mapping[str, Any]]) -> str:
    fits = [
        f"{solver} {', '.join(f'{power:.2f}' for power in own.values())}" for solver, own in exponents(rows).items()
    ]
    return f"Exponents of forward, adjoint and memory over the largest {_FITTED} sizes: {'; '.join(fits)}.\n"
