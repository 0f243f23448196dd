"""Digests of the files that a configuration names, which fingerprints of stages contain."""

from itertools import chain
from pathlib import Path

from ..io.atomic import digest
from ..io.errors import DataFileError
from ..settings.body import BodySettings
from ..settings.run import RunSettings


def files_read(run: RunSettings, *bodies: BodySettings | None) -> dict[str, str]:
    """Returns the SHA-256 of the files of bodies and base motions, by path.

    Args:
        run: settings of the run.
        bodies: of the simulator and of the simulation that plays the real body; None is left out.

    Raises:
        DataFileError: a file cannot be read.
    """
    folder = Path((run.recorded.folder if run.recorded is not None else None) or ".").expanduser()
    moved = {motion.file for motion in run.motions().values() if motion.file is not None}
    motions = {
        name: digest_of(folder / name, "the file of base_motion or obstacle_motion")
        for name in sorted(moved)
    }
    meshes = chain.from_iterable(body.meshes for body in bodies if body)
    paths = [getattr(mesh, "path", None) for mesh in meshes]
    return motions | {path: digest(path) for path in paths if path is not None}


def digest_of(path: Path, key: str) -> str:
    """Returns the SHA-256 of a file that a key of the configuration names.

    Raises:
        DataFileError: the file cannot be read.
    """
    try:
        return digest(str(path))
    except OSError as error:
        raise DataFileError(
            f"cannot read {path} ({error.strerror}): check data.folder and {key}."
        ) from error
