"""Decodes files of other programs in a subprocess with limits on memory and time.

On a damaged file, ezc3d and HDF5 (C++ and C) can crash, loop or allocate gigabytes, and meshio can
loop. This module is therefore also a program, which decodes one file and returns plain arrays. What
it imports from the package takes no time.
"""

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .abaqus_file import read_abaqus
from .errors import DecodingError
from .gmsh_file import read_gmsh
from .mesh_blocks import Block, mesh_arrays_of
from .vtk_file import read_vtk

if TYPE_CHECKING:
    import h5py

Arrays = dict[str, NDArray[Any]]

MEMORY = (2 << 30, 64)  # limit of the address space: bytes, plus bytes per byte of the file
SECONDS = (10.0, 2e-6)  # limit of processor time: seconds, plus seconds per byte of the file
MESH_READERS = {  # by extension; meshio reads the other formats
    **{".msh": read_gmsh, ".inp": read_abaqus},
    **dict.fromkeys((".vtk", ".vtu", ".vti", ".vtr", ".vts"), read_vtk),
}
_OUT_OF_TIME = -getattr(signal, "SIGXCPU", 0)
_WAITING = 6  # limit of wall-clock time over that of processor time, for a busy machine


def decode(library: str, path: Path, *names: str) -> Arrays:
    """Runs `c3d_arrays`, `mesh_arrays` or `hdf5_arrays` in a subprocess, and returns the arrays.

    Args:
        library: "ezc3d", "meshio", for all meshes, or "h5py".
        path: An existing file.
        names: Further arguments of `hdf5_arrays`.

    Raises:
        DecodingError: The library refuses the file, crashes, or exceeds the limits for a file of
            this size.
    """
    size = path.stat().st_size
    memory, seconds = MEMORY[0] + MEMORY[1] * size, SECONDS[0] + SECONDS[1] * size
    limits = str(memory), str(np.ceil(seconds).astype(int))
    command = [sys.executable, "-P", "-m", __spec__.name, *limits, library, str(path), *names]
    # Each claims address space.
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    endless = f"decoding takes more than {seconds:.0f} s"
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            timeout=_WAITING * seconds,
            check=False,
            env={**os.environ, **one_thread},
        )
    except subprocess.TimeoutExpired as error:
        raise DecodingError(endless) from error
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as archive:
            return dict(archive)
    if done.returncode == 1:
        raise DecodingError(done.stderr.decode(errors="replace").strip())
    raise DecodingError(
        endless if done.returncode == _OUT_OF_TIME else f"{library} ends with {done.returncode}"
    )


def c3d_arrays(path: str) -> Arrays:
    """Reads points (4, M, T), their labels, units and rate of a C3D file,
    and the labels of points that are no markers.

    A parameter has at most 255 labels: LABELS2, LABELS3 and so on continue the list.
    """
    import ezc3d

    file = ezc3d.c3d(path)
    point = file["parameters"]["POINT"]
    parts = sorted(
        (name for name in point if re.fullmatch(r"LABELS\d*", name)),
        key=lambda name: int(name[6:] or 1),
    )
    # Model outputs of Vicon.
    computed = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")
    texts = {
        "labels": [label for name in parts for label in point[name]["value"]],
        "units": point["UNITS"]["value"] if "UNITS" in point else [],
        "computed": [label for name in computed if name in point for label in point[name]["value"]],
    }
    return {
        "points": np.asarray(file["data"]["points"], dtype=np.float64),
        "rate": np.array(point["RATE"]["value"], dtype=np.float64),
        **{name: np.array(values, dtype=np.str_) for name, values in texts.items()},
    }


def hdf5_arrays(path: str, *names: str) -> Arrays:
    """Reads datasets, with units, and attributes of an HDF5 file's root by name.

    Missing ones are omitted.

    The units of the dataset "positions" are returned as "positions.units". h5py's own errors are
    not caught.

    Raises:
        DecodingError: The file refers to data elsewhere, or a value is neither numbers nor text.
    """
    import h5py

    arrays = {}
    with h5py.File(path, "r") as file:
        refuse_data_elsewhere(file)
        for name in names:
            item = file.get(name)
            if isinstance(item, h5py.Dataset):
                arrays[name] = _plain(item[()], name)
                if "units" in item.attrs:
                    arrays[f"{name}.units"] = _plain(item.attrs["units"], f"{name}.units")
            elif name in file.attrs:
                arrays[name] = _plain(file.attrs[name], name)
    return arrays


def _plain(value: Any, name: str) -> NDArray[Any]:
    """Returns numbers unchanged, and text as an array of `numpy.str_`."""
    array = np.asarray(value)
    if array.dtype == object:
        words = [
            word.decode(errors="replace") if isinstance(word, bytes) else str(word)
            for word in array.flat
        ]
        return np.array(words, dtype=np.str_).reshape(array.shape)
    if array.dtype.hasobject:
        raise DecodingError(f"'{name}' contains neither numbers nor text")
    return array


def refuse_data_elsewhere(file: "h5py.File") -> None:
    """Raises DecodingError if a link or dataset of an HDF5 file refers to another file."""
    import h5py

    groups: list[h5py.Group] = [file]
    seen = set()
    while groups:
        group = groups.pop()
        address = h5py.h5o.get_info(group.id).addr
        if address in seen:
            continue
        seen.add(address)
        for name in group:
            item = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
            if item is None or (
                isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
            ):
                raise DecodingError(f"'{group.name.rstrip('/')}/{name}' refers to data elsewhere")
            if isinstance(item, h5py.Group):
                groups.append(item)


def mesh_arrays(path: str, file_format: str | None = None) -> Arrays:
    """Reads points, volume cells, named surfaces and named regions (`mesh_blocks.mesh_arrays_of`).

    Args:
        path: a file with one of `MESH_READERS`, or one that meshio reads, whose own errors are not
            caught.
        file_format: meshio's name of the format; None for that of the file name extension.

    Raises:
        DecodingError: the file cannot be read.
    """
    suffix = {None: Path(path).suffix.lower(), "gmsh": ".msh", "abaqus": ".inp"}.get(file_format)
    with Path(path).open("rb") as file:
        of_fluent = suffix == ".msh" and file.read(1) == b"("  # which meshio writes by default
    reader = MESH_READERS.get(suffix or "")
    if of_fluent or reader is None:
        return mesh_arrays_of(*_read_by_meshio(path, file_format))
    try:
        return mesh_arrays_of(*reader(path))
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise DecodingError(
            f"the file is damaged or not whole ({error}); save the mesh again"
        ) from error


def _read_by_meshio(path: str, file_format: str | None) -> tuple[NDArray[np.float64], list[Block]]:
    """Returns points and blocks of a file; cell sets are groups."""
    import meshio

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            content = meshio.read(path, file_format)
    except SystemExit as error:
        raise DecodingError(printed.getvalue()) from error
    blocks = []
    for number, block in enumerate(content.cells):
        sets = {
            name: cells[number]
            for name, cells in content.cell_sets.items()
            if cells[number] is not None
        }
        groups = {name: np.asarray(cells, dtype=np.int64) for name, cells in sets.items()}
        nodes = block.data if isinstance(block.data, np.ndarray) else np.empty((len(block), 0))
        blocks.append(Block(block.type, block.dim, nodes.astype(np.int64), groups))
    return np.asarray(content.points, dtype=np.float64), blocks


def _limit(memory: int, seconds: int) -> None:
    """Limits memory and processor time of this process, if the system supports it."""
    with contextlib.suppress(ImportError):
        import resource

        for kind, most in (
            (resource.RLIMIT_AS, memory),
            (resource.RLIMIT_CPU, seconds),
            (resource.RLIMIT_CORE, 0),
        ):
            hard = resource.getrlimit(kind)[1]
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(
                    kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
                )


def _main(memory: str, seconds: str, library: str, path: str, *names: str) -> int:
    """Decodes a file: writes its arrays to stdout and returns 0,
    or the reason of a failure to stderr and returns 1.
    """
    _limit(int(memory), int(seconds))
    answer, reason = (os.fdopen(os.dup(stream), "wb") for stream in (1, 2))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # discards what the libraries print
    os.dup2(nowhere, 2)
    try:
        arrays: dict[str, Any] = {**decoded(library, path, *names)}
        np.savez(answer, **arrays)
        answer.close()
        return 0
    except MemoryError:
        message = f"it takes more than {int(memory) >> 20} MiB of memory"
    except DecodingError as error:
        message = str(error)
    reason.write(message.encode(errors="replace"))
    reason.close()
    return 1


def decoded(library: str, path: str, *names: str) -> Arrays:
    """Reads a file in this process, without limits; see `decode`.

    Raises:
        DecodingError: The library refuses the file.
        MemoryError: The file claims more memory than there is.
    """
    decoders: dict[str, Callable[..., Arrays]] = {
        "ezc3d": c3d_arrays,
        "meshio": mesh_arrays,
        "h5py": hdf5_arrays,
    }
    try:
        return decoders[library](path, *names)
    except MemoryError:
        raise
    except ModuleNotFoundError as error:
        message = f"install the Python package {error.name} to read it"
    except DecodingError as error:
        message = str(error)
    except Exception as error:
        if "bad_alloc" in str(error):
            raise MemoryError from error
        message = f"{type(error).__name__}: {error}"
    raise DecodingError(" ".join(message.split())[:300] or "no reason given")


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
