"""The study of locking: its meshes in turn, a table and a figure."""

import csv
import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from matplotlib import rc_context
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from ..io.files import atomic_path, digest, read_json, write_json, write_text
from ..io.progress import Progress
from ..report.figures import STYLE, TONES, new_figure, save_png
from .command import settings_of
from .locking import (
    BIQUADRATIC,
    HEXAHEDRA,
    LINEAR,
    LOADS,
    QUADRATIC,
    SERENDIPITY,
    Case,
    cases,
    cheapest,
    converged,
    measure,
)

TITLES: Final[Mapping[str, str]] = MappingProxyType(
    {"gravity": "gravity, base tilted", "fibres": "pressure, with fibres", "pressure": "pressure, without fibres"}
)
_MARKS: Final = MappingProxyType(
    {
        LINEAR: ("simulation", "^"),
        QUADRATIC: ("resphys", "s"),
        HEXAHEDRA: ("sysid", "o"),
        SERENDIPITY: ("reconstruction", "D"),
        BIQUADRATIC: ("simfree", "P"),
    }
)
_MEASURED: Final = (
    *("hexahedra", "hexahedra_20", "hexahedra_27", "linear_tetrahedra", "quadratic_tetrahedra"),
    *("file", "units", "within"),
)


def locking_study(config: DictConfig) -> None:
    """Writes study.json, study.csv and study.png into the run folder and prints the table; see `run_study`."""
    plain, folder = settings_of(config)
    console = Console(width=None if sys.stdout.isatty() else 140)
    for part in run_study(plain, folder):
        console.print(part)
    console.print(f"Written: {folder}/study.json, study.csv, study.png")


def run_study(config: Mapping[str, Any], folder: Path) -> list[Table | str]:
    """Measures every mesh that has no result yet, and writes study.json, study.csv and study.png.

    Args:
        config: with the keys of ``conf/locking_study.yaml``.
        folder: where they go; the result of each mesh is kept in its folder ``meshes``.

    Returns:
        The table, and what follows from it in one sentence.

    Raises:
        ResphysError: see `locking.measure`.
    """
    study, chosen = config["study"], list(cases(config["study"]))
    kept = {case.name: _kept(case, config, folder) for case in chosen}
    done = sum(row is not None for row in kept.values())
    with Progress("locking study", total=len(chosen), unit="meshes", start_at=done) as progress:
        for case in chosen:
            if kept[case.name] is not None:
                continue
            row = {**asdict(case), **measure(case.mesh(config["mesh"]), study, case.timed)}
            write_json(_place(case, folder), {"settings": _settings(case, config), "row": row})
            kept[case.name] = row
            progress.advance(mesh=case.name, tip=row["fibres_mm"])
    rows = [row for row in kept.values() if row is not None]
    limits = {load: converged(rows, load) for load in LOADS}
    for row in rows:
        for load, limit in limits.items():
            if limit is not None and row[f"{load}_mm"] is not None:
                row[f"{load}_deviation"] = row[f"{load}_mm"] / limit["mm"] - 1.0
    best = cheapest(rows, study["within"])
    name = None if best is None else best["name"]
    write_json(folder / "study.json", {"rows": rows, "converged": limits, "cheapest": name, "study": study})
    write_text(folder / "study.csv", _csv(rows))
    with rc_context(STYLE), atomic_path(folder / "study.png") as partial:
        save_png(deflections(rows, limits, study["within"]), partial)
    return [study_table(rows), conclusion(limits, best, study["within"])]


def deflections(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any], within: float) -> Figure:
    """Deflection of the tip against the number of vertices, a panel for each load and a line for each element."""
    figure = new_figure(3.2, 3.2, narrow=False)
    for axes, load in zip(figure.subplots(1, len(LOADS)), LOADS, strict=True):
        axes.set_title(TITLES[load])
        axes.set_xscale("log")
        limit = limits[load]
        value = 0.0 if limit is None else limit["mm"]
        sign = -1.0 if value < 0.0 else 1.0
        if limit is not None:
            axes.axhline(sign * value, color=TONES["muted"].light, linewidth=1.0, label=f"converged, ±{within:.0%}")
            ends = (sign * value * (1.0 - within), sign * value * (1.0 + within))
            axes.axhspan(*ends, color=TONES["rule"].light, zorder=0)
        for element, (tone, mark) in _MARKS.items():
            known = [row for row in rows if row["element"] == element and row[f"{load}_mm"] is not None]
            for own, label in ((True, element), (False, f"{element}, your file")):
                points = sorted((r["vertices"], sign * r[f"{load}_mm"]) for r in known if (r["file"] is None) == own)
                if points:
                    face = TONES[tone].light if own else "white"
                    style = {"color": TONES[tone].light, "markerfacecolor": face, "markersize": 5, "label": label}
                    axes.plot(*zip(*points, strict=True), mark, **style)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.set_xlabel("vertices")
    figure.axes[0].set_ylabel("deflection of the tip [mm]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3)
    return figure


def study_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Every mesh, with its deflections [mm] and, in per cent, how far they are from converged."""
    table = Table(title="Deflection of the tip in mm, and its deviation from the converged value")
    headings = ("element", "size, layers (mm)", "vertices", "chamber (cm3)", *TITLES.values(), "step (ms)")
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "element" else "right")
    for row in sorted(rows, key=lambda row: (row["element"], row["file"] is not None, row["vertices"])):
        sizes = [f"{1e3 * row[key]:.3g}" for key in ("size", "layers") if row[key]]
        cells = []
        for load in LOADS:
            value, deviation = row[f"{load}_mm"], row.get(f"{load}_deviation")
            percent = "" if deviation is None else f" ({100.0 * deviation:+.1f} %)"
            cells.append("-" if value is None else f"{value:.2f}{percent}")
        duration = "-" if row["step_ms"] is None else f"{row['step_ms']:.1f}"
        where = Path(row["file"]).name if row["file"] else ", ".join(sizes)
        table.add_row(row["element"], where, str(row["vertices"]), f"{row['chamber_cm3']:.2f}", *cells, duration)
    return table


def conclusion(limits: Mapping[str, Any], best: Mapping[str, Any] | None, within: float) -> str:
    """The converged values, and the mesh to take."""
    known = [
        f"{TITLES[load]} {limit['mm']:.2f} mm (finest hexahedra {limit['finest_mm']:.2f}, finest 10-node tetrahedra "
        f"{limit['other_mm']:.2f})"
        for load, limit in limits.items()
        if limit is not None
    ]
    if not known:
        return "No two hexahedral meshes have one ratio of sizes, so nothing was extrapolated."
    text = f"Converged, extrapolated from hexahedra: {'; '.join(known)}."
    if best is None:
        return f"{text} No mesh whose steps were timed is within {within:.0%} under gravity and with fibres."
    return (
        f"{text} Cheapest mesh within {within:.0%} under gravity and with fibres: {best['name']}, {best['vertices']} "
        f"vertices, {best['step_ms']:.1f} ms a step."
    )


def _place(case: Case, folder: Path) -> Path:
    return folder / "meshes" / f"{case.name}.json"


def _settings(case: Case, config: Mapping[str, Any]) -> dict[str, Any]:
    """What the result of a mesh depends on."""
    measures = {key: value for key, value in config["mesh"].items() if key not in ("size", "layers", "cells", "order")}
    loads = {key: value for key, value in config["study"].items() if key not in _MEASURED}
    content = None if case.file is None else digest(case.file)
    return {"case": asdict(case), "content": content, "mesh": measures, "study": loads}


def _kept(case: Case, config: Mapping[str, Any], folder: Path) -> dict[str, Any] | None:
    """The result of an earlier study with the same settings."""
    place = _place(case, folder)
    if not place.exists():
        return None
    kept = read_json(place)
    row: dict[str, Any] = kept["row"]
    return row if kept["settings"] == _settings(case, config) else None


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    keys = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
