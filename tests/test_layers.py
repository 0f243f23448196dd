"""The table in CONTRIBUTING.md says where every module is; imports point up it."""

import ast
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "warp_resphys"


def rows():
    """Row of each place in the table: `solver` for a module, `tasks/` for a folder."""
    text = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| ((?:`[\w/]+`(?:, )?)+) \|", text, flags=re.MULTILINE)
    places = [(place, row) for row, cell in enumerate(cells) for place in re.findall(r"`([\w/]+)`", cell)]
    assert len({place for place, _ in places}) == len(places)
    return dict(places)


def place_of(name):
    """Where a module inside the package belongs: "tasks.train" to `tasks/`, "solver" to `solver`."""
    first = name.split(".")[0]
    return f"{first}/" if (PACKAGE / first).is_dir() or first in ("kernels", "conf") else first


def modules():
    """File and place of every module but the package's own file, which only hands out names."""
    ours = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    places = {path: place_of(path.relative_to(PACKAGE).with_suffix("").parts[0]) for path in ours}
    for folder in ("kernels", "scripts"):
        places |= dict.fromkeys((REPOSITORY / folder).glob("*.py"), f"{folder}/")
    return places


def imported(path):
    """Places that a file imports from, wherever in the file it does so."""
    package = path.relative_to(REPOSITORY).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            names = [".".join([*base, *([node.module] if node.module else []), alias.name]) for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        yield from (place_of(name.removeprefix("warp_resphys.")) for name in names if name.startswith("warp_resphys."))


def test_every_module_has_its_place_and_every_place_a_module():
    assert {*modules().values(), "conf/"} == set(rows())


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_imports_point_up(path):
    row = rows()
    own = row[modules()[path]]
    below = {place for place in imported(path) if row.get(place, -1) > own}
    assert below == set()
