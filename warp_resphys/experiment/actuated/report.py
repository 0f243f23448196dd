"""Stage: the report of a split of trials that pressure drives."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...io.errors import DataFileError
from ...io.files import read_array, read_hdf5, read_json
from ...io.stages import StageContext
from ...learning.driven import DRIVEN_PARAMETERS
from ...learning.metrics import PUBLISHED_WINDOWS_MM, published_errors
from ...mesh.chambers import Chamber
from ...mesh.mesh import Mesh, select_vertices
from ...report.driven_data import Actuation, DrivenReport, Film
from ...report.driven_page import write_driven_report
from ...report.driven_tables import DRIVEN_MODELS
from ...report.measured_data import Recordings, Trials
from ..build import build_chambers, build_mesh
from ..measured.files import IDENTIFICATION, REPORT, ROLLOUTS, TRUTH, training_file
from ..measured.identify import first_guess
from ..measured.report import error_notes, read_if_there, read_metrics, read_recordings
from .files import LEARNED, MOTIONS, RAISED_MOTIONS, RECONSTRUCTION
from .trials import is_synthetic

_NOTES = {
    True: "The published errors are those of another body: recordings of a real arm, which this run has not seen.",
    False: "The published errors are those of the published simulator, of 494 vertices, on the authors' recordings.",
}


def report_driven(context: StageContext) -> None:
    """Writes report.html of a split of the trials, its figures and the video.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or one could not be written.
    """
    folder, config = context.run_dir, context.settings["config"]
    mesh = build_mesh(config["mesh"])
    synthetic = is_synthetic(config)
    metrics, truth = read_metrics(folder, config), read_json(folder / TRUTH) if synthetic else {}
    files = [folder / name for name in (MOTIONS, *((RAISED_MOTIONS,) if config["data"]["factors"] else ()))]
    actuation = read_actuation(files, config["data"]["pressure_limit"])
    trials, beyond, film = read_rollouts(folder, metrics, config["time_step"], [*actuation.pressure])
    data = DrivenReport(
        experiment=config["name"],
        title=config["title"],
        metrics=metrics,
        settings=config,
        published=published_errors(config["name"]),
        published_note=_NOTES[synthetic],
        notes=error_notes({}, truth),
        mesh=mesh,
        fixed=select_vertices(mesh, **config["fixed"]),
        recordings=_at_rest(folder, config, mesh, trials, film),
        synthetic=synthetic,
        trials=trials,
        identification=read_if_there(folder / IDENTIFICATION),
        start=first_guess(config, DRIVEN_PARAMETERS),
        truth=truth.get("material", {}),
        training={m: read_json(path)["epochs"] for m in LEARNED if (path := folder / training_file(m)).is_file()},
        chambers=_chambers(build_chambers(config["chambers"], mesh), actuation.chambers),
        actuation=actuation,
        film=film,
        beyond=beyond,
        published_windows=PUBLISHED_WINDOWS_MM.get(config["name"], {}),
        reconstruction=read_if_there(folder / RECONSTRUCTION),
    )
    write_driven_report(folder / REPORT, data)


def _at_rest(folder: Path, config: Mapping[str, Any], mesh: Mesh, trials: Trials, film: Film) -> Recordings:
    """How the recordings are; they show the body hanging, as the first model has it before any pressure."""
    model = next(iter(film.positions))
    moved = trials.markers[model][0, 0] - trials.bound
    hanging = Mesh(film.positions[model][0], mesh.cells)
    return read_recordings(folder, config, hanging, dict(zip(trials.labels, moved, strict=True)))


def _chambers(chambers: tuple[Chamber, ...], names: tuple[str, ...]) -> tuple[Chamber, ...]:
    """Those of a body's chambers that are under pressure, in the order of the pressures."""
    found = {chamber.name: chamber for chamber in chambers}
    unknown = [name for name in names if name not in found]
    if unknown:
        raise DataFileError(
            f"{MOTIONS} has pressures of {', '.join(unknown)}, but the body's chambers are "
            f"{', '.join(found) or 'none'}: take the mesh that the motions were imported for."
        )
    return tuple(found[name] for name in names)


def read_actuation(files: Sequence[Path], limit: float | None) -> Actuation:
    """The pressures of all trials.

    Args:
        files: with the motions of the trials.
        limit: that none may exceed [Pa].

    Raises:
        DataFileError: a file is missing or damaged.
    """
    chambers: tuple[str, ...] = ()
    pressures: dict[str, Any] = {}
    for path in files:
        with read_hdf5(path, "motions") as file:
            names, labels = ([str(each) for each in file.attrs[key]] for key in ("names", "chambers"))
            chambers = tuple(labels)
            pressures |= dict(zip(names, read_array(file, "pressure", (len(names), None, len(labels))), strict=True))
    return Actuation(chambers, pressures, limit)


def read_rollouts(
    folder: Path, metrics: Mapping[str, Any], time_step: float, known: Sequence[str]
) -> tuple[Trials, tuple[str, ...], Film]:
    """What was measured in the test trials and what the models made of them.

    Args:
        folder: of the run.
        metrics: with the number of trials that the errors are of; the roll-outs after these are at higher
            pressure.
        time_step: [s].
        known: names of all trials that were imported.

    Returns:
        The test trials, the names of the roll-outs at higher pressure, and the bodies of the film.

    Raises:
        DataFileError: a file is missing or damaged, or the two do not belong together.
    """
    path = folder / MOTIONS
    with read_hdf5(path, "motions") as file:
        names, labels = ([str(each) for each in file.attrs[key]] for key in ("names", "labels"))
        gravity = np.asarray(file.attrs["gravity"], dtype=np.float64)
        markers = read_array(file, "markers", (len(names), None, len(labels), 3))
        bound = read_array(file, "bound", (len(labels), 3))
    count = next(iter(metrics["errors_mm"].values()))["trajectories"]
    with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
        rolled = [str(each) for each in file.attrs["names"]]
        models = [model for model in DRIVEN_MODELS if f"{model}_markers" in file]
        shape = (len(rolled), markers.shape[1], len(labels), 3)
        simulated = {m: read_array(file, f"{m}_markers", shape)[:count].astype(np.float64) for m in models}
        steps = read_array(file, "film_steps", (None,)).astype(np.int64)
        filmed = {m: read_array(file, f"{m}_film", (len(steps), None, 3)) for m in models if f"{m}_film" in file}
    unknown = sorted(set(rolled) - set(known))
    if unknown or not models:
        what = f"names trials that {path} does not hold ({', '.join(unknown)})" if unknown else "holds no model"
        raise DataFileError(f"{folder / ROLLOUTS} {what}: delete it and run the same command again.")
    rows = [names.index(name) for name in rolled[:count]]
    trials = Trials(
        names=tuple(rolled[:count]),
        labels=tuple(labels),
        times=np.tile(time_step * np.arange(markers.shape[1], dtype=np.float64), (len(rows), 1)),
        measured=markers[rows],
        bound=bound,
        gravity=gravity,
        markers=simulated,
        positions={},
        time_step=time_step,
    )
    film = Film(steps, {model: each.astype(np.float64) for model, each in filmed.items()})
    return trials, tuple(rolled[count:]), film
