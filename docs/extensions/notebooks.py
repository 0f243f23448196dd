"""Tutorials as notebooks: next to the page of each tutorial its notebook,
with a link below the title.

They are short in a book that is built with the environment variable `WARP_RESPHYS_TUTORIALS=short`.
"""

import os
from pathlib import Path
from typing import Any

import jupytext
from short_form import in_form
from sphinx.application import Sphinx


def read(text: str) -> Any:
    """Returns a tutorial as a notebook, in full length but where the environment says short."""
    short = os.environ.get("WARP_RESPHYS_TUTORIALS") == "short"
    return jupytext.reads(in_form(text, short), fmt="py:percent")


def tutorials(app: Sphinx) -> list[Path]:
    """Returns the files of the tutorials that are programs."""
    return sorted(Path(app.srcdir, "tutorials").glob("*.py"))


def write_notebooks(app: Sphinx, error: Exception | None) -> None:
    """Writes the notebooks into the book, without outputs."""
    if error is None and app.builder.format == "html":
        for path in tutorials(app):
            target = Path(app.outdir, "tutorials", path.stem).with_suffix(".ipynb")
            target.parent.mkdir(exist_ok=True)
            jupytext.write(read(path.read_text(encoding="utf-8")), target)


def link_notebook(
    app: Sphinx, page: str, _template: str, context: dict[str, Any], _doctree: Any
) -> None:
    """Adds the link to the notebook below the title of a tutorial."""
    for path in tutorials(app):
        if page == f"tutorials/{path.stem}" and "body" in context:
            link = (
                f'<p class="notebook"><a href="{path.stem}.ipynb" download>Download this page as '
                "a notebook</a></p>"
            )
            context["body"] = context["body"].replace("</h1>", f"</h1>\n{link}", 1)


def spread_tutorials(app: Sphinx, _environment: Any, pages: list[str]) -> None:
    """Orders the pages such that processes that read neighbouring pages run equally many
    tutorials.
    """
    slow = {f"tutorials/{path.stem}" for path in tutorials(app)}
    groups = [[page for page in pages if (page in slow) is among] for among in (True, False)]
    place = {page: number / len(group) for group in groups for number, page in enumerate(group)}
    pages.sort(key=place.__getitem__)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("env-before-read-docs", spread_tutorials)
    app.connect("build-finished", write_notebooks)
    app.connect("html-page-context", link_notebook)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
