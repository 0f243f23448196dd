"""The table in CONTRIBUTING.md says where every module is.

Imports point up it, and never in a circle.
"""

import ast
import functools
import importlib
import importlib.util
import re
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from warp_resphys.io.errors import ResphysWarning
from warp_resphys.moved import MOVED

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "warp_resphys"
KERNELS = REPOSITORY / "kernels"


@functools.cache
def rows():
    """Row of each place in the table: `cli` for a module, `io/` for a folder."""
    text = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    text = text[text.index("## Where things are") : text.index("## Six nouns")]
    cells = re.findall(r"^\| ((?:`[\w/]+`(?:, )?)+) \|", text, flags=re.MULTILINE)
    places = [
        (place, row)
        for row, cell in enumerate(cells)
        for place in re.findall(r"`([a-z_/]+)`", cell)
    ]
    assert len({place for place, _ in places}) == len(places)
    return dict(places)


def place_of(name):
    """Where a module inside the package belongs: "io.text" to `io/`, "cli" to `cli`.

    The folders of the core have a place each: "core.fem.bodies" belongs to `core/fem/`.
    """
    first, _, rest = name.partition(".")
    folder = rest.partition(".")[0]
    if first == "core" and (PACKAGE / first / folder).is_dir() and folder:
        return f"{first}/{folder}/"
    is_folder = (PACKAGE / first).is_dir() or first in ("kernels", "conf", "scripts")
    return f"{first}/" if is_folder else first


@functools.cache
def modules():
    """Files and dotted names below the package of all modules but its own, of names."""
    found = {}
    for folder, prefix in (
        (PACKAGE, ()),
        (KERNELS, ("kernels",)),
        (REPOSITORY / "scripts", ("scripts",)),
    ):
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            if prefix or parts:
                found[path] = ".".join((*prefix, *parts))
    return found


@functools.cache
def parsed(path):
    """The tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imported(path):
    """Names below the package that a file imports from, and whether on its own import."""
    tree = parsed(path)
    package = ("warp_resphys", *modules()[path].split("."))
    package = package if path.name == "__init__.py" else package[:-1]
    known, found = set(modules().values()), []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            names = [
                ".".join([*base, *([node.module] if node.module else []), alias.name])
                for alias in node.names
            ]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            if name.startswith("warp_resphys."):
                name = name.removeprefix("warp_resphys.")
                found.append(
                    (name if name in known else name.rpartition(".")[0], node in tree.body)
                )
    return found


def test_every_module_has_its_place_and_every_place_a_module():
    places = {place_of(name) for name in modules().values()}
    assert {*places, "conf/"} == {place for place in rows() if place != "tests/"}


def test_no_two_modules_have_one_name():
    names = Counter(path.name for path in modules())
    assert {name for name, count in names.items() if count > 1} <= {"__init__.py", "base.py"}


def test_imports_point_up():
    row, down = rows(), {}
    for path, name in modules().items():
        own = row[place_of(name)]
        lower = {other for other, _ in imported(path) if other and row[place_of(other)] > own}
        if lower:
            down[name] = lower
    assert down == {}


def test_the_core_stands_alone():
    """Some of its tests, with all that stands on it hidden."""
    arguments = ["-p", "support.core_alone", "--confcutdir=tests/core", "-p", "no:cacheprovider"]
    tests = ["tests/core/fem", "tests/core/dynamics/test_tape.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", *arguments, *tests]
    ended = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout[-3000:]


def test_no_two_modules_import_each_other():
    graph = {
        name: {other for other, _ in imported(path) if other != name}
        for path, name in modules().items()
    }
    TopologicalSorter(graph).prepare()  # Raises a CycleError that names the circle.


def named_in_the_table_of_the_paper():
    text = (
        (REPOSITORY / "CONTRIBUTING.md")
        .read_text(encoding="utf-8")
        .partition("## Where the paper is")[2]
    )
    return re.findall(r"`((?:[a-z_]+\.)+\w+(?:\.\w+)?)`", text.partition("\n## ")[0])


@pytest.mark.parametrize("name", named_in_the_table_of_the_paper())
def test_what_the_table_of_the_paper_names_is_there(name):
    module, *attributes = re.fullmatch(r"((?:[a-z_]+\.)*[a-z_]+)\.(.+)", name).groups()
    place = importlib.import_module("warp_resphys." + module)
    for attribute in attributes[0].split("."):
        place = getattr(place, attribute)
    assert place.__doc__


def test_one_name_is_one_class():
    trees = [parsed(path) for path in (*PACKAGE.rglob("*.py"), *KERNELS.rglob("*.py"))]
    names = Counter(
        node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)
    )
    twice = {name for name, count in names.items() if count > 1 and not name.startswith("_")}
    assert twice == set()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("energies.contact.obstacles", "core.energies.contact.obstacles"),
        ("stepping", "core.stepping"),
        ("settings.silicones", "core.energies.silicones"),
    ],
)
def test_a_module_that_has_moved_is_one_under_both_names(old, new, monkeypatch):
    """Also below a package; the warning has the new name and the end of the old one."""
    for name in [name for name in sys.modules if name.startswith(f"warp_resphys.{old}")]:
        monkeypatch.delitem(sys.modules, name)
    wanted = importlib.import_module(f"warp_resphys.{new}")
    spec = wanted.__spec__
    with pytest.warns(
        ResphysWarning, match=rf"warp_resphys\.{re.escape(old)} is now .*{new}: .*0\.3"
    ):
        assert importlib.import_module(f"warp_resphys.{old}") is wanted
    assert wanted.__spec__ is spec
    assert wanted.__name__ == f"warp_resphys.{new}"


def test_every_module_that_has_moved_is_where_its_old_name_leads():
    for after in MOVED.values():
        assert importlib.util.find_spec(f"warp_resphys.{after}") is not None
