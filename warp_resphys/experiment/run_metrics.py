"""Content of metrics.json of a split, from the files of its stages."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..core.energies.catalogue import LawContent
from ..data.registration import RegistrationSummary
from ..io.resuming import package_versions, resources_used
from ..io.safe_files import read_json
from ..learning.error_tables import ErrorTables
from ..learning.identification.search import Identification
from ..report.data import Metrics, Placed
from ..report.ranking import recommended
from ..settings.run import RunSettings
from .build import choose_device
from .experiment import training_files
from .files import (
    CONTROL,
    DATASET,
    ERRORS,
    IDENTIFICATION,
    LAW_FILE,
    MESH_CHECK,
    RECONSTRUCTION,
    REGISTRATION,
    SHAPES,
    TIMES,
    TRUTH,
    read_if_there,
)


def common_folder(folder: Path) -> Path:
    """Folder of the files that do not depend on the fold:
    the folder itself, or the parent of a fold's folder.
    """
    return folder if (folder / DATASET).is_file() else folder.parent


def collect_metrics(folder: Path, run: RunSettings, stages: Sequence[str] | None = None) -> Metrics:
    """Contents of metrics.json of a split.

    These are errors, noise of the observations if known, selected weights, results of
    identification and reconstruction, time and memory of the stages (by default all finished
    stages, in order of completion), versions and device.
    """
    if stages is None:
        records = sorted(
            (folder / "stages").glob("*.json"), key=lambda path: path.stat().st_mtime_ns
        )
        # Without files of interrupted stages.
        stages = [path.stem for path in records if "." not in path.stem]
    files = training_files(folder, run)
    common, identified = common_folder(folder), Identification.read(folder / IDENTIFICATION)
    errors: ErrorTables = read_json(folder / ERRORS)
    metrics: Metrics = {
        **errors,
        "networks": {
            name: read_json(path)["kept"] for name, path in files.items() if path.is_file()
        },
        "parameters": {name: result.parameters for name, result in identified.items()},
        "first_guesses": {
            name: result.first_guess for name, result in identified.items() if result.first_guess
        },
        "at_bounds": {
            name: at_bounds(result) for name, result in identified.items() if result.at_bounds
        },
        **resources_used(folder, stages),
        "versions": package_versions(),
        "device": str(choose_device(run.device)),
        **({"without_forces": True} if run.reconstruction is None else {}),
    }
    law: LawContent | None = None if run.law is None else read_if_there(folder / LAW_FILE) or None
    if law is not None:
        metrics["law"] = {**law, "against": "sysid" if "sysid" in identified else "simulation"}
    if run.reconstruction is not None and (
        reconstruction := read_if_there(folder / RECONSTRUCTION)
    ):
        metrics["reconstruction"] = reconstruction
    if run.control is not None and (control := read_if_there(folder / CONTROL)):
        metrics["control"] = control
    if run.shapes and (shapes := read_if_there(folder / SHAPES)):
        metrics["shapes"] = shapes
    registered = read_if_there(common / REGISTRATION)
    if registered:
        metrics["placement"] = placement(registered, identified)
    if run.mesh_check is not None and (check := read_if_there(folder / MESH_CHECK)):
        metrics["mesh_check"] = check
    if run.timing and (times := read_if_there(folder / TIMES)):
        metrics["seconds_per_test_trajectory"] = times["seconds"]
    truth = read_if_there(common / TRUTH)
    if "noise_mm" in truth:
        metrics["noise_mm"] = truth["noise_mm"]
    metrics["recommended"] = recommended(metrics, run)
    return metrics


def at_bounds(identified: Identification) -> dict[str, float]:
    """Identified values that lie on a bound of their range, by name.

    Those of single trials have their names too.
    """
    values = {**identified.parameters, **identified.of_trials}
    return {name: values[name] for name in identified.at_bounds if name in values}


def placement(
    registered: Mapping[str, RegistrationSummary], identified: Mapping[str, Identification]
) -> Placed:
    """Largest residual of the registration of a trial [mm],
    and the identified rotation of the markers [degrees].

    Markers that the registration of some trial leaves out have their largest residual there [mm].
    """
    placed = [result.placement for result in identified.values() if result.placement is not None]
    turned = max((math.hypot(*one["turn"]) for one in placed), default=0.0)
    found: Placed = {
        "rms_mm": max(fit["rms_mm"] for fit in registered.values()),
        "turned_deg": math.degrees(turned),
    }
    off = dict[str, float]()
    for fit in registered.values():
        for label in fit.get("outliers", ()):
            off[label] = max(fit["residual_mm"][label] or 0.0, off.get(label, 0.0))
    return {**found, "left_out_mm": off} if off else found
