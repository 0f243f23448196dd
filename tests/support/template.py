"""The package in docs/examples, installed in a folder as installers do, without network."""

import shutil
import tomllib
from pathlib import Path

TEMPLATE = Path(__file__).parents[2] / "docs" / "examples" / "my_robot_physics"


def install(site, version=None):
    """Copies the package to a folder, and writes its metadata beside it."""
    project = tomllib.loads((TEMPLATE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = version or project["version"]
    site.mkdir(exist_ok=True)
    shutil.copytree(TEMPLATE / "my_robot_physics", site / "my_robot_physics")
    about = site / f"my_robot_physics-{version}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {version}\n")
    (about / "top_level.txt").write_text("my_robot_physics\n")
    return site
