"""Reference trajectories of boxes, and how far a simulation with their own parameters departs from them.

The format is a NumPy archive without pickled objects that holds the keys of `REFERENCE_SHAPES`. It carries
vertices only, in x-major order; the hexahedra between them follow from the distinct coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..dynamics.nonlinear_solver import SolverName, SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import Material, make_material
from ..experiment.build import choose_device
from ..io.errors import ConvergenceError, DataFileError, InputError
from ..io.files import read_arrays
from ..io.settings import Natural, Positive, Settings, Some, Word, parse
from ..mesh.mesh import Mesh, box_hexahedra
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .beam import clamped

LARGEST_ERROR = 1e-8  # m

FloatArray = NDArray[np.float64]

# Shape of each entry; T steps, N vertices.
REFERENCE_SHAPES: dict[str, tuple[int | str, ...]] = {
    "youngs_modulus": (),  # Pa
    "poissons_ratio": (),
    "density": (),  # kg/m^3
    "dt": (),  # s
    "gravity": (3,),  # m/s^2
    "vertices": ("N", 3),  # m
    "f_ext": ("T", "N", 3),  # N, held during step t
    "q": ("T + 1", "N", 3),  # m, state 0 is the start
    "v": ("T + 1", "N", 3),  # m/s
}
_GRID_TOLERANCE = 1e-9  # of the box's length: distance within which coordinates count as equal


class VerifySettings(Settings):
    """The configuration ``verify``, which has what the keys mean, and their values."""

    files: Some[Word]
    solvers: Some[SolverName]
    tolerance: Positive
    max_iterations: Natural
    device: Word


def verify(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the largest vertex error of each file and solver; exits with 1 where one exceeds `LARGEST_ERROR`.

    Raises:
        InputError: no file is named, or a value cannot be used.
        DataFileError: a file is no reference trajectory.
    """
    if not config["files"]:
        raise InputError("name reference trajectories, as in warp-resphys verify FILE...")
    settings = parse(VerifySettings, config)
    wp.config.log_level = wp.LOG_WARNING
    device = choose_device(settings.device)
    references = {path: read_reference(path) for path in map(Path, settings.files)}
    passed = True
    print(f"{'file':32}{'solver':22}{'tolerance':>10}{'iterations':>12}{'largest error [m]':>20}")
    for path, reference in references.items():
        for name in settings.solvers:
            solver = SolverSettings(name, settings.tolerance, max_iterations=settings.max_iterations)
            try:
                error, iterations = compare_with_reference(reference, solver, device)
                outcome = f"{iterations:12.1f}{error:20.2e}"
                outcome += "" if error <= LARGEST_ERROR else f"  exceeds {LARGEST_ERROR:.0e}"
                passed &= error <= LARGEST_ERROR
            except ConvergenceError as failure:
                passed, outcome = False, f"  not converged: {failure}"
            print(f"{path.stem:32}{name:22}{settings.tolerance:10.0e}{outcome}", flush=True)
    if not passed:
        raise SystemExit(1)


@dataclass(frozen=True)
class ReferenceTrajectory:
    """A recorded simulation of a box whose face at the smallest x is held."""

    material: Material
    time_step: float  # [s]
    gravity: FloatArray  # (3,) [m/s^2]
    mesh: Mesh  # the box of hexahedra, with the file's vertices
    forces: FloatArray  # (T, N, 3) external force held during each step [N]
    q: FloatArray  # (T + 1, N, 3) [m]
    v: FloatArray  # (T + 1, N, 3) [m/s]


class Comparison(NamedTuple):
    """Departure of a simulation from a reference trajectory."""

    largest_error: float  # distance of a vertex from the reference, over all steps [m]
    iterations: float  # mean global steps of the solver a time step


def read_reference(path: Path) -> ReferenceTrajectory:
    """Reads a reference trajectory from a NumPy archive (.npz) without pickled objects.

    Raises:
        DataFileError: the file is missing or no such archive; it lacks entries, has others, or has some of wrong shape,
            type or range; or its vertices are no box grid in x-major order.
    """
    read = read_arrays(path)
    if "" in read:
        raise DataFileError(f"{path} is a single array: give a reference trajectory (.npz).")
    missing = [name for name in REFERENCE_SHAPES if name not in read]
    foreign = sorted(name for name in read if name not in REFERENCE_SHAPES)
    found = [f"{problem} {', '.join(names)}" for problem, names in (("lacks", missing), ("has", foreign)) if names]
    if found:
        raise DataFileError(
            f"{path} {' and '.join(found)}: a reference trajectory has {', '.join(REFERENCE_SHAPES)} and no more."
        )
    _check_values(read, path)
    values = {name: np.asarray(value, dtype=np.float64) for name, value in read.items()}
    dt = float(values["dt"])
    if not dt > 0.0:
        raise DataFileError(f"{path}: dt is {dt:g}: it must be positive, in seconds.")
    try:
        named = {key: float(values[key]) for key in ("youngs_modulus", "poissons_ratio", "density")}
        material = make_material("corotated", **named)
    except InputError as error:
        raise DataFileError(f"{path}: {error}") from None
    mesh = box_of_vertices(values["vertices"], str(path))
    return ReferenceTrajectory(material, dt, values["gravity"], mesh, values["f_ext"], values["q"], values["v"])


def _check_values(values: Mapping[str, NDArray[np.generic]], path: Path) -> None:
    """Refuses entries of another shape or type; f_ext and vertices say what T and N are."""
    steps, vertices = (next(iter(np.shape(values[name])), 0) for name in ("f_ext", "vertices"))
    sizes = {"T": steps, "N": vertices, "T + 1": steps + 1}
    for name, wanted in REFERENCE_SHAPES.items():
        value = values[name]
        shape = tuple(sizes[size] if isinstance(size, str) else size for size in wanted)
        if value.shape != shape or value.dtype.kind not in "fiu":
            described = f"({', '.join(map(str, wanted))})" if wanted else "a single number"
            raise DataFileError(
                f"{path}: {name} is {value.shape} of {value.dtype}, but must be {described} with real numbers"
                f"{f', here {shape}' if wanted else ''}."
            )
        if not np.isfinite(value).all():
            raise DataFileError(f"{path}: {name} has values that are not finite.")
        if not value.size:
            raise DataFileError(f"{path}: {name} is empty.")


def box_of_vertices(vertices: FloatArray, source: str = "the mesh") -> Mesh:
    """The box of hexahedra whose vertices are given.

    Args:
        vertices: (N, 3) grid points in x-major order, z running fastest [m]; the spacing may vary.
        source: what to name in an error.

    Raises:
        DataFileError: the vertices are no such grid.
    """
    tolerance = _GRID_TOLERANCE * float(np.ptp(vertices, axis=0).max(initial=0.0))
    axes = [_distinct(vertices[:, axis], tolerance) for axis in range(3)]
    divisions = [len(axis) - 1 for axis in axes]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if min(divisions) < 1 or grid.shape != vertices.shape or np.abs(grid - vertices).max() > tolerance:
        counts = " x ".join(str(len(axis)) for axis in axes)
        raise DataFileError(
            f"{source}: {len(vertices)} vertices with {counts} distinct coordinates along x, y and z are no box grid "
            "in x-major order (z runs fastest), from which alone the hexahedra can be recovered."
        )
    return Mesh(vertices, box_hexahedra(divisions=divisions).cells)


def _distinct(coordinates: FloatArray, tolerance: float) -> FloatArray:
    """Sorted coordinates that lie further apart than the tolerance."""
    ordered = np.sort(coordinates)
    return ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]


def compare_with_reference(
    reference: ReferenceTrajectory, settings: SolverSettings, device: str | torch.device = "cpu"
) -> Comparison:
    """Simulates a reference trajectory from its own start, loads and parameters, the way it was computed.

    That is with implicit Euler, the mean element's mass at every vertex, full integration of both terms of the energy,
    and the face at the smallest x held.

    Raises:
        ConvergenceError: the solver failed.
    """
    mesh, gravity = reference.mesh, [float(g) for g in reference.gravity]
    body = clamped(mesh, mass="per_vertex", volume_integration="full")
    simulator = Simulator(body, reference.material, reference.time_step, gravity, solver=settings, device=device)
    q, v, forces = (simulator.tensor(x) for x in (reference.q, reference.v, reference.forces))
    with torch.no_grad():
        trajectory = simulator.rollout(State(q[:1], v[:1]), len(forces), Inputs(external_force=forces[:, None]))
    distance = torch.linalg.vector_norm(trajectory.q[:, 0] - q, dim=-1)
    iterations = torch.stack([report.iterations for report in trajectory.reports])
    return Comparison(float(distance.max()), float(iterations.double().mean()))
