"""Stage: writes the report page of a split, and of a cross-validation,
from the files of the run folder.

Functions that read a file raise a DataFileError if the file is missing or damaged.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter

from ..core.energies.catalogue import LawContent, modes_of
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.fem.bodies import Body
from ..core.fem.integration_points import principal_stretches, share_outside
from ..core.mesh.chambers import Chamber
from ..core.mesh.selection import vertices_at
from ..core.mesh.volume_mesh import Mesh
from ..data.recordings.marker_quality import Quality
from ..data.registration import RegistrationSummary
from ..data.rigid_bodies import as_markers, owners
from ..data.trials import STATIC, Trials
from ..io.arrays import FloatArray
from ..io.errors import DataFileError
from ..io.resuming import StageContext
from ..io.safe_files import read_array, read_attribute, read_hdf5, read_json
from ..learning.error_tables import ErrorTables
from ..learning.identification.search import Identification
from ..learning.intervals import half_widths_of
from ..learning.parameters import configured_parameters
from ..report.data import Driven, Film, FollowedPath, Recordings, RunReport, TrialResults
from ..report.ranking import shown_metrics
from ..report.wording import MODELS, models_in_figures
from ..settings.run import RunSettings
from .actuators import build_chambers, driving_quantity, routes_of
from .build import bound_markers, build_body, build_simulator, marker_view_of, whole_mesh
from .experiment import read_actuator, training_files
from .files import (
    DATASET,
    DRIVEN,
    ERRORS,
    IDENTIFICATION,
    METRICS,
    QUALITY,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    SCALED_DATASET,
    TRUTH,
    fold_folder,
    read_if_there,
)
from .force_curves import force_curves
from .run_metrics import collect_metrics, common_folder


def make_report(context: StageContext) -> None:
    """Writes report.html of a split, with its figures and, if there is one, its video.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or a file could not be
            written.
    """
    from ..report.pages import run_page  # matplotlib

    run_page.write_report(
        context.run_dir / REPORT, RunReader(context.run_dir, context.settings).report()
    )


def make_folds_report(context: StageContext) -> None:
    """Writes report.html of a cross-validation, from metrics.json and files that all folds share.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or a file could not be
            written.
    """
    from ..report.pages import run_page  # matplotlib

    folder, run = context.run_dir, context.settings
    metrics = shown_metrics(read_json(folder / METRICS))
    reader = RunReader(folder, run)
    data = RunReport(
        metrics=metrics,
        settings=run,
        mesh=reader.body.mesh,
        fixed=reader.body.fixed_vertices,
        pages={trial: f"{fold_folder(trial)}/{REPORT}" for trial in metrics["folds"]},
        recordings=reader.recordings(reader.body.mesh, {}),
    )
    run_page.write_report(folder / REPORT, data)


def true_contact(run: RunSettings) -> dict[str, float]:
    """Constants of the simulated laboratory's contact and shifts of its obstacles, by parameter."""
    if run.laboratory is None:
        return {}
    truth, obstacles = dict[str, float](), run.laboratory.obstacles
    for name, obstacle in obstacles.items():
        part = f"_{name}" if len(obstacles) > 1 else ""
        for key in ("stiffness", "friction"):
            value = getattr(run.laboratory.contact, key)
            truth[f"contact_{key}{part}"] = value[name] if isinstance(value, dict) else value
        if name in run.obstacles:
            shift = np.subtract(obstacle.position, run.obstacles[name].position)
            truth |= {
                f"obstacle_{axis}{part}": float(x) for axis, x in zip("xyz", shift, strict=True)
            }
    return truth


class RunReader:
    """The files of a split, as plain data of its page; each is read once.

    Args:
        folder: of the split.
        run: its settings.

    Raises:
        DataFileError: a file that is read is missing or damaged, or files do not belong together.
    """

    def __init__(self, folder: Path, run: RunSettings) -> None:
        self.folder = folder
        self.run = run
        self.common = common_folder(folder)
        # Equal to the simulator below it.
        self._hidden = ("resphys",) if run.reconstruction is None else ()

    @cached_property
    def body(self) -> Body:
        """The undeformed body."""
        return build_body(self.run)

    @cached_property
    def dataset(self) -> Trials:
        """All trials of the split."""
        return Trials.read(self.common / DATASET)

    @cached_property
    def scaled(self) -> Trials | None:
        """Trials with scaled inputs, if there are any."""
        path = self.common / SCALED_DATASET
        return Trials.read(path) if path.is_file() else None

    def report(self) -> RunReport:
        """Returns all data of the page."""
        run, body = self.run, self.body
        trials = self.trials
        identification = Identification.read(self.folder / IDENTIFICATION)
        metrics = shown_metrics(collect_metrics(self.folder, run))
        material = read_if_there(self.common / TRUTH).get("material", {})
        # (K + 1, R, O) inputs, by name
        moved = self.dataset.contact_at(trials.names, body, self.dataset.time_step)
        assert run.tip is not None
        names = set[str]().union(*(result.parameters for result in identification.values()))
        histories = (
            (m, read_if_there(path).get("epochs"))
            for m, path in training_files(self.folder, run).items()
        )
        return RunReport(
            metrics=metrics,
            settings=run,
            mesh=body.mesh,
            fixed=body.fixed_vertices,
            tip=np.empty(0, np.int64) if trials.labels else vertices_at(body.mesh, run.tip),
            chambers=self._driven_chambers(),
            tendons=routes_of(body),
            obstacles=ObstacleSurface.of(
                body, identification.get("sysid", Identification()).parameters
            ),
            moved={
                name: {key: x[:, row] for key, x in moved.items()}
                for row, name in enumerate(trials.names)
            },
            trials=trials,
            film=self.film,
            driven=self.driven,
            recordings=self.recordings(*self._at_rest()),
            forces=force_curves(self.folder, run, self.dataset, trials.names, [*trials.positions]),
            identification=identification,
            actuator=read_actuator(self.folder) if run.with_actuator else {},
            **(self._stretches(metrics["law"]) if "law" in metrics else {}),
            start=configured_parameters(build_simulator(run, run.simulation), sorted(names)),
            truth={name: value for name, value in material.items() if name != "model"}
            | true_contact(run),
            true_material=material.get("model", "corotated"),
            training={model: epochs for model, epochs in histories if epochs},
            followed=self._followed(),
        )

    @cached_property
    def trials(self) -> TrialResults:
        """Observations of the test trials and roll-outs of models, up to the evaluated duration.

        Roll-outs with scaled inputs are left out.
        """
        trials, run = self.dataset, self.run
        bound = whole_mesh(run).vertices if trials.bound is None else trials.bound
        errors: ErrorTables = read_json(self.folder / ERRORS)
        with read_hdf5(self.folder / ROLLOUTS, "rollouts") as file:
            rolled = tuple(map(str, read_attribute(file, "names")))
            test = [name for name in rolled if self.scaled is None or name not in self.scaled.names]
            models = [
                model
                for model in models_in_figures(errors["errors_mm"])
                if f"{model}_observed" in file
            ]
            models = [model for model in models if model not in self._hidden]
            unknown = sorted(set(test) - set(trials.names))
            if unknown or not models:
                what = (
                    f"names trials that {self.common / DATASET} does not hold "
                    f"({', '.join(unknown)})"
                )
                what = what if unknown else "holds no model"
                raise DataFileError(
                    f"{self.folder / ROLLOUTS} {what}: delete it and run the same command again."
                )
            shape = (len(rolled), *trials.observed.shape[1:])
            spread = (*shape[:2], len(owners(trials.labels)))
            known = [m for m in models if f"{m}_spread" in file]
            positions = {m: read_array(file, f"{m}_observed", shape)[: len(test)] for m in models}
            spreads = {m: read_array(file, f"{m}_spread", spread)[: len(test)] for m in known}
        calibrated = errors["intervals"]["models"] if "intervals" in errors else {}
        half_widths = half_widths_of(trials, test, calibrated, positions, spreads)
        unseen = (
            None
            if run.markers is None
            else marker_view_of(run.markers, trials.labels, trials.sets).unseen
        )
        rows = trials.rows(test)
        times, target = trials.times[rows], trials.observed[rows]
        begins = tuple(trials.begins[row] for row in rows)
        seconds, length = run.trial_seconds, times.shape[1]
        if seconds is not None:
            target = np.where((times <= seconds)[..., None, None], target, np.nan)
            length = max(1, int((times <= seconds).any(axis=0).sum()))
        if set(begins) == {STATIC}:
            # Static poses beside motions are padded to the same number of frames.
            length = 1
        return TrialResults(
            names=tuple(test),
            labels=owners(trials.labels),
            begins=begins,
            times=times[:, :length],
            target=as_markers(target[:, :length], trials.labels),
            positions={
                model: as_markers(points[:, :length], trials.labels)
                for model, points in positions.items()
            },
            bound=as_markers(bound, trials.labels),
            gravity=trials.gravity,
            time_step=trials.time_step,
            half_widths={model: widths[:, :length] for model, widths in half_widths.items()},
            axes=tuple(axis for axis in range(3) if axis != unseen),
        )

    @cached_property
    def film(self) -> Film | None:
        """Bodies of the film, placed as their markers are seen; None if there is no film."""
        trials, run = self.dataset, self.run
        with read_hdf5(self.folder / ROLLOUTS, "rollouts") as file:
            if "film_steps" not in file:
                return None
            steps = read_array(file, "film_steps", (None,)).astype(np.float64)
            models = [
                model for model in MODELS if f"{model}_film" in file and model not in self._hidden
            ]
            shape = (len(steps), None, 3)
            bodies = {
                model: read_array(file, f"{model}_film", shape).astype(np.float64)
                for model in models
            }
            trial = str(read_attribute(file, "film_trial"))
            times = float(read_attribute(file, "time_step")) * steps
        if trials.bound is not None and run.markers is not None:
            view = marker_view_of(run.markers, trials.labels, trials.sets)
            if view.shape_alone:
                has = np.flatnonzero(trials.present[trials.names.index(trial)]).tolist()
                markers = bound_markers(run.markers, self.body.mesh, trials.bound, trials.labels)
                view = view.select(has)
                at = {model: torch.from_numpy(q) for model, q in bodies.items()}
                bodies = {
                    model: view.carried(q, markers(q)[:, has]).numpy() for model, q in at.items()
                }
        return Film(trial, times, bodies)

    @cached_property
    def driven(self) -> Driven | None:
        """Driving inputs of all trials; None without actuators."""
        trials, scaled = self.dataset, self.scaled
        quantity = driving_quantity(self.run)
        if quantity is None or quantity.name not in trials.inputs:
            return None
        values: dict[str, FloatArray] = {}
        for one in filter(None, (trials, scaled)):
            values |= dict(zip(one.names, one.inputs[quantity.name], strict=True))
        return Driven(
            quantity,
            trials.channels[quantity.name],
            values,
            self.run.input_limit,
            scaled=() if scaled is None else scaled.names,
            poses=tuple(
                n for n, begins in zip(trials.names, trials.begins, strict=True) if begins == STATIC
            ),
        )

    def recordings(self, mesh: Mesh, moved: Mapping[str, FloatArray]) -> Recordings | None:
        """Returns quality and registration of all trials; None without recordings.

        Args:
            mesh: mesh of the body at rest.
            moved: (3,) displacements of the markers from the undeformed body to the body at rest
                [m], by label.
        """
        markers = self.run.markers
        if markers is None:
            return None
        beside = [] if self.run.fixed is not None else [*markers.reference]
        known: dict[str, Any] = {**markers.tracked, **markers.reference}
        nominal = {label: np.add(place, moved.get(label, 0.0)) for label, place in known.items()}
        quality = TypeAdapter(dict[str, Quality]).validate_python(read_json(self.common / QUALITY))
        registered: dict[str, RegistrationSummary] = read_json(self.common / REGISTRATION)
        return Recordings(quality, registered, nominal, beside, mesh)

    def _stretches(self, law: LawContent) -> dict[str, Any]:
        """Principal stretches at the centres of the cells, for the section on the law.

        Where markers are observed, the test trials are the body of the film, which is simulated.

        Returns:
            ``stretches``: the least and the largest one in the test trials, and in the training of
            the law. ``outside``: the share of cells and states of the test trials outside of the
            training; None if it is not known.
        """
        trials, film = self.trials, self.film
        learned = law.get("stretches")
        trained = (
            {} if learned is None else {"the training": (float(learned[0]), float(learned[1]))}
        )
        if trials.labels and film is None:
            return {"stretches": trained, "outside": None}
        name, bodies = "all test trials", trials.target
        if trials.labels and film is not None:
            name, bodies = f"the trial {film.trial}", next(reversed([*film.positions.values()]))
        values = principal_stretches(self.body.mesh, bodies.reshape(-1, *bodies.shape[-2:]))
        outside = (
            None
            if learned is None
            else share_outside(values, trained["the training"], modes_of(law))
        )
        return {
            "stretches": {name: (float(np.nanmin(values)), float(np.nanmax(values))), **trained},
            "outside": outside,
        }

    def _followed(self) -> list[FollowedPath]:
        """Paths that controllers followed in a simulated laboratory; empty without control."""
        if self.run.control is None or not self.run.is_laboratory:
            return []
        followed = []
        with read_hdf5(self.folder / DRIVEN, "driven") as file:
            controllers = [*map(str, read_attribute(file, "controllers"))]
            for name in map(str, read_attribute(file, "names")):
                shape, seconds = name.removesuffix("s").rsplit("_", 1)
                path = read_array(file, f"{name}/path", (None, 3)).astype(np.float64)
                points = read_array(
                    file, f"{name}/points", (len(controllers), len(path), 3)
                ).astype(np.float64)
                by_name = dict(zip(controllers, points, strict=True))
                followed.append(
                    FollowedPath(name=shape, seconds=float(seconds), path=path, points=by_name)
                )
        return followed

    def _driven_chambers(self) -> tuple[Chamber, ...]:
        """Chambers under pressure, in the order of the pressures."""
        by_name = {chamber.name: chamber for chamber in build_chambers(self.run, self.body.mesh)}
        names = () if self.driven is None or not by_name else self.driven.channels
        unknown = [name for name in names if name not in by_name]
        if unknown:
            raise DataFileError(
                f"{DATASET} has pressures of {', '.join(unknown)}, but the body's chambers are "
                f"{', '.join(by_name)}: use the mesh with which the trials were imported."
            )
        return tuple(by_name[name] for name in names)

    def _at_rest(self) -> tuple[Mesh, dict[str, FloatArray]]:
        """Mesh of the body at rest, and displacement (3,) of each marker there [m], by label.

        If trials begin at rest, this is the equilibrium of the uncorrected simulator without
        inputs; otherwise the body is undeformed.
        """
        mesh = self.body.mesh
        trials, film = self.trials, self.film
        model = "simulation"
        if film is None or model not in film.positions or film.trial not in trials.names:
            return mesh, {}
        row = trials.names.index(film.trial)
        if trials.begins[row] != "rest":
            return mesh, {}
        moved = trials.positions[model][row, 0] - trials.bound
        return Mesh(film.positions[model][0], mesh.cells), dict(
            zip(trials.labels, moved, strict=True)
        )
