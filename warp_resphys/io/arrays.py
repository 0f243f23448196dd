"""Types of NumPy's arrays, and short representations of objects that have arrays."""

import reprlib
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Brief:
    """Base of dataclasses whose `repr` has shapes in place of arrays,
    the first of long rows, and no empty fields.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Gives a class its representation before `dataclass` does, unless it has one."""
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = _brief  # type: ignore[method-assign]


def _brief(self: Any) -> str:
    """Returns the name of a dataclass and its fields."""
    given = {item.name: getattr(self, item.name) for item in fields(self)}
    shown = (
        f"{name}={_SHAPES.repr(x)}"
        for name, x in given.items()
        if hasattr(x, "shape") or x not in (None, (), {})
    )
    return f"{type(self).__name__}({', '.join(shown)})"


class _Shapes(reprlib.Repr):
    """Representations with shapes in place of arrays."""

    @override
    def repr1(self, x: Any, level: int) -> str:
        shape = getattr(x, "shape", None)
        if shape is None:
            return super().repr1(x, level)
        return f"array {tuple(shape)}" if len(shape) else super().repr1(x.item(), level)

    @override
    def repr_instance(self, x: Any, level: int) -> str:
        return type(x).__name__ if callable(x) and not is_dataclass(x) else repr(x)

    def repr_float(self, x: float, level: int) -> str:
        return f"{x:.6g}"


_SHAPES = _Shapes()
