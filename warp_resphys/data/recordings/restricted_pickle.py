"""Arrays out of a pickle, with nothing in it that can run, and within bounds of memory and time.

Some published data come as pickled dictionaries of NumPy arrays. A pickle is a program: it names functions and classes,
and has them called. Here its operations are read one by one, at most `MOST_OPERATIONS`, by a machine that knows plain
values and containers. The few names that NumPy's arrays need lead to stand-ins of this module, every other name is
refused, and the arrays are built from the stand-ins' numbers afterwards, at most `MOST_BYTES` of them. No operation
takes longer or makes more than its own bytes in the file do, however deeply values lie in each other: containers are no
keys, so nothing is hashed or compared through them, and the memo is a dictionary, so its numbers claim no memory.
"""

import io
import os
import pickletools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from ...io.errors import DataFileError

MOST_OPERATIONS = 1_000_000  # about a second
MOST_BYTES = 1 << 30  # of the file, of the texts that it encodes, and of its arrays
_NUMBERS = "biuf"
_LONGEST_HEADER = 10_000
_LONGEST_KEY = 1000
_FAULTS = (ArithmeticError, LookupError, MemoryError, TypeError, ValueError)
_VALUE = re.compile(r"(SHORT_)?(BIN)?(INT|LONG|FLOAT|STRING|UNICODE|BYTES|BYTEARRAY)\d?")
_PLAIN = {operation.name for operation in pickletools.opcodes if _VALUE.fullmatch(operation.name)}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


class _Type:
    """Stands for a dtype: kind and size, such as f8, and the byte order."""

    __slots__ = ("code", "order")

    def __init__(self, code: str) -> None:
        self.code = code
        self.order = ""

    def set_state(self, state: tuple[Any, ...]) -> None:
        if state[1] in ("<", ">"):
            self.order = state[1]

    def numbers(self) -> np.dtype[Any]:
        """The type of numbers that this stands for."""
        if self.code[:1] not in _NUMBERS or not self.code[1:].isdigit():
            raise TypeError(f"an array of type {self.code[:9]!r}")
        return np.dtype(self.order + self.code)


class _Array:
    """Stands for an array: what its state said, not yet believed."""

    __slots__ = ("data", "fortran", "shape", "type")

    def __init__(self) -> None:
        self.data: Any = b""
        self.fortran = False
        self.shape: Any = (0,)
        self.type: Any = None

    def set_state(self, state: tuple[Any, ...]) -> None:
        _, self.shape, self.type, self.fortran, self.data = state

    def numbers(self, most: int) -> NDArray[np.float64]:
        """The array of numbers that this stands for, of so many bytes at most."""
        if not isinstance(self.data, bytes | bytearray) or not isinstance(self.type, _Type):
            raise TypeError("an array that does not hold numbers")
        flat = np.frombuffer(self.data, dtype=self.type.numbers())
        if 8 * flat.size > most:
            raise ValueError(f"its arrays take more than {MOST_BYTES >> 20} MiB")
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


def _reconstruct(*_: Any) -> _Array:
    return _Array()


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any = "C") -> _Array:
    array = _Array()
    array.set_state((1, shape, kind, order == "F", data))
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
    return str.encode(text, "latin1")  # A TypeError for what is no text.


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


def _is_key(value: Any) -> bool:
    """Whether it takes no time to look it up in a dictionary."""
    if isinstance(value, str | bytes):
        return len(value) <= _LONGEST_KEY
    return isinstance(value, int) and value.bit_length() < 64


def _found(module: Any, name: Any) -> Callable[..., Any]:
    """The stand-in of this name."""
    if not isinstance(module, str) or not isinstance(name, str):
        raise TypeError("it names a function by what is no text")
    if (module, name) not in _ALLOWED:
        raise _RefusedError(f"{module}.{name}")
    return _ALLOWED[module, name]


class _Machine:
    """Runs the operations of a pickle on a stack; `pickletools` says what each of them does."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.encoded = 0  # bytes

    def run(self, content: BinaryIO) -> Any:
        """What a pickle makes.

        Raises:
            _RefusedError: It names something that it may not.
            Exception: One of _FAULTS: it is damaged, or does what no pickle of plain arrays does.
        """
        argument: Any
        for count, (operation, argument, _) in enumerate(pickletools.genops(content)):
            name = operation.name
            if count == MOST_OPERATIONS:
                raise ValueError(f"it has more than {MOST_OPERATIONS} operations")
            if name in _PLAIN:
                self.stack.append(argument)
            elif name in _CONSTANTS:
                self.stack.append(_CONSTANTS[name])
            elif name.endswith("GET"):
                self.stack.append(self.memo[argument])
            elif name.endswith("PUT") or name == "MEMOIZE":
                self.memo[len(self.memo) if argument is None else argument] = self.stack[-1]
            elif name not in ("PROTO", "FRAME", "STOP"):
                self.change(name, argument)
        return self.stack.pop()

    def change(self, name: str, argument: Any) -> None:
        """Runs an operation that is not about a plain value or the memo."""
        stack = self.stack
        match name:
            case "MARK":
                self.marks.append(len(stack))
            case "POP_MARK":
                self.popped()
            case "POP":
                stack.pop()
            case "DUP":
                stack.append(stack[-1])
            case "TUPLE":
                stack.append(tuple(self.popped()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(self.popped(int(name[-1]))))
            case "LIST" | "EMPTY_LIST":
                stack.append(self.popped() if name == "LIST" else [])
            case "DICT" | "EMPTY_DICT":
                items = self.popped() if name == "DICT" else []
                stack.append({})
                self.set_items(items)
            case "APPEND" | "APPENDS":
                items = self.popped(1 if name == "APPEND" else None)
                if not isinstance(stack[-1], list):
                    raise TypeError("it appends to what is no list")
                stack[-1].extend(items)
            case "SETITEM" | "SETITEMS":
                self.set_items(self.popped(2 if name == "SETITEM" else None))
            case "GLOBAL" | "STACK_GLOBAL":
                stack.append(_found(*(argument.split(" ", 1) if name == "GLOBAL" else self.popped(2))))
            case "REDUCE":
                function, arguments = self.popped(2)
                if not callable(function) or not isinstance(arguments, tuple):
                    raise TypeError("it calls what is no function")
                stack.append(function(*arguments))
                self.encoded += len(stack[-1]) if isinstance(stack[-1], bytes) else 0
                if self.encoded > MOST_BYTES:
                    raise ValueError(f"its texts take more than {MOST_BYTES >> 20} MiB")
            case "BUILD":
                (state,) = self.popped(1)
                if not isinstance(stack[-1], _Type | _Array):
                    raise TypeError("it gives a state to what has none")
                stack[-1].set_state(state)
            case _:
                raise ValueError(f"it has the operation {name}")

    def popped(self, count: int | None = None) -> list[Any]:
        """Takes so many values from the stack, or those above the last mark."""
        if count is not None and count > len(self.stack):
            raise LookupError("its stack is empty")
        at = self.marks.pop() if count is None else len(self.stack) - count
        values = self.stack[at:]
        del self.stack[at:]
        return values

    def set_items(self, items: list[Any]) -> None:
        """Puts keys and values in turn into the dictionary on top of the stack."""
        if not isinstance(self.stack[-1], dict) or not all(map(_is_key, items[::2])):
            raise TypeError("it has keys that are neither short texts nor whole numbers, or no dictionary for them")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))


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
            if os.fstat(file.fileno()).st_size > MOST_BYTES:
                raise ValueError(f"it has more than {MOST_BYTES >> 20} MiB")
            content = _Machine().run(io.BytesIO(file.read()))  # which makes no room for bytes that are not there
        content = content.item() if isinstance(content, _Array) else content
        if not isinstance(content, dict):
            raise DataFileError(f"{path} holds no dictionary of arrays: check the path.")
        arrays, left = {}, MOST_BYTES
        for key, value in content.items():
            if isinstance(value, _Array):
                arrays[str(key)] = value.numbers(left)
                left -= arrays[str(key)].nbytes
        return arrays
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path.") from error
    except _RefusedError as error:
        raise DataFileError(
            f"{path} is refused: it would construct '{error}', and only NumPy arrays, numbers, text, lists, "
            "tuples and dictionaries may be in it; do not open it with anything else either."
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
