"""Arrays out of a pickle, with nothing in it that can run.

Some published data come as pickled dictionaries of NumPy arrays. A pickle is a program: it names functions and classes,
and has them called. Here the few names that NumPy's arrays need lead to stand-ins of this module, every other name is
refused, and the arrays are built from the stand-ins' numbers afterwards. Neither NumPy's own unpickling nor any other
callable is reached.
"""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from ...io.errors import DataFileError

_NUMBERS = "biuf"
_LONGEST_HEADER = 10_000
_FAULTS = (
    pickle.UnpicklingError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)


class _Type:
    """Stands for a dtype: kind and size, such as f8, and the byte order."""

    __slots__ = ("code", "order")

    def __init__(self, code: str) -> None:
        self.code = code
        self.order = ""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in ("<", ">"):
            self.order = state[1]

    def numbers(self) -> np.dtype[Any]:
        """The type of numbers that this stands for."""
        if self.code[:1] not in _NUMBERS or not self.code[1:].isdigit():
            raise TypeError(f"an array of type {self.code!r}")
        return np.dtype(self.order + self.code)


class _Array:
    """Stands for an array: what its state said, not yet believed."""

    __slots__ = ("data", "fortran", "shape", "type")

    def __init__(self) -> None:
        self.data: Any = b""
        self.fortran = False
        self.shape: Any = (0,)
        self.type: Any = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, self.shape, self.type, self.fortran, self.data = state

    def numbers(self) -> NDArray[np.float64]:
        """The array of numbers that this stands for."""
        if not isinstance(self.data, bytes | bytearray) or not isinstance(self.type, _Type):
            raise TypeError("an array that does not hold numbers")
        flat = np.frombuffer(bytes(self.data), dtype=self.type.numbers())
        return flat.reshape(self.shape, order="F" if self.fortran else "C").astype(np.float64)

    def item(self) -> Any:
        """What an array of one object, which `numpy.save` makes of a dictionary, holds."""
        if (
            isinstance(self.type, _Type)
            and self.type.code[:1] == "O"
            and self.shape == ()
            and isinstance(self.data, list)
            and len(self.data) == 1
        ):
            return self.data[0]
        return self


class _Callable:
    """Calls a function; unlike the function itself, it has no attributes that a pickle could set."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)


def _reconstruct(*_: Any) -> _Array:
    return _Array()


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any = "C") -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", data))
    return array


def _scalar(kind: Any, data: Any = b"") -> _Array:
    return _from_buffer(data, kind, ())


def _type(code: Any, *_: Any) -> _Type:
    if not isinstance(code, str):
        raise TypeError("an array of an unknown type")
    return _Type(code)


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How protocols before the third write bytes."""
    if encoding != "latin1":
        raise ValueError(f"text in {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """How protocols before the third write no bytes."""
    return b""


_ALLOWED: Final[dict[tuple[str, str], Callable[..., Any]]] = {
    ("numpy", "dtype"): _type,
    ("numpy", "ndarray"): _reconstruct,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
    **{
        (f"numpy.{core}.{module}", name): stand_in
        for core in ("core", "_core")  # before and since NumPy 2
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}


class _RefusedError(Exception):
    """A pickle names something that it may not."""


class _Unpickler(pickle.Unpickler):
    @override
    def find_class(self, module_name: str, global_name: str) -> Any:
        allowed = _ALLOWED.get((module_name, global_name))
        if allowed is None:
            raise _RefusedError(f"{module_name}.{global_name}")
        return _Callable(allowed)


def read_pickled_arrays(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """Reads the arrays of a pickled dictionary, bare or within a .npy file, without running anything that is in it.

    Args:
        path: A pickle that holds NumPy arrays, numbers, text, lists, tuples and dictionaries, and nothing else.

    Returns:
        The numeric arrays of the outermost dictionary, by key.

    Raises:
        DataFileError: The file is missing, damaged, holds no such dictionary, or names anything but NumPy arrays.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            _skip_header(file, path)
            content = _Unpickler(file).load()
        content = content.item() if isinstance(content, _Array) else content
        if not isinstance(content, dict):
            raise DataFileError(f"{path} holds no dictionary of arrays: check the path.")
        return {str(key): value.numbers() for key, value in content.items() if isinstance(value, _Array)}
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path.") from error
    except _RefusedError as error:
        raise DataFileError(
            f"{path} is refused: it would construct '{error}', and only NumPy arrays, numbers, text, lists, tuples and "
            "dictionaries may be in it; do not open it with anything else either."
        ) from error
    except _FAULTS as error:
        raise DataFileError(f"{path} is damaged, or no pickle of plain arrays ({error}): fetch it again.") from error


def _skip_header(file: BinaryIO, path: Path) -> None:
    """Leaves the file where the pickle begins: after the header of a .npy file, or where it was.

    The header is a magic word, two bytes of version, its length in two bytes (version 1) or four, and a text.
    """
    magic = np.lib.format.MAGIC_PREFIX
    if file.read(len(magic)) != magic:
        file.seek(0)
        return
    version = file.read(2)
    length = int.from_bytes(file.read(2 if version[:1] == b"\x01" else 4), "little")
    if b"'|O'" not in file.read(min(length, _LONGEST_HEADER)):
        raise DataFileError(f"{path} holds no dictionary of arrays: check the path.")
