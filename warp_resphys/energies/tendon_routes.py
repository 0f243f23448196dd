"""Points and quantities of tendons, with and without friction."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..kernels import tendons as kernels
from ..stepping.quantity import Quantity
from .part_terms import PartPoints


@dataclass(frozen=True)
class TendonPoints(PartPoints):
    """Segments of tendons between guides, tendon after tendon, with the operators of F (`kernels.tendons`)."""

    rest: NDArray[np.float64]  # (P, 3, 3) F of the undeformed body [m]
    anchors: NDArray[np.float64]  # (P, 3, 3) part of F due to guides that are fixed in the world [m]


TENSION = Quantity("tendon_tension", "N", 0.0, closed=True, per="tendon", words="tension", shown_unit="N")
CONTRACTION = Quantity(
    *("tendon_contraction", "m"), per="tendon", typical=1e-3, words="contraction", shown_unit="mm", shown_factor=1e3
)
STIFFNESS = Quantity("tendon_stiffness", "N/m", 0.0, closed=True, per="tendon")
OFFSETS = tuple(Quantity(f"tendon_offset_{k}", "m", per="tendon", typical=1e-3) for k in (1, 2))


def offset_vector(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Returns the vectors c (1 or B, T, 3) of `kernels.tendons` for offsets by name."""
    first, second = torch.broadcast_tensors(*(values[offset.name] / kernels.OFFSET_UNIT for offset in OFFSETS))
    return torch.stack([torch.ones_like(first), first, second], -1)
