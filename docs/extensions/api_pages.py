"""Pages of the API for readers of Markdown: below the heading of a module, its first sentence.

python docs/extensions/api_pages.py
"""

import ast
import re
from pathlib import Path

_REPOSITORY = Path(__file__).parents[2]
_MODULE = re.compile(r"(?<=\n)## `([\w.]+)`\n.*?(?=```\{eval-rst\})", re.DOTALL)


def pages() -> dict[Path, str]:
    """Returns the pages with modules, as they should read."""
    texts = {path: path.read_text(encoding="utf-8") for path in (_REPOSITORY / "docs" / "api").glob("*.md")}
    return {path: _MODULE.sub(_described, text) for path, text in texts.items() if _MODULE.search(text)}


def _described(heading: re.Match[str]) -> str:
    """The heading of a module with the first sentence of its docstring."""
    tree = ast.parse(_REPOSITORY.joinpath(*heading[1].split(".")).with_suffix(".py").read_text(encoding="utf-8"))
    first = (ast.get_docstring(tree) or "").partition("\n")[0]
    return f"## `{heading[1]}`\n\n{first}\n\n"


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
