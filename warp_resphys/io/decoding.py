"""Files of other programs, decoded by the libraries for them in a process of little memory and time.

A damaged file makes ezc3d and HDF5, which are C++ and C, crash, loop or claim gigabytes, and meshio loop over what was
cut off. So this file is also a program: it decodes one file, within limits that its caller sets, and hands
plain arrays on. It imports nothing of the package, which would take longer than most files do.
"""

import contextlib
import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import h5py

Arrays = dict[str, NDArray[Any]]

MEMORY = (2 << 30, 64)  # bytes of address space, and how many more for each byte of the file
SECONDS = (10.0, 2e-6)  # of a processor, and how many more for each byte of the file
_OUT_OF_TIME = -getattr(signal, "SIGXCPU", 0)
_WAITING = 6  # times as long may pass on a busy machine
_SURFACE_CELLS = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4}  # number of corners
_PHYSICAL = "gmsh:physical"  # meshio's name of gmsh's numbers of groups


class DecodingError(Exception):
    """A file that cannot be decoded; the message is the reason, for a sentence that names the file."""


def decode(library: str, path: Path, *names: str) -> Arrays:
    """The arrays of `c3d_arrays`, `mesh_arrays` or `hdf5_arrays`, made in a process of its own.

    Args:
        library: "ezc3d", "meshio" or "h5py".
        path: An existing file.
        names: Of `hdf5_arrays`.

    Raises:
        DecodingError: The library refuses the file, crashes, or takes more memory or time than files of that size do.
    """
    size = path.stat().st_size
    memory, seconds = MEMORY[0] + MEMORY[1] * size, SECONDS[0] + SECONDS[1] * size
    limits = str(memory), str(np.ceil(seconds).astype(int))
    command = [sys.executable, "-P", __file__, *limits, library, str(path), *names]
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}  # each claims address space
    endless = f"decoding it does not end within {seconds:.0f} s"
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=_WAITING * seconds, check=False, env={**os.environ, **one_thread}
        )
    except subprocess.TimeoutExpired as error:
        raise DecodingError(endless) from error
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as archive:
            return dict(archive)
    if done.returncode == 1:
        raise DecodingError(done.stderr.decode(errors="replace").strip())
    raise DecodingError(endless if done.returncode == _OUT_OF_TIME else f"{library} ends with {done.returncode}")


def c3d_arrays(path: str) -> Arrays:
    """Of a C3D file: points (4, M, T), labels, units and rate."""
    import ezc3d

    file = ezc3d.c3d(path)
    point = file["parameters"]["POINT"]
    return {
        "points": np.asarray(file["data"]["points"], dtype=np.float64),
        "labels": np.array(point["LABELS"]["value"], dtype=np.str_),
        "units": np.array(point["UNITS"]["value"] if "UNITS" in point else [], dtype=np.str_),
        "rate": np.array(point["RATE"]["value"], dtype=np.float64),
    }


def hdf5_arrays(path: str, *names: str) -> Arrays:
    """Of an HDF5 file: what its root has of these names, as datasets or attributes, and the units of datasets.

    The units of the dataset "positions" are called "positions.units". Other errors are h5py's, of any kind.

    Raises:
        DecodingError: The file refers to data elsewhere, or what was asked for is neither numbers nor text.
    """
    import h5py

    found = {}
    with h5py.File(path, "r") as file:
        refuse_data_elsewhere(file)
        for name in names:
            item = file.get(name)
            if isinstance(item, h5py.Dataset):
                found[name] = _plain(item[()], name)
                if "units" in item.attrs:
                    found[f"{name}.units"] = _plain(item.attrs["units"], f"{name}.units")
            elif name in file.attrs:
                found[name] = _plain(file.attrs[name], name)
    return found


def _plain(value: Any, name: str) -> NDArray[Any]:
    """Numbers as they are, text as such."""
    array = np.asarray(value)
    if array.dtype == object:
        words = [word.decode(errors="replace") if isinstance(word, bytes) else str(word) for word in array.flat]
        return np.array(words, dtype=np.str_).reshape(array.shape)
    if array.dtype.hasobject:
        raise DecodingError(f"'{name}' holds neither numbers nor text")
    return array


def refuse_data_elsewhere(file: "h5py.File") -> None:
    """Visits every link and dataset of an HDF5 file; raises DecodingError for those that lead out of it."""
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
            if item is None or (isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)):
                raise DecodingError(f"'{group.name.rstrip('/')}/{name}' refers to data elsewhere")
            if isinstance(item, h5py.Group):
                groups.append(item)


def mesh_arrays(path: str, file_format: str | None = None) -> Arrays:
    """Of a file that meshio reads: `points` (N, 3), the types of its cells, volume cells, named surfaces and regions.

    `types` names the types; `solid/TYPE` are the cells (M, k) of those that fill a volume, `surface/NAME` the corners
    (F, 3 | 4) of the faces of each named surface, `region/NAME` the numbers (m,) of the volume cells of each named
    region. Other errors than this one are meshio's, of any kind.

    Raises:
        DecodingError: meshio knows no way to read the file.
    """
    import meshio

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            content = meshio.read(path, file_format)
    except SystemExit as error:
        raise DecodingError(printed.getvalue()) from error
    arrays = {"points": np.asarray(content.points, dtype=np.float64)}
    arrays["types"] = np.array([block.type for block in content.cells if len(block)], dtype=np.str_)
    solids: dict[str, list[NDArray[np.int64]]] = {}
    for block in content.cells:
        if block.dim == 3 and len(block):
            polyhedra = not isinstance(block.data, np.ndarray)
            data = np.empty((len(block), 0)) if polyhedra else block.data
            solids.setdefault(f"solid/{block.type}", []).append(np.asarray(data, dtype=np.int64))
    surfaces = {f"surface/{name}": parts for name, parts in _named_surfaces(content).items()}
    regions = {f"region/{name}": parts for name, parts in _named_regions(content).items()}
    return arrays | {name: np.concatenate(parts) for name, parts in (solids | surfaces | regions).items()}


def _named_surfaces(content: Any) -> dict[str, list[NDArray[np.int64]]]:
    """Corners (F, 3 | 4) of the faces of each named surface, block by block."""
    members: dict[str, list[NDArray[np.int64]]] = {}
    for name, number, cells in _groups(content, 2):
        block = content.cells[number]
        if block.type in _SURFACE_CELLS:
            corners = np.asarray(block.data, dtype=np.int64)[:, : _SURFACE_CELLS[block.type]]
            members.setdefault(name, []).append(corners[cells])
    return members


def _named_regions(content: Any) -> dict[str, list[NDArray[np.int64]]]:
    """Numbers (M,) of the cells of each named region among all cells that fill a volume, block by block."""
    sizes = [len(block) if block.dim == 3 else 0 for block in content.cells]
    first = np.cumsum([0, *sizes])
    members: dict[str, list[NDArray[np.int64]]] = {}
    for name, number, cells in _groups(content, 3):
        members.setdefault(name, []).append(first[number] + cells)
    return members


def _groups(content: Any, dimension: int) -> Iterator[tuple[str, int, NDArray[np.int64]]]:
    """Yields the name, the number of the block and the cells there of gmsh's physical groups, or of cell sets."""
    groups = {tuple(int(n) for n in tag): name for name, tag in content.field_data.items() if len(tag) == 2}
    for number, block in enumerate(content.cells):
        if block.dim != dimension:
            continue
        if _PHYSICAL in content.cell_data:
            tags = np.asarray(content.cell_data[_PHYSICAL][number])
            for tag in np.unique(tags).tolist():
                if (tag, dimension) in groups:
                    yield groups[tag, dimension], number, np.flatnonzero(tags == tag)
            continue
        for name, sets in content.cell_sets.items():
            if sets[number] is not None and len(sets[number]):
                yield name, number, np.asarray(sets[number], dtype=np.int64)


def _limit(memory: int, seconds: int) -> None:
    """Bounds this process, where the system can."""
    with contextlib.suppress(ImportError):
        import resource

        for kind, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
            hard = resource.getrlimit(kind)[1]
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _main(memory: str, seconds: str, library: str, path: str, *names: str) -> int:
    """Decodes a file: its arrays to stdout, or one line with the reason to stderr and 1."""
    _limit(int(memory), int(seconds))
    answer, reason = (os.fdopen(os.dup(stream), "wb") for stream in (1, 2))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # The libraries print.
    os.dup2(nowhere, 2)
    too_much = f"it takes more than {int(memory) >> 20} MiB of memory"
    try:
        decoders: dict[str, Callable[..., Arrays]] = {"ezc3d": c3d_arrays, "meshio": mesh_arrays, "h5py": hdf5_arrays}
        arrays: dict[str, Any] = {**decoders[library](path, *names)}
        np.savez(answer, **arrays)
        answer.close()
        return 0
    except MemoryError:
        said = too_much
    except ModuleNotFoundError as error:
        said = f"for that, install the Python package {error.name}"
    except DecodingError as error:
        said = str(error)
    except Exception as error:
        said = too_much if "bad_alloc" in str(error) else f"{type(error).__name__}: {error}"
    reason.write((" ".join(said.split())[:200] or "no reason given").encode(errors="replace"))
    reason.close()
    return 1


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
