"""Markers on a body, as an experiment's group ``markers`` binds them."""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike

from ..data.markers import Markers, bind_markers
from ..mesh.mesh import Mesh, select_vertices


def bound_markers(settings: Mapping[str, Any], mesh: Mesh, places: ArrayLike, labels: Sequence[str]) -> Markers:
    """Markers at places on the undeformed body, in float64 on the CPU.

    Args:
        settings: the group ``markers``.
        mesh: of the body.
        places: (M, 3) [m].
        labels: M names.

    Raises:
        InputError: see `bind_markers`.
        MeshError: no vertex lies where ``markers.bind_to`` says.
    """
    vertices = None if settings["bind_to"] is None else select_vertices(mesh, **settings["bind_to"])
    return bind_markers(
        mesh,
        places,
        labels,
        kind=settings["bind"],
        vertices=vertices,
        largest_distance=settings["largest_distance"],
    )
