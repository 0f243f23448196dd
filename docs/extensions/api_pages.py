"""Pages of the API for readers of Markdown: below the heading of a module,
its first sentence and its names.

python docs/extensions/api_pages.py
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

_REPOSITORY = Path(__file__).parents[2]
_MODULE = re.compile(r"(?<=\n)## `([\w.]+)`\n.*?(?=```\{eval-rst\})", re.DOTALL)
_MARKUP = re.compile(r"(?<!\\)([|*<$])")
_LITERAL = re.compile(r"(``.+?``|`.+?`)")


def pages() -> dict[Path, str]:
    """Returns the pages with modules, as they should read."""
    texts = {
        path: path.read_text(encoding="utf-8")
        for path in (_REPOSITORY / "docs" / "api").glob("*.md")
    }
    return {
        path: _MODULE.sub(_described, text) for path, text in texts.items() if _MODULE.search(text)
    }


def _described(heading: re.Match[str]) -> str:
    """The heading of a module with the first line of its docstring
    and a table of its public names.
    """
    tree = ast.parse(
        _REPOSITORY.joinpath(*heading[1].split(".")).with_suffix(".py").read_text(encoding="utf-8")
    )
    rows = [f"| `{name}` | {_markdown(meaning)} |" for name, meaning in _documented(tree)]
    table = "\n".join(["| name | purpose |", "|---|---|", *rows])
    return f"## `{heading[1]}`\n\n{_first_line(tree)}\n\n" + (f"{table}\n\n" if rows else "")


def _documented(parent: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Public classes, their methods, and functions, each with the first line of its docstring."""
    for node in parent.body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef) or node.name.startswith("_"):
            continue
        meaning = _first_line(node)
        if meaning:
            yield prefix + node.name, meaning
        if isinstance(node, ast.ClassDef):
            yield from _documented(node, f"{prefix}{node.name}.")


def _first_line(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> str:
    return (ast.get_docstring(node) or "").partition("\n")[0]


def _markdown(line: str) -> str:
    """A line of a docstring in a cell of a table: bars, stars and brackets are no markup."""
    parts = _LITERAL.split(line)
    parts[::2] = [_MARKUP.sub(r"\\\1", part) for part in parts[::2]]
    parts[1::2] = [part.replace("|", r"\|") for part in parts[1::2]]
    return "".join(parts)


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
