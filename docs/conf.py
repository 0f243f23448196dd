"""The book, in an environment with the extra `book`.

sphinx-build --fail-on-warning docs outputs/book

Building it runs the tutorials; those that have not changed since the last build are taken from the
cache in `outputs/`. `WARP_RESPHYS_TUTORIALS=short` in the environment runs their short form
(`extensions/short_form.py`).
"""

import re
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import warp_resphys

_REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "warp_resphys"
_LICENSE = (_REPOSITORY / "LICENSE").read_text(encoding="utf-8")
copyright = re.search(r"^Copyright \(c\) (.+)$", _LICENSE, re.MULTILINE)[1]
author = copyright.partition(" ")[2]
version = release = warp_resphys.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "myst_nb",
    "notebooks",
    "signatures",
]
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
exclude_patterns = ["conf.py", "examples", "extensions"]
nb_custom_formats = {".py": "notebooks.read"}

html_theme = "furo"
html_static_path = ["films", "style"]
html_css_files = ["book.css"]
html_title = "warp_resphys"
html_show_sourcelink = False
html_theme_options = {"sidebar_hide_name": False, "navigation_with_keys": True}

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

nb_execution_mode = "cache"
nb_execution_cache_path = str(_REPOSITORY / "outputs" / "tutorials")
nb_execution_timeout = 600  # of a cell [s]
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # Warp says there that it found no GPU; an error stops the build

autodoc_default_options = {"members": True}
add_module_names = False
maximum_signature_line_length = 60  # a longer signature has one parameter a line
python_trailing_comma_in_multi_line_signatures = False
python_display_short_literal_types = True
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports = ["stable_baselines3"]
default_role = "py:obj"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

_LITERAL = re.compile(r"(``.+?``|`.+?`)")
_MARKUP = re.compile(r"(?<!\\)([|*])")


def _escape(
    _app: Sphinx, what: str, _name: str, _found: Any, _options: Any, lines: list[str]
) -> None:
    """Docstrings are plain text beside their literals:
    a bar is a norm and a star a product, not markup.
    """
    if what == "module":
        del lines[:1]  # it stands below the heading, by `extensions/api_pages.py`
    for number, line in enumerate(lines):
        parts = _LITERAL.split(line)
        parts[::2] = [_MARKUP.sub(r"\\\1", part) for part in parts[::2]]
        lines[number] = "".join(parts)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _escape, priority=600)  # after Napoleon
    # It copies files after the pages are read.
    app.extensions["sphinx-mathjax-offline"].parallel_read_safe = True
