"""What the benchmark has found, as tables for a terminal and for a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rich.table import Table as TerminalTable

from ..report.page import Cell, Part, Row, Table
from .command import table_of

PARTS: Final = ("local_step", "tangent", "assembly", "factor", "solve")


@dataclass(frozen=True)
class Sheet:
    """A table, wherever it is shown."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]  # the first cell says what the others are of

    def for_terminal(self) -> TerminalTable:
        """As a terminal shows it."""
        return table_of(self.title, self.headings, self.rows)

    def for_page(self) -> Part:
        """As a section of a page."""
        first, *others = (each[0].upper() + each[1:] for each in self.headings)
        rows = [Row(name, [Cell(value) for value in values]) for name, *values in self.rows]
        return Part(self.title, [Table(first, others, rows)])


def machine(result: Mapping[str, Any]) -> str:
    """What was measured on."""
    kind = "GPU" if str(result["settings"]["device"]).startswith("cuda") else "processor"
    return str(result["hardware"][kind])


def benchmark_sheets(result: Mapping[str, Any]) -> list[Sheet]:
    """Of what `benchmark.run_benchmark` has found."""
    sheets = [_steps(result), _parts(result["parts"])]
    if result["cold_start"] is not None:
        sheets.append(_cold_start(result["cold_start"]))
    if result["environments"]:
        sheets.append(_environments(result["environments"]))
    if result["control"]:
        sheets.append(_commands(result["control"]))
    return sheets


def _steps(result: Mapping[str, Any]) -> Sheet:
    yardstick = result["yardstick_ms"]
    title = f"Milliseconds a step of the whole batch, {machine(result)} (yardstick {yardstick:.2f} ms)"
    headings = ["solver", "nu", "unknowns", "batch", "forward", "backward", "forward / yardstick", "robots' steps/s"]
    rows = [
        [
            row["solver"],
            f"{row['poissons_ratio']:g}",
            str(row["unknowns"]),
            str(row["batch"]),
            f"{row['forward_ms']:.2f}",
            f"{row['backward_ms']:.2f}",
            f"{row['forward_ms'] / yardstick:.2f}",
            f"{1e3 * row['batch'] / row['forward_ms']:.0f}",
            f"{row['iterations']:.1f}",
            f"{row['factorisations']:.2f}",
        ]
        for row in result["steps"]
    ]
    return Sheet(title, [*headings, "iterations", "factorisations"], rows)


def _parts(found: Sequence[Mapping[str, Any]]) -> Sheet:
    headings = ["refinement", "batch", *(part.replace("_", " ") for part in PARTS)]
    rows = [
        [str(row["refinement"]), str(row["batch"]), *(f"{row[f'{part}_ms']:.3f}" for part in PARTS)] for row in found
    ]
    return Sheet("Milliseconds of the parts", headings, rows)


def _cold_start(found: Mapping[str, Mapping[str, float]]) -> Sheet:
    headings = ["kernel cache", *(name.removesuffix("_s").replace("_", " ") for name in found["cold"])]
    rows = [[kind, *(f"{seconds:.2f}" for seconds in times.values())] for kind, times in found.items()]
    return Sheet("Seconds of a new process", headings, rows)


def _environments(found: Sequence[Mapping[str, Any]]) -> Sheet:
    headings = ["world", "robots", "an action of all, ms", "actions a second", "steps a second"]
    rows = [
        [row["world"], str(row["robots"]), f"{row['ms']:.1f}", f"{row['actions_s']:.0f}", f"{row['steps_s']:.0f}"]
        for row in found
    ]
    return Sheet("Environments, task reach", headings, rows)


def _commands(found: Sequence[Mapping[str, Any]]) -> Sheet:
    headings = ["controller", "a command, ms", "the slowest of 20, ms", "commands a second"]
    rows = [
        [row["controller"], f"{row['ms']:.2f}", f"{row['largest_of_20_ms']:.2f}", f"{1e3 / row['ms']:.0f}"]
        for row in found
    ]
    return Sheet(f"Plans that begin anew at each step, over {found[0]['horizon_s']:g} s, one thread", headings, rows)
