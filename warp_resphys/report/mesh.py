"""What there is to know about a mesh before it is simulated: a table, and a picture that shows its chambers."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ..io.errors import InputError, MeshError
from ..io.files import atomic_path
from ..mesh.arm import mesh_arm, name_surfaces
from ..mesh.arm_geometry import arm_geometry
from ..mesh.cavities import MOST_TRIANGLES, open_cavities
from ..mesh.chambers import Chamber, find_chambers
from ..mesh.elements import ELEMENTS
from ..mesh.mesh import (
    IntArray,
    Mesh,
    boundary_triangles,
    connected_parts,
    face_triangles,
    quadratic,
    select_vertices,
)
from ..mesh.quality import cell_volumes, scaled_jacobian
from ..mesh.readers import read_mesh, read_surfaces, read_vertices, write_mesh
from . import render
from .figures import CHAMBER_COLOURS, STYLE

FloatArray = NDArray[np.float64]

COMMAND: Final = (sys.executable, "-P", "-m", "warp_resphys.report.render_cut")
_TOWARDS_VIEWER: Final = (0.32, -1.0, 0.28)
_LONGER_SIDE: Final = 1400  # of a view [px]
_DPI: Final = 200
_ON_PLANE: Final = 1e-9  # [m], as in `mesh.select_vertices`
_NARROWEST: Final = 0.3  # width of a view over its height
_ENTRY: Final = 1.9  # Width of an entry of the legend [inch]
_LINE: Final = 0.24  # Height of a line of text [inch]
_MILLI: Final = 1e3
_CUBIC_CENTI: Final = 1e6


@dataclass(frozen=True, eq=False)
class MeshSummary:
    """What there is to know about a mesh.

    Attributes:
        mesh: The mesh.
        density: Of its material [kg/m^3].
        fixed: (P,) vertices that are clamped.
        chambers: Its closed chambers.
    """

    mesh: Mesh
    density: float
    fixed: IntArray
    chambers: tuple[Chamber, ...]

    @property
    def volume(self) -> float:
        """Of the cells [m^3]."""
        return float(cell_volumes(self.mesh).sum())

    def chamber_volume(self, chamber: Chamber) -> float:
        """Of a chamber [m^3], by the divergence theorem."""
        corners = self.mesh.vertices[face_triangles(chamber.faces)]
        return float(-np.linalg.det(corners - corners.mean(axis=(0, 1))).sum() / 6.0)

    def pieces(self) -> tuple[int, int]:
        """Numbers of pieces that do not touch: of the body, and of its boundary."""
        body, boundary = (connected_parts(cells) for cells in (self.mesh.cells, boundary_triangles(self.mesh)))
        return int(body.max()) + 1, int(boundary.max()) + 1

    def rows(self) -> list[tuple[str, str]]:
        """Names and values of a table."""
        count, sides = len(self.mesh.vertices), _MILLI * np.ptp(self.mesh.vertices, axis=0)
        low = ", ".join(f"{_MILLI * x:.1f}" for x in self.mesh.vertices.min(axis=0))
        rows = [
            ("vertices", f"{count:,} = {3 * count:,} degrees of freedom"),
            ("cells", f"{len(self.mesh.cells):,} of kind {self.mesh.kind}"),
            ("bounding box", f"{sides[0]:.1f} x {sides[1]:.1f} x {sides[2]:.1f} mm from ({low}) mm"),
            ("volume", f"{_CUBIC_CENTI * self.volume:.1f} cm3"),
            ("mass", f"{1e3 * self.volume * self.density:.1f} g at {self.density:g} kg/m3"),
            ("smallest scaled Jacobian", f"{scaled_jacobian(self.mesh).min():.3f} (1 is ideal, 0 is flat)"),
            ("pieces", "{} of the body, {} of its boundary".format(*self.pieces())),
        ]
        for chamber in self.chambers:
            centre = ", ".join(f"{_MILLI * x:.1f}" for x in self.mesh.vertices[chamber.vertices].mean(axis=0))
            volume = _CUBIC_CENTI * self.chamber_volume(chamber)
            rows.append((chamber.name, f"{len(chamber.faces)} faces, {volume:.2f} cm3, centre ({centre}) mm"))
        if not self.chambers:
            rows.append(("chambers", "none is closed"))
        return rows


def make_arm(config: Mapping[str, Any], folder: Path) -> str:
    """Generates an arm: writes the mesh and a picture.

    Args:
        config: With the keys of `conf/make_arm.yaml`.
        folder: Where the picture goes, and the mesh where its path is relative.

    Returns:
        A table.

    Raises:
        InputError: A setting of the wrong kind.
        MeshError: The arm cannot be made.
    """
    settings, density = config["mesh"], _positive(config, "density")
    if settings["order"] not in (1, 2) or (settings["order"] == 2 and settings["cells"] != "tetrahedra"):
        raise MeshError(f"mesh.order is {settings['order']!r}: choose 1, or 2 for tetrahedra with edge midpoints.")
    mesh, surfaces = mesh_arm(arm_geometry(settings), settings["size"], settings["cells"], settings["layers"])
    if settings["order"] == 2:
        mesh = quadratic(mesh)
        surfaces = name_surfaces(mesh)
    write_mesh(folder / config["file"], mesh, surfaces)
    summary = MeshSummary(mesh, density, np.unique(surfaces["base"]), find_chambers(mesh))
    if config["picture"]:
        draw_mesh(folder / "arm.png", summary)
    return _table([*summary.rows(), ("clamped at the base", f"{len(summary.fixed)} vertices")])


def inspect_mesh(config: Mapping[str, Any], folder: Path, built: Mesh | None = None) -> str:
    """Says what is in a mesh.

    Args:
        config: With the keys of `conf/inspect.yaml`.
        folder: Where the picture goes.
        built: The mesh, where it is not that of the file `mesh.path`.

    Returns:
        A table.

    Raises:
        InputError: A setting of the wrong kind.
        MeshError: A file that cannot be read, or a mesh that cannot be simulated.
    """
    density, rows, names = _positive(config, "density"), [], ""
    if built is None:
        path, units, order = (config["mesh"][key] for key in ("path", "units", "order"))
        points = read_vertices(path, units)
        mesh = read_mesh(path, units, order, drop_unreferenced=True)
        unused = len(points) - len(read_mesh(path, units, drop_unreferenced=True).vertices)
        rows.append(("vertices in the file", f"{len(points):,} = {3 * len(points):,} degrees of freedom"))
        if unused:
            rows.append(("of these unused", f"{unused} belong to no cell; drop_unreferenced leaves them out"))
        surfaces = read_surfaces(path, units, order, True)
        names = ", ".join(f"{name} ({len(faces)})" for name, faces in surfaces.items())
    else:
        mesh, points = built, built.vertices
    chosen = {axis: at for axis, at in config["fixed"].items() if at is not None}
    fixed = select_vertices(mesh, **chosen) if chosen else np.empty(0, dtype=np.int64)
    summary = MeshSummary(mesh, density, fixed, find_chambers(mesh))
    rows += summary.rows()
    if chosen:
        where = ", ".join(f"{axis} = {at:g} m" for axis, at in chosen.items())
        there = [np.abs(points[:, "xyz".index(axis)] - at) <= _ON_PLANE for axis, at in chosen.items()]
        rows.append(("fixed", f"{np.all(there, axis=0).sum()} vertices at {where}, {len(fixed)} of them used"))
    if built is None:
        rows.append(("surfaces with a name", names or "none"))
    rows.append(("open cavities", _cavities(mesh)))
    if config["picture"]:
        draw_mesh(folder / "mesh.png", summary)
    return _table(rows)


def _cavities(mesh: Mesh) -> str:
    """What there is to say of cavities that are open."""
    found = open_cavities(mesh)
    if found is None:
        return f"not looked for on a boundary of more than {MOST_TRIANGLES:,} triangles"
    places = [
        f"{1e4 * cavity.area:.1f} cm2 around ({', '.join(f'{_MILLI * x:.1f}' for x in cavity.centre)}) mm"
        for cavity in found
    ]
    return f"{'; '.join(places)}: pressure needs a closed chamber" if places else "none"


def draw_mesh(path: Path, summary: MeshSummary, markers: FloatArray | None = None) -> None:
    """Draws a body from outside, cut open along its length, and translucent, with its chambers in colours.

    Args:
        path: The PNG file to write.
        summary: The body.
        markers: (M, 3) [m], drawn as dots where it is not cut.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    mesh = summary.mesh
    axes = render.view_axes(_TOWARDS_VIEWER)
    sides = 1.04 * np.ptp(mesh.vertices @ axes.T, axis=0)[:2]
    size = np.ceil(_LONGER_SIDE * np.maximum(sides, _NARROWEST * sides.max()) / sides.max()).astype(int)
    dots = np.empty((0, 3)) if markers is None else markers
    picture = render.run(COMMAND, {**_scene(summary), "axes": axes, "size": size, "markers": dots})
    handles = [
        Patch(
            color=colour,
            label=f"{chamber.name.replace('_', ' ')}: {_CUBIC_CENTI * summary.chamber_volume(chamber):.1f} cm³",
        )
        for chamber, colour in zip(summary.chambers, cycle(CHAMBER_COLOURS), strict=False)
    ]
    with rc_context(STYLE):
        width, height = 3 * size[0] / _DPI, size[1] / _DPI
        columns = max(1, int(width / _ENTRY))
        legend = _LINE * -(-len(handles) // columns) + _LINE if handles else 0.0
        figure = Figure(figsize=(width, height + legend + _LINE))
        panel = figure.add_axes((0.0, legend / (height + legend + _LINE), 1.0, height / (height + legend + _LINE)))
        panel.imshow(picture, aspect="auto", interpolation="antialiased")
        panel.set_axis_off()
        for at, title in enumerate(("Outside", "Cut open", "Chambers")):
            figure.text((at + 0.5) / 3, 1.0, title, ha="center", va="top")
        if handles:
            figure.legend(handles=handles, loc="lower center", ncols=columns, frameon=False)
        with atomic_path(path) as target:
            figure.savefig(target, format="png", dpi=_DPI)


def _scene(summary: MeshSummary) -> dict[str, Any]:
    """What `render_cut` draws, but for the camera."""
    mesh, triangles = summary.mesh, boundary_triangles(summary.mesh)
    inner = [face_triangles(chamber.faces) for chamber in summary.chambers]
    paint = [
        np.tile(_bytes(colour), (len(each), 1)) for each, colour in zip(inner, cycle(CHAMBER_COLOURS), strict=False)
    ]
    within = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *(each.ravel() for each in inner)]))
    normal = np.array(_TOWARDS_VIEWER)
    normal[np.ptp(mesh.vertices, axis=0).argmax()] = 0.0  # the body is cut along its longest side
    return {
        "vertices": mesh.vertices,
        "cells": mesh.cells[:, : ELEMENTS[mesh.element.linear].nodes],
        "triangles": triangles,
        "edges": render.face_edges(mesh),
        "outer": triangles[~np.isin(triangles[:, 0], within)],
        "inner": np.concatenate([np.empty((0, 3), dtype=np.int64), *inner]),
        "colours": np.concatenate([np.empty((0, 3)), *paint]),
        "clamped": summary.fixed,
        "cut_normal": normal,
        "cut_origin": mesh.vertices.mean(axis=0),
    }


def _bytes(colour: str) -> list[int]:
    """Red, green and blue of a colour like #e69f00, 0 to 255."""
    return [int(colour[at : at + 2], 16) for at in (1, 3, 5)]


def _table(rows: list[tuple[str, str]]) -> str:
    """Rows of two columns."""
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _positive(config: Mapping[str, Any], key: str) -> float:
    """A positive number from the configuration; InputError where it is none."""
    value = config[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < np.inf:
        raise InputError(f"{key} is {value!r}: it must be a positive number.")
    return float(value)
