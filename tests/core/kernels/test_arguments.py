"""The order and the names of kernels' arguments: constants, in, out.

What a kernel writes ends in `_out`.
"""

import ast
import functools
import importlib
import inspect
import pkgutil
import re
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

import warp_resphys.kernels
from warp_resphys.kernels.axial import MUSCLE
from warp_resphys.kernels.elasticity import solid_kernels
from warp_resphys.kernels.hessian_blocks import pair_kernel, projection_kernel, scatter_kernel
from warp_resphys.kernels.lanes import cell_step, cell_tangent
from warp_resphys.kernels.laws import point_kernels
from warp_resphys.kernels.lbfgs import lbfgs_kernels
from warp_resphys.kernels.line_search import accept_kernel
from warp_resphys.kernels.materials import corotated
from warp_resphys.kernels.points import set_kernels
from warp_resphys.kernels.tiled_cholesky import tiled_kernels

wp.set_module_options({"enable_backward": False})
FOLDER = Path(warp_resphys.kernels.__file__).parent


@functools.cache
def kernels():
    """One of every kernel of the package, by file and name."""
    names = [info.name for info in pkgutil.walk_packages([str(FOLDER)], "warp_resphys.kernels.")]
    made = [*map(importlib.import_module, names), point_kernels(MUSCLE), *map(set_kernels, (1, 3))]
    made += [make(wp.float64) for make in (lbfgs_kernels, tiled_kernels)]
    made += [solid_kernels(corotated.LAW)]
    found = [
        kernel
        for holder in made
        for kernel in vars(holder).values()
        if isinstance(kernel, wp.Kernel)
    ]
    found += [make(wp.float64) for make in (accept_kernel, projection_kernel, scatter_kernel)] + [
        pair_kernel(3)
    ]
    found += [make(corotated.LAW) for make in (cell_step, cell_tangent)]
    return {
        (Path(inspect.getsourcefile(kernel.func)).name, kernel.func.__name__): kernel
        for kernel in found
    }


def definition(function):
    """The syntax tree of a function, and the values of the names in it."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return tree, {**function.__globals__, **{name: cell.cell_contents for name, cell in cells}}


def is_array(kind):
    return hasattr(kind, "ndim")


class Reader(ast.NodeVisitor):
    """Finds which arguments of a function it writes:
    arrays, also those of structs and rows that have a name.
    """

    def __init__(self, types, names):
        self.places = {name: (name, kind) for name, kind in types.items()}
        self.names, self.written = names, set()

    def place(self, node):
        """The argument that an expression is a part of,
        its type, and whether it is an entry of an array.
        """
        if isinstance(node, ast.Name):
            return (*self.places.get(node.id, (None, None)), False)
        if not isinstance(node, ast.Attribute | ast.Subscript):
            return None, None, False
        root, kind, entry = self.place(node.value)
        if isinstance(node, ast.Attribute):
            return root, kind.vars[node.attr].type if hasattr(kind, "vars") else None, entry
        if not is_array(kind):
            return root, None, entry
        left = kind.ndim - (len(node.slice.elts) if isinstance(node.slice, ast.Tuple) else 1)
        return root, SimpleNamespace(ndim=left, dtype=kind.dtype) if left else kind.dtype, not left

    def visit_Assign(self, node):
        (target,) = node.targets
        several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
        for name, value in (
            zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]
        ):
            self.store(name)
            root, kind, _ = self.place(value)
            if isinstance(name, ast.Name) and is_array(kind):
                self.places[name.id] = root, kind
        self.generic_visit(node)

    def visit_AugAssign(self, node):
        self.store(node.target)
        self.generic_visit(node)

    def store(self, target):
        root, _, entry = self.place(target)
        if entry and root:
            self.written.add(root)

    def visit_Call(self, node):
        self.generic_visit(node)
        text = ast.unparse(node.func)
        if "atomic" in text:
            self.written.add(self.place(node.args[0])[0])
        if text.startswith("wp.") or text.endswith(".dtype"):
            # Such as wp.grad(energy)(f, v), or a conversion.
            return
        called = eval(text, dict(self.names))
        if isinstance(called, wp.Function) and not called.is_builtin():
            arguments = {
                n: self.place(value) for n, value in zip(called.input_types, node.args, strict=True)
            }
            types = {name: kind for name, (_, kind, _) in arguments.items()}
            self.written |= {arguments[name][0] for name in written_by(called, types)}


def writes(statement, name):
    """Whether a statement of C++ assigns to an array,
    or gives a name to its memory that is not constant.
    """
    target, _, value = re.sub(r"[=!<>]=", "", statement).partition("=")
    named = value.strip() == f"{name}.data" and "const S*" not in target
    return named or (bool(value) and f"{name}.data[" in target)


def written_by(function, types=None):
    """Names of arguments that a kernel, or a Warp function of arguments of some types, writes."""
    if code := getattr(function, "native_snippet", None):
        return {
            name
            for name in function.input_types
            if any(writes(part, name) for part in re.split("[;{}]", code))
        }
    tree, names = definition(function.func)
    declared = {arg.label: arg.type for arg in function.adj.args}
    reader = Reader(
        {name: types[name] if kind is Any else kind for name, kind in declared.items()}, names
    )
    for _ in range(2):  # A row may have its name in a loop.
        for statement in tree.body:
            reader.visit(statement)
    return reader.written - {None}


def test_every_kernel_of_the_folder_is_read():
    decorated = set()
    for path in FOLDER.rglob("*.py"):
        functions = [
            n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)
        ]
        marked = [
            n
            for n in functions
            if any("wp.kernel" in ast.unparse(mark) for mark in n.decorator_list)
        ]
        decorated |= {(path.name, n.name) for n in marked}
    assert decorated == set(kernels())
    assert len(decorated) > 60


@wp.func
def count(sums: Any, b: int):
    sums[b, 0] += 1


@wp.kernel
def example(
    named: wp.array2d[float],
    added: wp.array[int],
    through: wp.array2d[int],
    only_read: wp.array[wp.vec3],
    x: wp.vec3,
):
    i = wp.tid()
    row = named[i]
    copied = only_read[i]
    copied[0] = 1.0
    x[1] = copied[0]
    row[0] = x[0]
    wp.atomic_add(added, 0, 1)
    count(through, i)


def test_what_a_kernel_writes_is_found():
    assert written_by(example) == {"named", "added", "through"}


@pytest.mark.parametrize("name", sorted(kernels()), ids="/".join)
def test_outputs_come_last_and_end_in_out(name):
    arguments = [arg.label for arg in kernels()[name].adj.args]
    written = written_by(kernels()[name])
    assert {argument for argument in arguments if argument.endswith("_out")} == written
    assert set(arguments[len(arguments) - len(written) :]) == written


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Warp compiles for CUDA on Linux")
def test_every_module_compiles_for_a_gpu(tmp_path):
    """Without one, a module of each file; lanes are those of a CPU."""
    modules = {file: kernel.module for (file, _), kernel in kernels().items() if file != "lanes.py"}
    for module in {*modules.values()}:
        wp.compile_aot_module(module, arch=80, module_dir=tmp_path)
    assert len(list(tmp_path.glob("*.cubin")) + list(tmp_path.glob("*.ptx"))) >= len(modules) > 15
