"""Several bodies in one simulator: free, fixed, rigid or soft, each with its name."""

from collections.abc import Iterator, Mapping
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from ..io.errors import InputError
from ..mesh.mesh import Mesh, join
from ..stepping.inputs import Inputs
from .body import Body
from .coordinates import Coordinates

_FIELDS = ("external_force", "fixed_positions", "attached_mass")  # of inputs, by vertex


class Scene(Body):
    """Bodies side by side; the vertices of each follow those of the one before.

    In the simulator the names of a body's parameters, inputs and memory begin with its name and an underscore, as in
    ``finger_tension``. Bodies do not touch each other.

    Args:
        bodies: by name.

    Raises:
        InputError: there is no body.
    """

    def __init__(self, bodies: Mapping[str, Body]) -> None:
        if not bodies:
            raise InputError("a scene needs one or more bodies: give them by name.")
        object.__setattr__(self, "bodies", dict(bodies))
        object.__setattr__(self, "energies", ())
        object.__setattr__(self, "energy_points", ())

    bodies: Mapping[str, Body]

    @cached_property
    def mesh(self) -> Mesh:
        """The meshes of all bodies as one, whose regions are the bodies and, by ``body_region``, their regions.

        Raises:
            MeshError: the bodies have different kinds of cells.
        """
        return join({name: body.mesh for name, body in self.bodies.items()})

    @property
    def members(self) -> Iterator[tuple[str, Body, int]]:
        """Name, body and number of the first vertex of each body."""
        first = 0
        for name, body in self.bodies.items():
            yield name, body, first
            first += body.n_vertices

    @cached_property
    def vertices(self) -> NDArray[np.float64]:
        """(N, 3) rest positions of all bodies [m]."""
        return np.concatenate([body.vertices for body in self.bodies.values()])

    @property
    def n_vertices(self) -> int:
        """Number of vertices N of all bodies."""
        return sum(body.n_vertices for body in self.bodies.values())

    @cached_property
    def fixed_vertices(self) -> NDArray[np.int64]:
        """(D,) vertices with prescribed positions, in ascending order."""
        return np.concatenate([body.fixed_vertices + first for _, body, first in self.members])

    @cached_property
    def coordinates(self) -> Coordinates:
        """Vertices as weighted sums of control vertices."""
        maps = [(body.coordinates, first) for _, body, first in self.members]
        dependent = np.concatenate([own.dependent + first for own, first in maps])
        weights = scipy.sparse.block_diag([own.weights for own, _ in maps], format="csr")
        return Coordinates(self.n_vertices, dependent, scipy.sparse.csr_array(weights))

    @cached_property
    def attached_mass(self) -> NDArray[np.float64]:
        """(N,) mass of the attached weights [kg]."""
        return np.concatenate([body.attached_mass for body in self.bodies.values()])

    def place(self, name: str) -> slice:
        """Returns where the vertices of a body lie among those of the scene: ``state.q[:, scene.place("ball")]``.

        Raises:
            InputError: no body of that name.
        """
        for known, body, first in self.members:
            if known == name:
                return slice(first, first + body.n_vertices)
        raise InputError(f"Unknown body {name!r}. The scene has {', '.join(self.bodies)}.")

    def inputs(self, of: Mapping[str, Inputs]) -> Inputs:
        """Returns the inputs of a simulator of the scene from those of its bodies by name.

        Forces and attached masses of bodies without any are zero.

        Raises:
            InputError: no body of that name, or fixed positions of some bodies that have fixed vertices but not of all.
        """
        for name in of:
            self.place(name)
        fields: dict[str, torch.Tensor] = {}
        for name, own in of.items():
            fields |= {f"{name}_{key}": value for key, value in own.actuation.items()}
        for key in _FIELDS:
            given = {name: value for name, own in of.items() if (value := own.fields.get(key)) is not None}
            if not given:
                continue
            axis = -1 if key == "attached_mass" else -2
            sample = next(iter(given.values()))
            parts = []
            for name, body in self.bodies.items():
                if name in given:
                    parts.append(given[name])
                    continue
                size = len(body.fixed_vertices) if key == "fixed_positions" else body.n_vertices
                if key == "fixed_positions" and size:
                    raise InputError(f"fixed_positions of {name} are missing: give those of every body that has any.")
                shape = list(sample.shape)
                shape[axis] = size
                parts.append(sample.new_zeros(shape))
            fields[key] = torch.cat(parts, axis)
        return Inputs(**fields)
