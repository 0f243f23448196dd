"""Names of the files of an experiment with pressures, and the reader of the imported motions."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...io.files import read_array, read_hdf5
from ...learning.driven import DrivenMotions

MOTIONS = "motions.h5"
RAISED_MOTIONS = "motions_raised.h5"
RAISED_RECORDINGS = "recordings_raised"  # not beside the others: that folder may become another experiment's data
RECONSTRUCTED = "reconstruction.h5"
RECONSTRUCTION = "reconstruction.json"
MODELS = ("simulation", "sysid", "simfree", "resphys")
FORCE_FRAMES = COROTATED, WORLD = ("corotated", "world")
LEARNED = ("simfree", "resphys")


@dataclass(frozen=True)
class Imported:
    """What was imported, in the frame of the body.

    Attributes:
        motions: of all trials, in float64 on the CPU.
        smoothed: (R, K + 1, M, 3) its markers without what is faster than ``data.cutoff`` [m].
        bound: (M, 3) the followed markers on the undeformed body [m].
        labels: names of the markers.
        gravity: (3,) [m/s^2].
    """

    motions: DrivenMotions
    smoothed: torch.Tensor
    bound: NDArray[np.float64]
    labels: tuple[str, ...]
    gravity: NDArray[np.float64]

    def and_those_of(self, other: "Imported") -> "Imported":
        """These motions and others of the same body after them."""
        a, b = self.motions, other.motions
        fields = ("times", "markers", "held", "attached_mass", "pressure")
        joined = DrivenMotions((*a.names, *b.names), *(torch.cat([getattr(a, f), getattr(b, f)]) for f in fields))
        return replace(self, motions=joined, smoothed=torch.cat([self.smoothed, other.smoothed]))


def read_imported(path: Path, vertices: int) -> Imported:
    """Reads motions.h5, or the same of the trials at higher pressures.

    Args:
        path: the file.
        vertices: of the body, on which nothing hangs.

    Raises:
        DataFileError: the file is missing, damaged or of another kind.
    """
    with read_hdf5(path, "motions") as file:
        names = tuple(str(name) for name in file.attrs["names"])
        labels = tuple(str(label) for label in file.attrs["labels"])
        gravity = np.asarray(file.attrs["gravity"], dtype=np.float64)
        step = float(file.attrs["time_step"])
        r, m = len(names), len(labels)
        markers = read_array(file, "markers", (r, None, m, 3))
        smoothed = read_array(file, "smoothed", markers.shape)
        pressure = read_array(file, "pressure", (r, markers.shape[1] - 1, None))
        bound = read_array(file, "bound", (m, 3))
    times = np.tile(step * np.arange(markers.shape[1]), (r, 1))
    masses = np.zeros((r, vertices))
    arrays = (times, markers, markers[:, 0], masses, pressure)
    motions = DrivenMotions(names, *map(torch.from_numpy, arrays))
    return Imported(motions, torch.from_numpy(smoothed), bound, labels, gravity)
