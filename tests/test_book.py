"""The book has every public name and every tutorial; building it is a step of its own."""

import functools
import importlib
import inspect
import re
import runpy
from pathlib import Path

import pytest

import warp_resphys

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"


PARTS = ("energies", "learning", "mesh", "pictures")
PUBLIC = [
    *warp_resphys.__all__,
    *(
        f"{part}.{name}"
        for part in PARTS
        for name, value in vars(getattr(warp_resphys, part)).items()
        if name[0] != "_" and not inspect.ismodule(value) and name not in warp_resphys.__all__
    ),
]


def documented():
    """Modules of the API's pages."""
    pages = (page.read_text(encoding="utf-8") for page in (DOCS / "api").glob("*.md"))
    return {
        name for page in pages for name in re.findall(r"automodule:: warp_resphys\.([\w.]+)", page)
    }


def test_every_public_name_is_on_a_page_and_that_of_a_part_says_where_it_is():
    index = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"\{py:obj\}`([\w.]+) <warp_resphys\.([\w.]+)\.(\w+)>`", index)
    assert {module for _, module, _ in listed} <= documented()
    assert sorted(name for name, _, _ in listed) == sorted(PUBLIC)
    for name, module, own in listed:
        public = functools.reduce(getattr, name.split("."), warp_resphys)
        assert public is getattr(importlib.import_module(f"warp_resphys.{module}"), own)
        assert public.__doc__
    with pytest.raises(
        AttributeError, match=r"no attribute 'Sphere': it is in warp_resphys\.energies"
    ):
        _ = warp_resphys.Sphere


def test_every_tutorial_is_in_the_contents_and_says_when_it_is_wrong():
    index = (DOCS / "tutorials" / "index.md").read_text(encoding="utf-8")
    listed = re.search(r"\{toctree\}\n:hidden:\n\n(.*?)```", index, flags=re.DOTALL)[1].split()
    listed += re.findall(r"<tutorials/(\w+)>", (DOCS / "index.md").read_text(encoding="utf-8"))
    pages = [
        path
        for path in (DOCS / "tutorials").iterdir()
        if path.suffix in (".py", ".md") and path.stem != "index"
    ]
    assert sorted(listed) == sorted(path.stem for path in pages)
    for path in pages:
        assert f"]({path.name})" in index
        if path.suffix == ".py":
            text = path.read_text(encoding="utf-8")
            assert "\nassert " in text, path.name
            assert text.startswith("# ---\n# jupyter:")


def test_tutorials_have_a_short_form():
    in_form = runpy.run_path(str(DOCS / "extensions" / "short_form.py"))["in_form"]
    line = "    for _ in range(14):  # short: 14 -> 2\n        x"
    assert in_form(line, False) == "    for _ in range(14):\n        x"
    assert in_form(line, True) == "    for _ in range(2):\n        x"
    assert in_form("y = (2, 2)  # m  # short: (2, 2) -> (1, 1)", True) == "y = (1, 1)  # m"
    for number, line in enumerate(["y = (2, 2)  # short: 2 -> 1", "y = (2, 2)  # short: 3 -> 1"]):
        with pytest.raises(ValueError, match=f"is {2 - 2 * number} times in the line"):
            in_form(line, True)
    for page in (DOCS / "tutorials").glob("*.py"):
        text = page.read_text(encoding="utf-8")
        for short in (False, True):
            written = in_form(text, short)
            compile(written, page.name, "exec")
            assert "# short:" not in written
            assert "\nassert " in written


def test_what_the_theory_and_the_pages_name_is_in_the_code():
    theory = (DOCS / "theory.md").read_text(encoding="utf-8")
    modules = {
        *re.findall(r"`((?:control|data|dynamics|energies|fem|learning|linalg)\.[\w.]+)`", theory)
    }
    kernels = re.findall(r"`(kernels/[\w/]+\.py)`", theory)
    kernels += [f"kernels/materials/{name}" for name in re.findall(r"`([a-z_]+\.py)`", theory)]
    assert len(modules) > 25
    assert len(kernels) > 6
    for name in modules | documented():
        assert (
            (REPOSITORY / "warp_resphys").joinpath(*name.split(".")).with_suffix(".py").is_file()
        ), name
    for path in kernels:
        assert (REPOSITORY / path).is_file(), path


LONGEST = 120  # characters of a line of code that fit the column at 1280 px


def test_no_line_of_code_is_longer_than_the_column():
    long = []
    for page in DOCS.rglob("*.md"):
        # A block that does not end hides the rest.
        assert page.read_text(encoding="utf-8").count("```") % 2 == 0, page
        blocks = re.findall(
            r"^ *```.*?\n(.*?)^ *```",
            page.read_text(encoding="utf-8"),
            flags=re.DOTALL | re.MULTILINE,
        )
        long += [
            (page.name, line)
            for block in blocks
            for line in block.splitlines()
            if len(line) > LONGEST
        ]
    for program in DOCS.glob("tutorials/*.py"):
        lines = program.read_text(encoding="utf-8").splitlines()
        long += [
            (program.name, line)
            for line in lines
            if len(line) > LONGEST and not line.startswith("# ")
        ]
    assert long == []


def test_signatures_have_short_types_and_fields_their_comments():
    pytest.importorskip("sphinx")
    extension = runpy.run_path(str(DOCS / "extensions" / "signatures.py"))
    long = "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]"
    written = (
        f"(a: {long} | ~torch.Tensor, b: dict = <factory>, c: ~x.y.Z = <function f.<lambda>>, "
        "d: torch.dtype)"
    )
    assert extension["shorten"](written) == (
        "(a: NDArray[float64] | Tensor, b: dict = <factory>, c: Z = ..., d: torch.dtype)"
    )
    parameters, _ = extension["readable"](
        None, "class", "", warp_resphys.Mesh, None, "(regions: dict = <factory>)", None
    )
    assert parameters == "(regions: dict = {})"
    source = (
        "class A:\n    x: int  # [m]\n    # of the\n    # body\n    y: int = 1\n    z: str = '#'\n"
    )
    assert extension["field_comments"](source) == {"x": "[m]", "y": "of the body"}
