"""Readable signatures in the API reference.

Type aliases keep their short names, factories of default values are written as calls, and the
comments beside the fields of a dataclass describe its parameters. In every module, the public names
of the package come first.
"""

import ast
import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sphinx.application import Sphinx
from sphinx.domains.python import PyAttribute, PyProperty
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.typing import stringify_annotation

_DTYPES = (Any, np.float64, np.float32, np.int64, np.int32, np.uint8, np.bool_, np.complex128)
_ALIASES = {
    NDArray[dtype]: f"NDArray[{getattr(dtype, '__name__', dtype)}]" for dtype in _DTYPES
} | {ArrayLike: "ArrayLike"}
_SHORT = {
    stringify_annotation(alias, mode): short
    for alias, short in _ALIASES.items()
    for mode in ("smart", "fully-qualified", "fully-qualified-except-typing")
}
_QUALIFIED = re.compile(r"~?\b(?:[a-z_]\w*\.)+(?=[A-Z])|~")
_PRIVATE = re.compile(r"\._[\w.]*\.(?=\w)")
_FUNCTION = re.compile(r"<function .+?>+(?=[,)=]|$)")


def shorten(text: str) -> str:
    """Returns annotations with the names of type aliases and and without the modules of classes."""
    for long, short in _SHORT.items():
        text = text.replace(long, short)
    return _FUNCTION.sub("...", _QUALIFIED.sub("", _PRIVATE.sub(".", text)))


def readable(
    _app: Sphinx, what: str, _name: str, described: Any, _options: Any, parameters: Any, result: Any
) -> Any:
    """Returns the parameters and the result of a signature, shortened.

    Default factories become calls.
    """
    if parameters is None:
        return None
    if what == "class" and parameters == "(*args, **kwargs)":  # of a protocol
        return "", result
    if dataclasses.is_dataclass(described):
        for field in dataclasses.fields(described):
            if field.init and field.default_factory is not dataclasses.MISSING:
                factory = getattr(field.default_factory, "__name__", "<lambda>")
                call = {"dict": "{}", "list": "[]", "tuple": "()", "<lambda>": "..."}.get(
                    factory, f"{factory}()"
                )
                parameters = parameters.replace("<factory>", call, 1)
    return shorten(parameters), result and shorten(result)


def describe_fields(
    _app: Sphinx, what: str, _name: str, described: Any, _options: Any, lines: list[str]
) -> None:
    """Adds the comments beside the fields of a class to its docstring,
    as descriptions of its parameters.
    """
    if what != "class" or not (
        dataclasses.is_dataclass(described) or hasattr(described, "_fields")
    ):
        return
    named = set(
        re.findall(
            r":(?:param|ivar|vartype|attr)\s+(\w+):|\.\. attribute:: (\w+)", "\n".join(lines)
        )
    )
    known = {name for names in named for name in names}
    comments = field_comments(inspect.getsource(described))
    lines += [
        "",
        *(f":param {name}: {text}" for name, text in comments.items() if name not in known),
    ]


def field_comments(source: str) -> dict[str, str]:
    """Returns the comments of the fields of a class by name:
    those beside them, or directly above.
    """
    source = inspect.cleandoc("\n" + source)
    lines = source.splitlines()
    comments = {}
    for field in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if (
            not isinstance(field, ast.AnnAssign)
            or not isinstance(field.target, ast.Name)
            or field.end_lineno is None
        ):
            continue
        beside = lines[field.end_lineno - 1].encode()[field.end_col_offset :].decode().strip()
        above: list[str] = []
        for line in reversed(lines[: field.lineno - 1]):
            if not line.strip().startswith("#"):
                break
            above.insert(0, line.strip().removeprefix("#").strip())
        text = " ".join(
            [*above, beside.removeprefix("#").strip()] if beside.startswith("#") else above
        ).strip()
        if text and not field.target.id.startswith("_"):
            comments[field.target.id] = re.sub(r"_(?!\w)", r"\_", text) if "`" not in text else text
    return comments


def hide_numbered_fields(
    _app: Sphinx, _what: str, _name: str, described: Any, skip: bool, _options: Any
) -> bool | None:
    """Leaves out the fields of named tuples: the signature and the parameters have them."""
    return (
        True
        if str(getattr(described, "__doc__", "")).startswith("Alias for field number")
        else None
    )


def public_first(app: Sphinx) -> None:
    """Puts the public names of a module before its other names, in the order of the index."""
    index = Path(app.srcdir, "api", "index.md").read_text(encoding="utf-8")
    names = re.findall(r"<(warp_resphys\.[\w.]+)\.(\w+)>`", index)
    for place, (module, name) in enumerate(names):
        analyzer = ModuleAnalyzer.for_module(module)
        analyzer.analyze()
        if name in analyzer.tagorder:
            analyzer.tagorder[name] = place - len(names)


class ShortProperty(PyProperty):
    """A property whose type is shortened."""

    def handle_signature(self, sig: str, signode: Any) -> tuple[str, str]:
        if "type" in self.options:
            self.options["type"] = shorten(self.options["type"])
        return super().handle_signature(sig, signode)


class ShortAttribute(PyAttribute):
    """An attribute whose type is shortened, without values
    that are no literals, such as modules.
    """

    def handle_signature(self, sig: str, signode: Any) -> tuple[str, str]:
        if self.options.get("value", "").startswith("<"):
            del self.options["value"]
        if "type" in self.options:
            self.options["type"] = shorten(self.options["type"])
        return super().handle_signature(sig, signode)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive_to_domain("py", "property", ShortProperty, override=True)
    app.add_directive_to_domain("py", "attribute", ShortAttribute, override=True)
    app.connect("builder-inited", public_first)
    app.connect("autodoc-process-signature", readable)
    app.connect("autodoc-process-docstring", describe_fields, priority=590)  # after Napoleon
    app.connect("autodoc-skip-member", hide_numbered_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
