"""The package in docs/examples, installed in a folder as installers do, without network."""

import shutil
import tomllib
from pathlib import Path

TEMPLATE = Path(__file__).parents[2] / "docs" / "examples" / "my_robot_physics"


def install(site, points=None, name=None, version=None):
    """Copies the package to a folder, and writes the metadata of pyproject.toml, or others, beside it."""
    project = tomllib.loads((TEMPLATE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    name, version = name or project["name"], version or project["version"]
    site.mkdir(exist_ok=True)
    shutil.copytree(TEMPLATE / "my_robot_physics", site / "my_robot_physics", dirs_exist_ok=True)
    about = site / f"{name.replace('-', '_')}-{version}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = project["entry-points"] if points is None else points
    text = [
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in own.items()) for group, own in groups.items()
    ]
    (about / "entry_points.txt").write_text("\n".join(text))
    return site
