"""Reference trajectories of boxes, and deviations of simulations with the same parameters.

A file is a NumPy archive without pickled objects with the keys of `REFERENCE_SHAPES`. It has vertices only, in x-major
order; the hexahedra follow from the distinct coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..dynamics.nonlinear_solver import SolverName, SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.catalogue import make_material
from ..energies.materials import Material
from ..experiment.build import choose_device
from ..io.errors import ConvergenceError, DataFileError, InputError
from ..io.files import read_arrays
from ..io.settings import Many, Natural, Positive, Settings, Some, Word
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
_GRID_TOLERANCE = 1e-9  # distance within which coordinates count as equal, over the longest side of the box


class VerifySettings(Settings):
    """The configuration ``verify``, which explains its keys."""

    files: Many[Word]
    solvers: Some[SolverName]
    tolerance: Positive
    max_iterations: Natural
    device: Word


def verify(settings: VerifySettings, folder: Path) -> None:
    """Prints the largest vertex error of each file and solver; exits with 1 where one exceeds `LARGEST_ERROR`.

    Raises:
        InputError: no file is named.
        DataFileError: a file is not a reference trajectory.
    """
    if not settings.files:
        raise InputError("name reference trajectories, as in warp-resphys verify FILE...")
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
    """A recorded simulation of a box whose face at the smallest x is fixed."""

    material: Material
    time_step: float  # [s]
    gravity: FloatArray  # (3,) [m/s^2]
    mesh: Mesh  # the box of hexahedra, with the file's vertices
    forces: FloatArray  # (T, N, 3) external force held during each step [N]
    q: FloatArray  # (T + 1, N, 3) [m]
    v: FloatArray  # (T + 1, N, 3) [m/s]


class Comparison(NamedTuple):
    """Deviation of a simulation from a reference trajectory."""

    largest_error: float  # distance of a vertex from the reference, over all steps [m]
    iterations: float  # mean global steps of the solver a time step


def read_reference(path: Path) -> ReferenceTrajectory:
    """Reads a reference trajectory from a NumPy archive (.npz) without pickled objects.

    Raises:
        DataFileError: the file is missing or not such an archive; it has missing or unknown entries, or values of wrong
            shape, type or range; or its vertices are not a box grid in x-major order.
    """
    arrays = read_arrays(path)
    if "" in arrays:
        raise DataFileError(f"{path} is a single array: give a reference trajectory (.npz).")
    missing = [name for name in REFERENCE_SHAPES if name not in arrays]
    unknown = sorted(name for name in arrays if name not in REFERENCE_SHAPES)
    wrong = [f"{problem} {', '.join(names)}" for problem, names in (("lacks", missing), ("has", unknown)) if names]
    if wrong:
        raise DataFileError(
            f"{path} {' and '.join(wrong)}: a reference trajectory has {', '.join(REFERENCE_SHAPES)} and no more."
        )
    _check_values(arrays, path)
    values = {name: np.asarray(value, dtype=np.float64) for name, value in arrays.items()}
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
    """Refuses entries of wrong shape or type, where f_ext and vertices define T and N."""
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
    """The box of hexahedra with the given vertices.

    Args:
        vertices: (N, 3) grid points in x-major order, z running fastest [m]; the spacing may vary.
        source: file or mesh, for error messages.

    Raises:
        DataFileError: the vertices are not such a grid.
    """
    tolerance = _GRID_TOLERANCE * float(np.ptp(vertices, axis=0).max(initial=0.0))
    axes = [_distinct(vertices[:, axis], tolerance) for axis in range(3)]
    divisions = [len(axis) - 1 for axis in axes]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if min(divisions) < 1 or grid.shape != vertices.shape or np.abs(grid - vertices).max() > tolerance:
        counts = " x ".join(str(len(axis)) for axis in axes)
        raise DataFileError(
            f"{source}: {len(vertices)} vertices with {counts} distinct coordinates along x, y and z are not a box "
            "grid in x-major order (z runs fastest), which is needed to recover the hexahedra."
        )
    return Mesh(vertices, box_hexahedra(divisions=divisions).cells)


def _distinct(coordinates: FloatArray, tolerance: float) -> FloatArray:
    """Sorted coordinates without those within the tolerance of the one before."""
    ordered = np.sort(coordinates)
    return ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]


def compare_with_reference(
    reference: ReferenceTrajectory, settings: SolverSettings, device: str | torch.device = "cpu"
) -> Comparison:
    """Simulates a reference trajectory from its start, loads and parameters, and compares all vertices.

    As in the reference: implicit Euler, the mean element mass at every vertex, full integration of both terms of the
    energy, and the face at the smallest x fixed.

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
