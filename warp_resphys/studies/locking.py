"""How far the tip of an arm moves at rest, by element and refinement: which meshes are too stiff, and what they cost.

Coarse and nearly incompressible meshes lock: they bend less than the arm that they stand for. The value without the
error of the mesh is extrapolated from hexahedra that are refined evenly, and borne out by another kind of element.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, radians, sin
from typing import Any

import numpy as np
import torch

from ..dynamics.inputs import Inputs
from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import GRAVITY, Simulator
from ..energies.fibres import Fibres
from ..energies.materials import make_material
from ..energies.pressure import Pressure
from ..experiment.schema import NATURAL, check
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.arm import mesh_arm
from ..mesh.arm_geometry import arm_geometry
from ..mesh.chambers import find_chambers
from ..mesh.mesh import Mesh, quadratic
from ..mesh.readers import read_mesh
from .stepping import step_time

HEXAHEDRA, LINEAR, QUADRATIC = "8-node hexahedra", "4-node tetrahedra", "10-node tetrahedra"
SERENDIPITY, BIQUADRATIC = "20-node hexahedra", "27-node hexahedra"
LOADS = ("gravity", "fibres", "pressure")
_QUADRATIC = {QUADRATIC: "tetrahedron10", SERENDIPITY: "hexahedron20", BIQUADRATIC: "hexahedron27"}
_SWEPT = {"hexahedra": HEXAHEDRA, "hexahedra_20": SERENDIPITY, "hexahedra_27": BIQUADRATIC}


@dataclass(frozen=True)
class Case:
    """A mesh of the study.

    Attributes:
        name: of a file for its results.
        element: its kind.
        size: of the elements in the section [m]; None for a file.
        layers: of hexahedra [m].
        file: that it is read from.
        units: of that file.
        timed: whether steps are timed, and the deflection without fibres is computed.
    """

    name: str
    element: str
    size: float | None = None
    layers: float | None = None
    file: str | None = None
    units: str = "m"
    timed: bool = True

    def mesh(self, geometry: Mapping[str, Any]) -> Mesh:
        """The mesh, of an arm with these measures.

        Raises:
            MeshError: it cannot be made or read.
        """
        if self.file is not None:
            return read_mesh(self.file, self.units, 2 if self.element == QUADRATIC else 1, drop_unreferenced=True)
        cells = "hexahedra" if self.element in _SWEPT.values() else "tetrahedra"
        mesh, _ = mesh_arm(arm_geometry(geometry), float(self.size or 0.0), cells, self.layers)
        return quadratic(mesh, _QUADRATIC[self.element]) if self.element in _QUADRATIC else mesh


def cases(study: Mapping[str, Any]) -> Iterator[Case]:
    """The meshes of a study, from the group ``study``."""
    for element, name in ((LINEAR, "linear"), (QUADRATIC, "quadratic")):
        if study["file"] is not None:
            yield Case(f"file_{name}", element, file=str(study["file"]), units=study["units"])
    for key, element in _SWEPT.items():
        for size, layers, timed in study[key]:
            yield Case(f"{key}_{1e3 * size:g}_{1e3 * layers:g}", element, size, layers, timed=timed)
    for key, element in (("linear_tetrahedra", LINEAR), ("quadratic_tetrahedra", QUADRATIC)):
        for size, timed in study[key]:
            yield Case(f"{key}_{1e3 * size:g}", element, size, timed=timed)


def measure(mesh: Mesh, study: Mapping[str, Any], timed: bool = True) -> dict[str, Any]:
    """Deflections of an arm, and the time of a step.

    Args:
        mesh: hangs along -z from its highest vertices, with chambers.
        study: the group ``study``.
        timed: as in `Case`.

    Returns:
        ``vertices``, ``chamber_cm3`` of the chamber under pressure, ``<load>_mm`` of each of `LOADS`: how far the tip
        moves towards +x, ``step_ms`` and ``iterations`` of a step; None for what was left out.

    Raises:
        InputError: the mesh has no such chamber.
        ConvergenceError: an equilibrium was not found.
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
    }
    return {**result, **(_swell(hanging, pressure, study) if timed else {"step_ms": None, "iterations": None})}


def _swell(simulator: Simulator, pressure: torch.Tensor, study: Mapping[str, Any]) -> dict[str, float]:
    """What a step costs while the pressure (1, C) swells and ebbs once."""
    steps = study["steps"]
    ramp = 0.5 - 0.5 * np.cos(2.0 * pi * np.arange(1, steps + 1) / steps)
    inputs = [Inputs(pressure=float(share) * pressure) for share in ramp]
    with torch.no_grad():
        start = simulator.static_equilibrium()
    return step_time(simulator, start, inputs, study["repeats"])


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
