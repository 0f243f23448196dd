"""The sizes that keep the code readable: modules, functions, folders; and one name for each module.

``python -m pytest tests/test_structure.py -rP`` prints the figures.
"""

import ast
import functools
from collections import Counter, defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
PATHS = [path for folder in ("warp_resphys", "kernels", "scripts") for path in (REPOSITORY / folder).rglob("*.py")]
TEXTS = {path.relative_to(REPOSITORY): path.read_text(encoding="utf-8") for path in PATHS}


@functools.cache
def nodes():
    """(path, function) of every function, of generators of kernels as well."""
    found = []
    for path, text in TEXTS.items():
        tree = ast.parse(text)
        found += [(path, n) for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    return found


def functions():
    """(lines, place) of every function."""
    for path, node in nodes():
        yield node.end_lineno - node.lineno + 1, f"{path}:{node.name}"


def test_modules_have_at_most_400_lines():
    lines = {str(path): len(text.splitlines()) for path, text in TEXTS.items()}
    print(f"{sum(lines.values())} lines in {len(lines)} modules; the longest: {max(lines.values())}")
    assert {path: count for path, count in lines.items() if count > 400} == {}


def test_at_most_ten_functions_have_more_than_60_lines():
    long = sorted((item for item in functions() if item[0] > 60), reverse=True)
    print(*(f"{count} {place}" for count, place in long), sep="\n")
    assert len(long) <= 10


def test_folders_have_at_most_20_modules():
    folders = defaultdict(list)
    for path in TEXTS:
        folders[str(path.parent)].append(path.name)
    sizes = {folder: len([name for name in names if name != "__init__.py"]) for folder, names in folders.items()}
    print(max(sizes.items(), key=lambda item: item[1]))
    assert {folder: size for folder, size in sizes.items() if size > 20} == {}


def test_no_two_modules_have_one_name():
    names = Counter(path.name for path in TEXTS)
    assert {name for name, count in names.items() if count > 1} <= {"__init__.py", "base.py"}


def test_contents_that_are_known_have_a_type():
    untyped = sum(text.count("Mapping[str, Any]") for text in TEXTS.values())
    print(f"{untyped} of Mapping[str, Any]")
    assert untyped <= 60


def test_a_stage_has_at_most_60_lines():
    """A stage reads files, calls a function and writes files."""
    long = []
    for path, node in nodes():
        kinds = {arg.annotation.id for arg in node.args.args if isinstance(arg.annotation, ast.Name)}
        if "StageContext" in kinds:
            long.append((node.end_lineno - node.lineno + 1, f"{path}:{node.name}"))
    print(*sorted(long, reverse=True), sep="\n")
    assert [item for item in long if item[0] > 60] == []
