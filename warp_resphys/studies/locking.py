"""Static deflection of an arm and time of a step, by element and refinement: shows which meshes lock.

Coarse meshes of nearly incompressible material lock: they bend less than the arm. The converged deflection is
extrapolated from evenly refined hexahedra and compared with that of 10-node tetrahedra.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from pydantic import Strict

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import GRAVITY, Simulator
from ..energies.fibres import Fibres
from ..energies.pressure import Pressure
from ..experiment.build import build_material, build_mesh
from ..fem.body import Body
from ..io.atomic import atomic_path, digest
from ..io.errors import InputError
from ..io.files import read_json, write_json
from ..io.progress import Progress
from ..io.settings import Many, Natural, Positive, Settings, Share, Word, setting
from ..mesh.chambers import find_chambers
from ..mesh.mesh import Mesh, quadratic
from ..mesh.readers import read_mesh
from ..report.figures import STYLE, TONES, new_figure, save_png
from ..settings.body import FibreSettings, MaterialSettings
from ..settings.mesh import GeneratedArm
from ..stepping.inputs import Inputs
from .beam import ELEMENT_NAMES, Element
from .tables import Sheet, show, write_csv
from .timing import step_time

LOADS: Final[Mapping[str, str]] = {
    "gravity": "gravity, base tilted",
    "fibres": "pressure, with fibres",
    "pressure": "pressure, without fibres",
}
_STYLES: Final[Mapping[Element, tuple[str, str]]] = {  # tone and mark
    "hexahedron8": ("sysid", "o"),
    "hexahedron20": ("reconstruction", "D"),
    "hexahedron27": ("simfree", "P"),
    "tetrahedron4": ("simulation", "^"),
    "tetrahedron10": ("resphys", "s"),
}
Hexahedra = Annotated[tuple[Positive, Positive, bool], Strict(False)]  # size and height of a layer [m], whether timed
Tetrahedra = Annotated[tuple[Positive, bool], Strict(False)]  # size [m], whether timed


class LockingStudy(Settings):
    """The group ``study``; ``conf/benchmark_locking.yaml`` explains its keys."""

    meshes: dict[Element, Many[Hexahedra] | Many[Tetrahedra]]
    file: Word | None
    units: Word
    chamber: Natural
    pressure: float = setting(unit="Pa")
    tilt: float = setting(unit="degrees")
    material: MaterialSettings
    fibres: FibreSettings
    relative_tolerance: Positive
    time_step: Positive = setting(unit="s")
    steps: Natural
    repeats: Natural
    within: Share


class LockingRun(Settings):
    """The configuration ``benchmark_locking``: the measures of an arm, and the study."""

    mesh: GeneratedArm
    study: LockingStudy


@dataclass(frozen=True)
class LockingCase:
    """A mesh of the study."""

    element: Element
    size: float | None = None  # of the elements in the cross-section [m]; None for a file
    layers: float | None = None  # height of the layers of hexahedra [m]
    file: str | None = None  # mesh file
    units: str = "m"  # of that file
    timed: bool = True  # whether steps are timed and the deflection without fibres is computed

    @property
    def name(self) -> str:
        """Name of the file with its results, without extension."""
        lengths = [f"{1e3 * length:g}" for length in (self.size, self.layers) if length is not None]
        return "_".join([self.element, *(lengths or ["file"])])

    def mesh(self, arm: GeneratedArm) -> Mesh:
        """The mesh, of an arm with the given measures unless it is read from a file.

        Raises:
            MeshError: the mesh cannot be made or read.
        """
        linear = self.element in ("hexahedron8", "tetrahedron4")
        if self.file is not None:
            return read_mesh(self.file, self.units, 1 if linear else 2, drop_unreferenced=True)
        cells = "hexahedra" if self.element.startswith("hexahedron") else "tetrahedra"
        mesh = build_mesh(arm.changed(size=self.size, layers=self.layers, cells=cells, order=1))
        return mesh if linear else quadratic(mesh, self.element)


def cases(study: LockingStudy) -> list[LockingCase]:
    """The meshes of a study: those of a file, then generated ones."""
    elements: tuple[Element, ...] = () if study.file is None else ("tetrahedron4", "tetrahedron10")
    return [
        *(LockingCase(element, file=study.file, units=study.units) for element in elements),
        *(
            LockingCase(element, size, layers[0] if layers else None, timed=timed)
            for element, meshes in study.meshes.items()
            for size, *layers, timed in meshes
        ),
    ]


def measure(mesh: Mesh, study: LockingStudy, timed: bool = True) -> dict[str, Any]:
    """Static deflections of an arm that hangs along -z from its highest vertices, and the time of a step.

    Returns:
        ``vertices``, ``chamber_cm3`` of the chamber under pressure, ``<load>_mm`` for each of `LOADS`: displacement of
        the tip towards +x; ``step_ms`` and ``iterations`` of a step. Values that are not computed unless ``timed`` are
        None.

    Raises:
        ResphysError: the mesh has no such chamber, or no equilibrium was found.
    """
    chambers = find_chambers(mesh)
    number = study.chamber
    if number > len(chambers):
        raise InputError(f"study.chamber is {number}, but the mesh has {len(chambers)} closed chambers.")
    heights = mesh.vertices[:, 2]
    tolerance = 1e-6 * float(np.ptp(heights))
    fixed = np.flatnonzero(heights > heights.max() - tolerance)
    tip = torch.as_tensor(np.flatnonzero(heights < heights.min() + tolerance))
    driven = Pressure(chambers)
    bare = Body(mesh, fixed=fixed, energies=[driven])
    wound = Body(mesh, fixed=fixed, energies=[driven, Fibres(chambers, **study.fibres.plain())])
    material = build_material(study.material, "study.material")
    pressure = torch.zeros(1, len(chambers), dtype=torch.float64)
    pressure[0, number - 1] = study.pressure
    tilt, weight = radians(study.tilt), abs(GRAVITY[2])
    solver = SolverSettings(relative_tolerance=study.relative_tolerance)
    hanging = Simulator(bare, material, time_step=study.time_step, solver=solver)
    tilted = Simulator(bare, material, gravity=(weight * sin(tilt), 0.0, -weight * cos(tilt)), solver=solver)
    reinforced = Simulator(wound, material, solver=solver)

    def deflection(simulator: Simulator, load: torch.Tensor | None) -> float:
        moved = simulator.static_equilibrium(Inputs(pressure=load)).q - simulator.rest_positions
        return 1e3 * float(moved[0, tip, 0].mean())

    volumes = hanging.explicit_energy("pressure", 1).conjugates(hanging.rest_positions[None])
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
        ramp = 0.5 - 0.5 * np.cos(2.0 * pi * np.arange(1, study.steps + 1) / study.steps)  # rises and falls once
        inputs = [Inputs(pressure=float(share) * pressure) for share in ramp]
        result |= step_time(hanging, hanging.static_equilibrium().detach(), inputs, study.repeats)
    return result


def converged(rows: Sequence[Mapping[str, Any]], load: str) -> dict[str, float] | None:
    """Extrapolates the converged deflection from hexahedra, and gives that of the finest tetrahedra beside it.

    The error of hexahedra falls with the square of their size. Let d' and d be the deflections of two meshes, the
    second finer by the same ratio r in the cross-section and along the arm. Their extrapolation is
    d + (d - d') / (r^2 - 1) (Richardson 1911).

    Args:
        rows: results of `measure`, with the ``element``, ``size`` and ``layers`` of their `LockingCase`.
        load: one of `LOADS`.

    Returns:
        ``mm``, the extrapolated deflection; ``finest_mm`` of the finest hexahedra used; ``other_mm`` of the finest
        10-node tetrahedra (NaN without any). None where no two hexahedral meshes are refined evenly.
    """
    key = f"{load}_mm"
    measured = [row for row in rows if row["size"] and row[key] is not None]
    hexahedra = [row for row in measured if row["element"] == "hexahedron8"]
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
    others = [row for row in measured if row["element"] == "tetrahedron10"]
    other = max(others, key=lambda row: row["vertices"])[key] if others else float("nan")
    value = fine[key] + (fine[key] - coarse[key]) / (ratio**2 - 1.0)
    return {"mm": value, "finest_mm": fine[key], "other_mm": other}


def cheapest(rows: Sequence[Mapping[str, Any]], within: float) -> Mapping[str, Any] | None:
    """The mesh with the fastest step whose deviations under gravity and with fibres are at most ``within``."""
    accurate = [
        row
        for row in rows
        if row["step_ms"] is not None
        and row["size"]
        and all(abs(row.get(f"{load}_deviation", float("inf"))) <= within for load in ("gravity", "fibres"))
    ]
    return min(accurate, key=lambda row: row["step_ms"], default=None)


def locking_study(settings: LockingRun, folder: Path) -> None:
    """Writes study.json, study.csv and study.png into the run folder, and prints the table and the conclusion.

    The result of each mesh is kept in the folder ``meshes``, from which an interrupted study continues.

    Raises:
        ResphysError: a mesh cannot be made, or no equilibrium was found.
    """
    study = settings.study
    rows = _measured(settings, folder)
    limits = {load: converged(rows, load) for load in LOADS}
    for row in rows:
        for load, limit in limits.items():
            if limit is not None and row[f"{load}_mm"] is not None:
                row[f"{load}_deviation"] = row[f"{load}_mm"] / limit["mm"] - 1.0
    best = cheapest(rows, study.within)
    name = None if best is None else best["name"]
    write_json(folder / "study.json", {"rows": rows, "converged": limits, "cheapest": name, "study": study.plain()})
    write_csv(folder / "study.csv", rows)
    with rc_context(STYLE), atomic_path(folder / "study.png") as partial:
        save_png(deflections(rows, limits, study.within), partial)
    conclusion = _conclusion(limits, best, study.within)
    show(_table(rows), conclusion, f"Written: {folder}/study.json, study.csv, study.png")


def _measured(settings: LockingRun, folder: Path) -> list[dict[str, Any]]:
    """A row for each mesh, from an earlier study with the same settings or measured now."""
    rows, study = [], settings.study
    geometry = settings.mesh.model_dump(mode="json", exclude={"size", "layers", "cells", "order"})
    # A result does not depend on the other meshes, nor on the accuracy that is asked for.
    loads = study.model_dump(mode="json", exclude={"meshes", "file", "units", "within"})
    chosen = cases(study)
    with Progress("locking study", total=len(chosen), unit="meshes") as progress:
        for case in chosen:
            path = folder / "meshes" / f"{case.name}.json"
            content = None if case.file is None else digest(case.file)
            used = {"case": asdict(case), "content": content, "mesh": geometry, "study": loads}
            kept = read_json(path) if path.exists() else {}
            if kept.get("settings") != used:
                row = {"name": case.name, **asdict(case), **measure(case.mesh(settings.mesh), study, case.timed)}
                kept = {"settings": used, "row": row}
                write_json(path, kept)
            rows.append(kept["row"])
            progress.advance(mesh=case.name, tip=kept["row"]["fibres_mm"])
    return rows


def deflections(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any], within: float) -> Figure:
    """Draws deflection of the tip over number of vertices, with a panel for each load and a line for each element."""
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
        for element, (tone, mark) in _STYLES.items():
            measured = [row for row in rows if row["element"] == element and row[f"{load}_mm"] is not None]
            for own, label in ((True, ELEMENT_NAMES[element]), (False, f"{ELEMENT_NAMES[element]}, your file")):
                points = sorted((r["vertices"], sign * r[f"{load}_mm"]) for r in measured if (r["file"] is None) == own)
                if points:
                    face = TONES[tone].light if own else "white"
                    style = {"color": TONES[tone].light, "markerfacecolor": face, "markersize": 5, "label": label}
                    axes.plot(*zip(*points, strict=True), mark, **style)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    figure.axes[0].set_ylabel("deflection of the tip [mm]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


def _table(rows: Sequence[Mapping[str, Any]]) -> Sheet:
    """A row for each mesh, with its deflections [mm] and their deviations from the converged ones [%]."""
    lines = []
    for row in sorted(rows, key=lambda row: (ELEMENT_NAMES[row["element"]], row["file"] is not None, row["vertices"])):
        cells = []
        for load in LOADS:
            value, deviation = row[f"{load}_mm"], row.get(f"{load}_deviation")
            percent = "" if deviation is None else f" ({100.0 * deviation:+.1f} %)"
            cells.append("-" if value is None else f"{value:.2f}{percent}")
        sizes = ", ".join(f"{1e3 * row[key]:.3g}" for key in ("size", "layers") if row[key])
        duration = "-" if row["step_ms"] is None else f"{row['step_ms']:.1f}"
        first = [ELEMENT_NAMES[row["element"]], Path(row["file"]).name if row["file"] else sizes, str(row["vertices"])]
        lines.append([*first, f"{row['chamber_cm3']:.2f}", *cells, duration])
    headings = ["element", "size, layers (mm)", "vertices", "chamber (cm3)", *LOADS.values(), "step (ms)"]
    return Sheet("Deflection of the tip in mm, and its deviation from the converged value", headings, lines)


def _conclusion(limits: Mapping[str, Any], best: Mapping[str, Any] | None, within: float) -> str:
    """Sentences on the converged deflections and the cheapest mesh that is accurate enough."""
    values = [
        f"{LOADS[load]} {limit['mm']:.2f} mm (finest hexahedra {limit['finest_mm']:.2f}, finest 10-node tetrahedra "
        f"{limit['other_mm']:.2f})"
        for load, limit in limits.items()
        if limit is not None
    ]
    if not values:
        return "No two hexahedral meshes are refined evenly, so nothing was extrapolated."
    text = f"Converged, extrapolated from hexahedra: {'; '.join(values)}."
    if best is None:
        return f"{text} No mesh whose steps were timed is within {within:.0%} under gravity and with fibres."
    return (
        f"{text} Cheapest mesh within {within:.0%} under gravity and with fibres: {best['name']}, {best['vertices']} "
        f"vertices, {best['step_ms']:.1f} ms a step."
    )
