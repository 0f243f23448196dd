"""Scene: several named bodies in one simulator, each free, fixed, rigid or soft."""

from collections.abc import Iterator, Mapping
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ...io.errors import InputError, checks_types
from ..mesh.volume_mesh import Mesh, join
from ..stepping.inputs import Inputs
from .bodies import Body, BodyEnergy
from .coordinates import Coordinates

# Inputs with one value per vertex.
_FIELDS = ("external_force", "internal_force", "fixed_positions", "attached_mass")


class Scene(Body):
    """Bodies in one simulator, with their vertices concatenated.

    Names of parameters, inputs and memory variables are prefixed with the body's name, as in
    ``finger_tension``.

    Args:
        bodies: bodies by name.
        contact: contact of the bodies with one another and with themselves (`SurfaceContact`), or
            None.

    Raises:
        InputError: no body.
    """

    @checks_types
    def __init__(self, bodies: Mapping[str, Body], contact: BodyEnergy | None = None) -> None:
        if not bodies:
            raise InputError("a scene needs one or more bodies: give them by name.")
        object.__setattr__(self, "bodies", dict(bodies))
        object.__setattr__(self, "energies", ())
        object.__setattr__(self, "energy_points", ())
        object.__setattr__(self, "contact", contact)

    bodies: Mapping[str, Body]
    contact: BodyEnergy | None

    @override
    def __repr__(self) -> str:
        parts = [f"{name}: {body!r}" for name, body in self.bodies.items()]
        if self.contact is not None:
            parts.append(type(self.contact).__name__)
        return f"Scene({', '.join(parts)})"

    @cached_property
    def mesh(self) -> Mesh:
        """The joined mesh.

        Its regions are the bodies, and their regions under the names ``body_region``.

        Raises:
            MeshError: the bodies have different kinds of cells.
        """
        return join({name: body.mesh for name, body in self.bodies.items()})

    @property
    def members(self) -> Iterator[tuple[str, Body, int]]:
        """Name, body and index of the first vertex of each body."""
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
        return Coordinates.joined([body.coordinates for body in self.bodies.values()])

    @cached_property
    def attached_mass(self) -> NDArray[np.float64]:
        """(N,) mass of the attached weights [kg]."""
        return np.concatenate([body.attached_mass for body in self.bodies.values()])

    @override
    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> "Scene":
        return Scene(
            {name: body.moved(rotation, translation) for name, body in self.bodies.items()},
            self.contact,
        )

    def vertex_slice(self, name: str) -> slice:
        """Returns the range of a body's vertices in the scene, as in ``state.q[:,
        scene.vertex_slice("ball")]``.

        Raises:
            InputError: no body of that name.
        """
        for member, body, first in self.members:
            if member == name:
                return slice(first, first + body.n_vertices)
        raise InputError(f"Unknown body {name!r}. The scene has {', '.join(self.bodies)}.")

    def inputs(self, by_body: Mapping[str, Inputs]) -> Inputs:
        """Returns the inputs of the scene's simulator, from the inputs of its bodies by name.

        Bodies without forces or attached masses get zeros.

        Raises:
            InputError: no body of that name, or fixed positions of some bodies with fixed vertices
                but not of all.
        """
        for name in by_body:
            self.vertex_slice(name)
        fields: dict[str, torch.Tensor | ArrayLike] = {}
        for key in _FIELDS:
            tensors_of = {
                name: value
                for name, inputs in by_body.items()
                if (value := inputs.fields.get(key)) is not None
            }
            if not tensors_of:
                continue
            axis = -1 if key == "attached_mass" else -2
            tensors = [
                value for name, value in tensors_of.items() if key not in by_body[name].plain
            ]
            sample = (tensors or [*tensors_of.values()])[0]
            tensors_of = {name: value.to(sample) for name, value in tensors_of.items()}
            for name, body in self.bodies.items():
                if name in tensors_of:
                    continue
                size = len(body.fixed_vertices) if key == "fixed_positions" else body.n_vertices
                if key == "fixed_positions" and size:
                    raise InputError(
                        f"fixed_positions of {name} are missing: "
                        "give those of every body that has any."
                    )
                shape = [*sample.shape]
                shape[axis] = size
                tensors_of[name] = sample.new_zeros(shape)
            whole = torch.cat([tensors_of[name] for name in self.bodies], axis)
            fields[key] = whole if tensors else whole.numpy()
        named = {
            f"{name}_{key}": value
            for name, inputs in by_body.items()
            for key, value in inputs.actuation.items()
        }
        out = Inputs(**named)
        out.plain |= {
            f"{name}_{key}"
            for name, inputs in by_body.items()
            for key in inputs.plain & inputs.actuation.keys()
        }
        return out.replace(**fields)
