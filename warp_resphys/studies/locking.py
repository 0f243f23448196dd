"""How far the tip of an arm moves at rest, by element and refinement: which meshes are too stiff, and what they cost.

Coarse and nearly incompressible meshes lock: they bend less than the arm that they stand for. The value without the
error of the mesh is extrapolated from hexahedra that are refined evenly, and borne out by another kind of element.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import GRAVITY, Simulator
from ..energies.fibres import Fibres
from ..energies.materials import make_material
from ..energies.pressure import Pressure
from ..experiment.schema import NATURAL, check
from ..fem.body import Body
from ..io.atomic import atomic_path, digest
from ..io.errors import InputError
from ..io.files import read_json, write_json
from ..io.progress import Progress
from ..mesh.arm import mesh_arm
from ..mesh.arm_geometry import arm_geometry
from ..mesh.chambers import find_chambers
from ..mesh.mesh import Mesh, quadratic
from ..mesh.readers import read_mesh
from ..report.figures import STYLE, TONES, new_figure, save_png
from ..stepping.inputs import Inputs
from .command import show, table_of, write_csv
from .elements import step_time

HEXAHEDRA, SERENDIPITY, BIQUADRATIC = "8-node hexahedra", "20-node hexahedra", "27-node hexahedra"
LINEAR, QUADRATIC = "4-node tetrahedra", "10-node tetrahedra"
LOADS: Final[Mapping[str, str]] = {
    "gravity": "gravity, base tilted",
    "fibres": "pressure, with fibres",
    "pressure": "pressure, without fibres",
}
# By key of the group ``study``: the element, the kind of mesh where it is quadratic, and how it is drawn.
_ELEMENTS: Final = {
    "hexahedra": (HEXAHEDRA, None, "sysid", "o"),
    "hexahedra_20": (SERENDIPITY, "hexahedron20", "reconstruction", "D"),
    "hexahedra_27": (BIQUADRATIC, "hexahedron27", "simfree", "P"),
    "linear_tetrahedra": (LINEAR, None, "simulation", "^"),
    "quadratic_tetrahedra": (QUADRATIC, "tetrahedron10", "resphys", "s"),
}
_NOT_MEASURED: Final = {*_ELEMENTS, "file", "units", "within"}  # what the result of one mesh does not depend on


@dataclass(frozen=True)
class Case:
    """A mesh of the study."""

    name: str  # of a file for its results
    element: str
    size: float | None = None  # of the elements in the section [m]; None for a file
    layers: float | None = None  # height of those of hexahedra [m]
    file: str | None = None  # that it is read from
    units: str = "m"  # of that file
    timed: bool = True  # whether steps are timed, and the deflection without fibres is computed

    def mesh(self, geometry: Mapping[str, Any]) -> Mesh:
        """The mesh, of an arm with these measures.

        Raises:
            MeshError: it cannot be made or read.
        """
        if self.file is not None:
            return read_mesh(self.file, self.units, 2 if self.element == QUADRATIC else 1, drop_unreferenced=True)
        mesh, _ = mesh_arm(arm_geometry(geometry), float(self.size or 0.0), self.element.split()[1], self.layers)
        kind = next(kind for element, kind, *_ in _ELEMENTS.values() if element == self.element)
        return quadratic(mesh, kind) if kind else mesh


def cases(study: Mapping[str, Any]) -> Iterator[Case]:
    """The meshes of a study, from the group ``study``."""
    if study["file"] is not None:
        for element, name in ((LINEAR, "linear"), (QUADRATIC, "quadratic")):
            yield Case(f"file_{name}", element, file=str(study["file"]), units=study["units"])
    for key, (element, *_) in _ELEMENTS.items():
        for *lengths, timed in study[key]:
            name = "_".join([key, *(f"{1e3 * length:g}" for length in lengths)])
            yield Case(name, element, **dict(zip(("size", "layers"), lengths, strict=False)), timed=timed)


def measure(mesh: Mesh, study: Mapping[str, Any], timed: bool = True) -> dict[str, Any]:
    """Deflections of an arm that hangs along -z from its highest vertices, and the time of a step.

    Returns:
        ``vertices``, ``chamber_cm3`` of the chamber under pressure, ``<load>_mm`` of each of `LOADS`: how far the tip
        moves towards +x, ``step_ms`` and ``iterations`` of a step; None for what was left out, as `Case.timed` says.

    Raises:
        ResphysError: the mesh has no such chamber, or an equilibrium was not found.
    """
    for key in ("chamber", "steps", "repeats"):
        check(f"study.{key}", study[key], NATURAL)
    chambers = find_chambers(mesh)
    number = study["chamber"]
    if number > len(chambers):
        raise InputError(f"study.chamber is {number}, but the mesh has {len(chambers)} closed chambers.")
    heights = mesh.vertices[:, 2]
    tolerance = 1e-6 * float(np.ptp(heights))
    fixed = np.flatnonzero(heights > heights.max() - tolerance)
    tip = torch.as_tensor(np.flatnonzero(heights < heights.min() + tolerance))
    driven = Pressure(chambers)
    bare = Body(mesh, fixed=fixed, energies=[driven])
    wound = Body(mesh, fixed=fixed, energies=[driven, Fibres(chambers, **study["fibres"])])
    material = make_material(**study["material"])
    pressure = torch.zeros(1, len(chambers), dtype=torch.float64)
    pressure[0, number - 1] = study["pressure"]
    tilt, weight = radians(study["tilt"]), abs(GRAVITY[2])
    solver = SolverSettings(relative_tolerance=study["relative_tolerance"])
    hanging = Simulator(bare, material, time_step=study["time_step"], solver=solver)
    tilted = Simulator(bare, material, gravity=(weight * sin(tilt), 0.0, -weight * cos(tilt)), solver=solver)
    reinforced = Simulator(wound, material, solver=solver)

    def deflection(simulator: Simulator, load: torch.Tensor | None) -> float:
        moved = simulator.static_equilibrium(Inputs(pressure=load)).q - simulator.rest_positions
        return 1e3 * float(moved[0, tip, 0].mean())

    volumes = hanging.held_energy("pressure", 1).conjugates(hanging.rest_positions[None])
    result: dict[str, Any] = {
        "vertices": len(mesh.vertices),
        "chamber_cm3": 1e6 * float(volumes[0, number - 1]),
        "gravity_mm": deflection(tilted, None),
        "fibres_mm": deflection(reinforced, pressure),
        "pressure_mm": deflection(hanging, pressure) if timed else None,
        "step_ms": None,
        "iterations": None,
    }
    if timed:
        ramp = 0.5 - 0.5 * np.cos(2.0 * pi * np.arange(1, study["steps"] + 1) / study["steps"])  # swells and ebbs once
        inputs = [Inputs(pressure=float(share) * pressure) for share in ramp]
        result |= step_time(hanging, hanging.static_equilibrium().detach(), inputs, study["repeats"])
    return result


def converged(rows: Sequence[Mapping[str, Any]], load: str) -> dict[str, float] | None:
    """The deflection that refinement leads to, and how well two kinds of element agree on it.

    The error of hexahedra falls with the square of the size. Two meshes whose sizes in the section and along the arm
    have one ratio r therefore lead to d + (d - d') / (r^2 - 1), d being the deflection of the finer one (Richardson
    1911).

    Args:
        rows: results of `measure`, with the ``element``, ``size`` and ``layers`` of their `Case`.
        load: one of `LOADS`.

    Returns:
        ``mm``, the extrapolated deflection; ``finest_mm`` of the finest hexahedra that it rests on, ``other_mm`` of the
        finest 10-node tetrahedra (NaN without any). None where no two hexahedral meshes have one ratio.
    """
    key = f"{load}_mm"
    known = [row for row in rows if row["size"] and row[key] is not None]
    hexahedra = [row for row in known if row["element"] == HEXAHEDRA]
    pairs = [
        (coarse, fine)
        for fine in hexahedra
        for coarse in hexahedra
        if coarse["size"] > 1.2 * fine["size"]
        and abs(coarse["layers"] * fine["size"] / (fine["layers"] * coarse["size"]) - 1.0) < 0.01
    ]
    if not pairs:
        return None
    coarse, fine = max(pairs, key=lambda pair: (pair[1]["vertices"], pair[0]["vertices"]))
    ratio = coarse["size"] / fine["size"]
    others = [row for row in known if row["element"] == QUADRATIC]
    other = max(others, key=lambda row: row["vertices"])[key] if others else float("nan")
    value = fine[key] + (fine[key] - coarse[key]) / (ratio**2 - 1.0)
    return {"mm": value, "finest_mm": fine[key], "other_mm": other}


def cheapest(rows: Sequence[Mapping[str, Any]], within: float) -> Mapping[str, Any] | None:
    """The mesh with the fastest step among those whose deviations under gravity and with fibres are small enough."""
    good = [
        row
        for row in rows
        if row["step_ms"] is not None
        and row["size"]
        and all(abs(row.get(f"{load}_deviation", float("inf"))) <= within for load in ("gravity", "fibres"))
    ]
    return min(good, key=lambda row: row["step_ms"], default=None)


def locking_study(config: Mapping[str, Any], folder: Path) -> None:
    """Writes study.json, study.csv and study.png into the run folder and prints the table; see `run_study`."""
    show(*run_study(config, folder), f"Written: {folder}/study.json, study.csv, study.png")


def run_study(config: Mapping[str, Any], folder: Path) -> list[Table | str]:
    """Measures every mesh that has no result yet, writes the files, and returns the table and what follows from it.

    The result of each mesh is kept in the folder ``meshes``.

    Raises:
        ResphysError: see `measure`.
    """
    study, within = config["study"], config["study"]["within"]
    rows = _measured(config, folder)
    limits = {load: converged(rows, load) for load in LOADS}
    for row in rows:
        for load, limit in limits.items():
            if limit is not None and row[f"{load}_mm"] is not None:
                row[f"{load}_deviation"] = row[f"{load}_mm"] / limit["mm"] - 1.0
    best = cheapest(rows, within)
    name = None if best is None else best["name"]
    write_json(folder / "study.json", {"rows": rows, "converged": limits, "cheapest": name, "study": study})
    write_csv(folder / "study.csv", rows)
    with rc_context(STYLE), atomic_path(folder / "study.png") as partial:
        save_png(deflections(rows, limits, within), partial)
    return [study_table(rows), conclusion(limits, best, within)]


def _measured(config: Mapping[str, Any], folder: Path) -> list[dict[str, Any]]:
    """A row for each mesh: what an earlier study with the same settings has measured, or what is measured now."""
    study, rows = config["study"], []
    geometry = {key: value for key, value in config["mesh"].items() if key not in ("size", "layers", "cells", "order")}
    loads = {key: value for key, value in study.items() if key not in _NOT_MEASURED}
    chosen = list(cases(study))
    with Progress("locking study", total=len(chosen), unit="meshes") as progress:
        for case in chosen:
            place = folder / "meshes" / f"{case.name}.json"
            content = None if case.file is None else digest(case.file)
            settings = {"case": asdict(case), "content": content, "mesh": geometry, "study": loads}
            kept = read_json(place) if place.exists() else {}
            if kept.get("settings") != settings:
                row = {**asdict(case), **measure(case.mesh(config["mesh"]), study, case.timed)}
                kept = {"settings": settings, "row": row}
                write_json(place, kept)
            rows.append(kept["row"])
            progress.advance(mesh=case.name, tip=kept["row"]["fibres_mm"])
    return rows


def deflections(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any], within: float) -> Figure:
    """Deflection of the tip against the number of vertices, a panel for each load and a line for each element."""
    figure = new_figure(3.2, 3.2, narrow=False)
    for axes, (load, title) in zip(figure.subplots(1, len(LOADS)), LOADS.items(), strict=True):
        axes.set(title=title, xscale="log", xlabel="vertices")
        limit = limits[load]
        value = 0.0 if limit is None else limit["mm"]
        sign = -1.0 if value < 0.0 else 1.0
        if limit is not None:
            axes.axhline(sign * value, color=TONES["muted"].light, linewidth=1.0, label=f"converged, ±{within:.0%}")
            ends = (sign * value * (1.0 - within), sign * value * (1.0 + within))
            axes.axhspan(*ends, color=TONES["rule"].light, zorder=0)
        for element, _, tone, mark in _ELEMENTS.values():
            known = [row for row in rows if row["element"] == element and row[f"{load}_mm"] is not None]
            for own, label in ((True, element), (False, f"{element}, your file")):
                points = sorted((r["vertices"], sign * r[f"{load}_mm"]) for r in known if (r["file"] is None) == own)
                if points:
                    face = TONES[tone].light if own else "white"
                    style = {"color": TONES[tone].light, "markerfacecolor": face, "markersize": 5, "label": label}
                    axes.plot(*zip(*points, strict=True), mark, **style)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    figure.axes[0].set_ylabel("deflection of the tip [mm]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def study_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Every mesh, with its deflections [mm] and, in per cent, how far they are from converged."""
    lines = []
    for row in sorted(rows, key=lambda row: (row["element"], row["file"] is not None, row["vertices"])):
        sizes = ", ".join(f"{1e3 * row[key]:.3g}" for key in ("size", "layers") if row[key])
        cells = []
        for load in LOADS:
            value, deviation = row[f"{load}_mm"], row.get(f"{load}_deviation")
            percent = "" if deviation is None else f" ({100.0 * deviation:+.1f} %)"
            cells.append("-" if value is None else f"{value:.2f}{percent}")
        duration = "-" if row["step_ms"] is None else f"{row['step_ms']:.1f}"
        where = Path(row["file"]).name if row["file"] else sizes
        lines.append([row["element"], where, str(row["vertices"]), f"{row['chamber_cm3']:.2f}", *cells, duration])
    headings = ["element", "size, layers (mm)", "vertices", "chamber (cm3)", *LOADS.values(), "step (ms)"]
    return table_of("Deflection of the tip in mm, and its deviation from the converged value", headings, lines)


def conclusion(limits: Mapping[str, Any], best: Mapping[str, Any] | None, within: float) -> str:
    """The converged values, and the mesh to take."""
    known = [
        f"{LOADS[load]} {limit['mm']:.2f} mm (finest hexahedra {limit['finest_mm']:.2f}, finest 10-node tetrahedra "
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
