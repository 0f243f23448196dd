"""The book has every public name and every tutorial; building it is a step of its own."""

import re
from pathlib import Path

import warp_resphys

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"


def documented():
    """Modules of the API's pages."""
    pages = (page.read_text(encoding="utf-8") for page in (DOCS / "api").glob("*.md"))
    return {name for page in pages for name in re.findall(r"automodule:: warp_resphys\.([\w.]+)", page)}


def test_every_public_name_is_on_a_page():
    assert set(warp_resphys._MODULES.values()) <= documented()
    index = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"\{py:obj\}`(\w+) <warp_resphys\.([\w.]+)\.\w+>`", index))
    assert listed == warp_resphys._MODULES


def test_every_module_of_the_pages_exists():
    for name in documented():
        assert (REPOSITORY / "warp_resphys").joinpath(*name.split(".")).with_suffix(".py").is_file(), name


def test_every_tutorial_is_in_the_contents_and_says_when_it_is_wrong():
    index = (DOCS / "tutorials" / "index.md").read_text(encoding="utf-8")
    listed = re.search(r"\{toctree\}\n:hidden:\n\n(.*?)```", index, flags=re.DOTALL)[1].split()
    pages = [path for path in (DOCS / "tutorials").iterdir() if path.suffix in (".py", ".md") and path.stem != "index"]
    assert sorted(listed) == sorted(path.stem for path in pages)
    for path in pages:
        assert f"]({path.name})" in index
        if path.suffix == ".py":
            text = path.read_text(encoding="utf-8")
            assert "\nassert " in text, path.name
            assert text.startswith("# ---\n# jupyter:")


def test_what_the_theory_names_is_in_the_code():
    theory = (DOCS / "theory.md").read_text(encoding="utf-8")
    modules = re.findall(r"`((?:control|data|dynamics|energies|fem|learning|linalg)\.[\w.]+)`", theory)
    kernels = re.findall(r"`(kernels/[\w/]+\.py)`", theory)
    kernels += [f"kernels/materials/{name}" for name in re.findall(r"`([a-z_]+\.py)`", theory)]
    assert len(modules) > 25
    assert len(kernels) > 6
    for name in modules:
        assert (REPOSITORY / "warp_resphys").joinpath(*name.split(".")).with_suffix(".py").is_file(), name
    for path in kernels:
        assert (REPOSITORY / path).is_file(), path
