"""The files of a release agree with one another: versions, bounds,
workflows, recipes, containers and fragments.
"""

import json
import re
import runpy
import tomllib
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path

import pytest
import yaml

import warp_resphys

REPOSITORY = Path(__file__).parents[1]
WORKFLOWS = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))
CONTAINERS = sorted((REPOSITORY / "packaging" / "docker").glob("Dockerfile*"))
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
NOT_TRIED = {"torch"}  # older ones than in constraints-lowest.txt


def text(name):
    return (REPOSITORY / name).read_text(encoding="utf-8")


PROJECT = tomllib.loads(text("pyproject.toml"))


def bounds(*extras):
    """Lower bounds of the dependencies, or of extras."""
    project = PROJECT["project"]
    lists = [project["optional-dependencies"][extra] for extra in extras] or [
        project["dependencies"]
    ]
    return dict(
        match.groups()
        for entry in chain(*lists)
        if (match := re.match(r"([\w-]+)>=([\w.]+)", entry))
    )


def paths_in(command):
    """Words of a shell command that name files of the repository."""
    return re.findall(
        r"(?<![\w/.-])(?:tests|packaging|docs|\.github)/[\w./-]+|[\w-]+\.txt", command
    )


@pytest.mark.parametrize(
    ("file", "pattern"),
    [
        ("pyproject.toml", r'^fallback_version = "([\d.]+)\.dev0"'),
        ("CITATION.cff", r"^version: (.+)$"),
        ("CHANGELOG.md", r"^## (?:Unreleased \()?([\d.]+)"),
        ("packaging/conda/recipe.yaml", r'^  version: "(.+)"$'),
        ("packaging/docker/Dockerfile", r"^ARG VERSION=(.+)\.dev0$"),
        ("packaging/docker/Dockerfile.cuda", r"^ARG VERSION=(.+)\.dev0$"),
    ],
)
def test_every_file_names_the_version_of_the_citation(file, pattern):
    assert (
        re.search(pattern, text(file), flags=re.MULTILINE)[1]
        == yaml.safe_load(text("CITATION.cff"))["version"]
    )


def test_the_version_is_that_of_the_installation(monkeypatch):
    assert warp_resphys.__version__ == version("warp-resphys")

    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.version", missing)
    assert warp_resphys.__version__ == "0+unknown"


def test_the_records_for_citation_agree():
    cited = yaml.safe_load(text("CITATION.cff"))
    archived = json.loads(text(".zenodo.json"))
    project = PROJECT["project"]
    assert archived["title"] == cited["title"]
    assert archived["version"] == cited["version"]
    assert archived["publication_date"] == str(cited["date-released"])
    assert archived["license"] == cited["license"] == project["license"]
    assert archived["creators"] == cited["authors"] == project["authors"]
    assert archived["keywords"] == cited["keywords"] == project["keywords"]
    assert archived["description"] == cited["abstract"]
    assert cited["authors"][0]["name"] in text("LICENSE")


def test_the_lowest_versions_are_the_bounds_and_every_dependency_has_one_in_the_constraints():
    lowest = dict(
        re.findall(r"^([\w-]+)==(\S+)$", text("constraints-lowest.txt"), flags=re.MULTILINE)
    )
    expected = bounds() | bounds(
        "bags", "control", "environments", "mujoco", "policies", "tags", "view", "test"
    )
    expected = {
        name: bound for name, bound in expected.items() if not name.startswith("setuptools")
    }
    assert lowest.keys() == expected.keys()
    assert {name for name in lowest if lowest[name] != expected[name]} == NOT_TRIED
    fixed = set(re.findall(r"^([\w-]+)==", text("constraints.txt"), flags=re.MULTILINE))
    extras = PROJECT["project"]["optional-dependencies"]
    assert (bounds() | bounds(*(extras.keys() - {"cluster", "peer", "usd"}))).keys() <= fixed


def test_the_recipe_has_the_dependencies_of_the_package():
    recipe = yaml.safe_load(text("packaging/conda/recipe.yaml"))
    expected = {
        CONDA_NAMES.get(name, name): bound
        for name, bound in bounds().items()
        if name not in ("cholespy", "mkl")
    }
    run = dict(
        entry.split(" >=")
        for entry in recipe["requirements"]["run"]
        if not entry.startswith("python ")
    )
    assert run == expected
    built_with = [entry.replace(" ", "") for entry in recipe["requirements"]["host"]]
    assert set(PROJECT["build-system"]["requires"]) <= set(built_with)
    (name, function) = recipe["build"]["python"]["entry_points"][0].split(" = ")
    assert PROJECT["project"]["scripts"] == {name: function}
    assert recipe["about"]["license"] == PROJECT["project"]["license"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_names_what_exists(path):
    workflow = path.read_text(encoding="utf-8")
    assert yaml.safe_load(workflow)["permissions"]
    for name in paths_in(workflow):
        assert (REPOSITORY / name).exists(), name
    for names in re.findall(r'"\.\[([\w,]+)\]"', workflow):
        assert set(names.split(",")) <= PROJECT["project"]["optional-dependencies"].keys()


@pytest.mark.parametrize("path", CONTAINERS, ids=lambda path: path.name)
def test_a_container_copies_what_exists_and_has_no_rights(path):
    lines = re.sub(r"\\\n", " ", path.read_text(encoding="utf-8")).splitlines()
    kept = {line[1:] for line in text(".dockerignore").splitlines() if line.startswith("!")}
    sources = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    assert set(sources) == kept
    assert all((REPOSITORY / name).exists() for name in sources)
    users = [line.split()[1] for line in lines if line.startswith("USER ")]
    assert users
    assert users[-1] not in ("0", "root")
    (install,) = (line for line in lines if "pip install" in line)
    assert "constraints.txt" in install


def test_the_paper_cites_what_exists_and_numbers_that_the_documentation_has():
    paper = text("paper/paper.md")
    entries = re.findall(r"^@\w+\{(\w+),$", text("paper/paper.bib"), flags=re.MULTILINE)
    assert set(re.findall(r"(?<!\w)@(\w+)", paper)) == set(entries)
    sources = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")]
    documented = "".join(path.read_text(encoding="utf-8") for path in sources)
    measured = paper.partition("# What has been measured")[2].partition("# Limits")[0]
    numbers = set(re.findall(r"\d+\.\d+|\d+,\d{3}", measured))
    assert len(numbers) > 15
    assert {number for number in numbers if number not in documented} == set()


def test_fragments_have_a_valid_name_and_one_entry():
    types = "|".join(entry["directory"] for entry in PROJECT["tool"]["towncrier"]["type"])
    for path in (REPOSITORY / "changes").iterdir():
        if path.name == "README.md":
            continue
        assert re.fullmatch(rf"[a-z0-9]+(-[a-z0-9]+)*\.({types})\.md", path.name), path.name
        assert not path.read_text(encoding="utf-8").lstrip().startswith(("-", "#")), path.name
    assert PROJECT["tool"]["towncrier"]["start_string"].strip() in text("CHANGELOG.md")


def test_pages_of_the_api_have_the_first_sentences_of_their_modules_and_names():
    pages = runpy.run_path(str(REPOSITORY / "docs" / "extensions" / "api_pages.py"))["pages"]()
    assert len(pages) > 8
    for path, expected in pages.items():
        assert path.read_text(encoding="utf-8") == expected, (
            "run python docs/extensions/api_pages.py"
        )
