"""Objects as the arguments that make them: plain data,
with arrays beside it, in files that are safe to load.

A simulator of Python is a tree of frozen dataclasses, settings and named tuples, each of which is
known by its class and its fields. In plain data it is a mapping with ``_target_``, the class, in
Hydra's notation, and its fields; an array is ``{_array_: NAME}`` and a tensor ``{_tensor_: NAME}``,
a mapping a list of pairs ``{_items_: [[KEY, VALUE], ...]}``, and a sequence a list. A file may come
from anywhere: only classes of `_KINDS` are made, by their constructors, which check the fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.energies.base import Energy
from ..core.energies.convex_material import FibreFamily
from ..core.energies.materials import Material
from ..core.energies.muscles import Muscle
from ..core.fem.bodies import Body, Glue, PointMass
from ..core.fem.coordinates import SymmetryPlane
from ..core.fem.scene import Scene
from ..core.mesh.chambers import Chamber
from ..core.mesh.volume_mesh import Mesh
from ..data.markers import Observation
from ..io.classes import imported, package_of
from ..io.errors import DataFileError, InputError, in_short
from ..io.settings import Settings

_TARGET: Final = "_target_"
_ARRAY: Final = "_array_"
_TENSOR: Final = "_tensor_"
_ITEMS: Final = "_items_"
_KINDS: Final = (
    *(Simulator, Body, Mesh, Material, FibreFamily, Energy, Chamber, Muscle, Settings),
    *(Glue, PointMass, SymmetryPlane, Observation),
)
_PACKAGE: Final = __name__.partition(".")[0]
_NUMBERS: Final = "biuf"  # kinds of arrays that are saved


class Plain:
    """Objects as plain data, with the arrays and the versions of other packages that they need.

    Args:
        arrays: those that are known already, by name, such as those of a mesh.

    Attributes:
        tensors: all arrays by name.
        packages: versions of other packages whose classes the objects have, by name.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        self.tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        self.packages = dict[str, str]()
        self._names = {id(array): name for name, array in arrays.items()}
        self._kept = list[Any](arrays.values())  # so that no other object gets their identity

    def of(self, value: Any, where: str) -> Any:
        """Returns an object as plain data.

        Args:
            value: a number, a word, an array, an object of a known class, or a mapping or sequence
                of these.
            where: name of the object, for messages.

        Raises:
            InputError: something that cannot be saved, or that another program could not import.
        """
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, (np.ndarray, torch.Tensor)):
            return self._placed(value, where)
        if isinstance(value, Mapping):
            items = [
                [self.of(key, where), self.of(item, f"{where}[{key!r}]")]
                for key, item in value.items()
            ]
            return {_ITEMS: items}
        if isinstance(value, Sequence) and not hasattr(value, "_fields"):
            return [self.of(item, f"{where}[{number}]") for number, item in enumerate(value)]
        target = self._target(value, where)
        return {
            _TARGET: target,
            **{name: self.of(x, f"{where}.{name}") for name, x in _arguments(value).items()},
        }

    def _placed(self, value: Any, where: str) -> dict[str, str]:
        """Returns the reference to an array or a tensor, each of which is kept once."""
        kind = _TENSOR if isinstance(value, torch.Tensor) else _ARRAY
        array = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
        if array.dtype.kind not in _NUMBERS:
            raise InputError(
                f"{where} has {array.dtype} in an array, which cannot be saved: give numbers."
            )
        if id(value) not in self._names:
            name = f"{where}:{len(self.tensors)}"
            whole = array.astype(np.int64) if array.dtype.kind in "iu" else np.array(array)
            self.tensors[name] = torch.from_numpy(whole)
            self._names[id(value)] = name
            self._kept.append(value)
        return {kind: self._names[id(value)]}

    def _target(self, value: Any, where: str) -> str:
        """Returns module and name of an object's class,
        which has to be one that other programs can import.
        """
        made_of = type(value)
        target = f"{made_of.__module__}.{made_of.__qualname__}"
        if not isinstance(value, _KINDS) or isinstance(value, Scene) or not _has_arguments(value):
            raise InputError(
                f"{where} is {in_short(value)}, which cannot be saved: give numbers, arrays, "
                "materials and energies that are dataclasses, or settings."
            )
        if made_of.__module__ == "__main__" or "<locals>" in target:
            raise InputError(
                f"{where} is of the class {made_of.__qualname__}, which no other program can "
                "import: put the class into a module of its own, and import it from there."
            )
        if target.partition(".")[0] != _PACKAGE:
            self.packages |= package_of(target)
        return target


def _has_arguments(value: Any) -> bool:
    return is_dataclass(value) or isinstance(value, Settings) or hasattr(value, "_fields")


def _arguments(value: Any) -> dict[str, Any]:
    """Returns the arguments that make an object of a known class."""
    if isinstance(value, Settings):
        return dict(value)
    if isinstance(value, Simulator):
        known = {
            name: getattr(value, name) for name in ("body", "material", "time_step", "integrator")
        }
        gravity = np.asarray(value.gravity, dtype=np.float64).tolist()
        return {
            **known,
            "gravity": gravity,
            "solver": value.settings,
            "dtype": str(value.dtype).removeprefix("torch."),
        }
    if is_dataclass(value):
        return {item.name: getattr(value, item.name) for item in fields(value) if item.init}
    return dict(value._asdict())


def made(plain: Any, tensors: Mapping[str, torch.Tensor], path: Path) -> Any:
    """Returns the object of `Plain.of`.

    Args:
        plain: the data.
        tensors: arrays by name.
        path: of the file, for messages.

    Raises:
        DataFileError: a class that cannot be imported or is none of the known ones, or fields that
            do not fit it.
    """
    if isinstance(plain, list):
        return tuple(made(item, tensors, path) for item in plain)
    if not isinstance(plain, dict):
        return plain
    try:
        if _ARRAY in plain:
            return tensors[plain[_ARRAY]].numpy()
        if _TENSOR in plain:
            return tensors[plain[_TENSOR]]
        if _ITEMS in plain:
            return {
                made(key, tensors, path): made(item, tensors, path) for key, item in plain[_ITEMS]
            }
        target = imported(plain[_TARGET], _KINDS)
        arguments = {
            name: made(item, tensors, path) for name, item in plain.items() if name != _TARGET
        }
        if target is Simulator:
            arguments["dtype"] = {"float64": torch.float64, "float32": torch.float32}[
                arguments["dtype"]
            ]
        return target(**arguments)
    except (InputError, KeyError, TypeError, ValueError) as error:
        raise DataFileError(f"{path}: an object in it cannot be made: {error}") from error
