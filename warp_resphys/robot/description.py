"""The description of a robot as plain data and tensors:
read from a run folder, written to one safe file and back.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike
from pydantic import TypeAdapter

from ..core.dynamics.simulator import Simulator
from ..core.energies.materials import MASS_DAMPING
from ..core.mesh.place import Place
from ..core.mesh.volume_mesh import Mesh
from ..data.input_network import InputNetwork
from ..data.marker_view import ViewedMarkers
from ..data.markers import Markers, Observation
from ..data.rigid_bodies import corners_of, owners
from ..experiment.build import bound_markers, build_body, build_simulator, marker_view_of
from ..experiment.experiment import LEARNED, SIMFREE, Experiment, network_of
from ..experiment.files import COMPARE, ERRORS, METRICS, fold_folder, read_if_there
from ..io.arrays import FloatArray
from ..io.classes import check_packages
from ..io.errors import DataFileError, InputError, listed, number_of
from ..io.resuming import finished_record, planned
from ..io.safe_files import read_checkpoint, write_checkpoint
from ..io.settings import Settings, packages_of, parse
from ..learning.error_tables import ErrorTables
from ..learning.identification.uncertainty import Uncertainty
from ..learning.intervals import LEVEL, Intervals
from ..learning.metrics import ErrorSummary
from ..learning.placement import PlacedMarkers, Placement, PlainPlacement
from ..learning.residuals.correction import Learned, Range
from ..learning.residuals.networks import NextState, restore
from ..settings.body import MaterialSettings, SimulatorSettings
from ..settings.learning import NetworkSettings
from ..settings.observed import MarkerSettings
from ..settings.stage_keys import StageSettings
from .construction import Plain, made

log = logging.getLogger(__name__)

SUFFIX: Final = ".safetensors"
_KIND: Final = "robot"
_EVALUATE: Final = "evaluate"
# By simulator: the stage after which it can be loaded.
_NEEDED: Final = {
    **dict.fromkeys(("simulation", "sysid", "sysid_elastic"), "identify"),
    "law": "identify_law",
    "actuator": "train_actuator",
}
_NETWORK: Final = "network."
_REGION: Final = "region."
_PLAIN: Final = (  # fields that are written unchanged
    "name",
    "model",
    "settings",
    "material",
    "parameters",
    "payload_at",
    "markers",
    "labels",
    "sets",
    "placement",
    "filters",
    "sees_payload",
    "told_of_base",
    "seen",
    "level",
    "errors_mm",
    "recommended",
)

_SETTINGS: Final[Mapping[str, type[Settings]]] = {
    "settings": SimulatorSettings,
    "material": MaterialSettings,
    "payload_at": Place,
    "markers": MarkerSettings,
}


@dataclass(frozen=True)
class Description:
    """Everything that defines a robot."""

    name: str  # of the experiment and the run
    model: str  # name of the experiment's model, such as ``resphys``
    settings: SimulatorSettings | None  # of its simulator, without mesh, device; None: `built`
    material: MaterialSettings | None  # of its body, before identification; None if it is `built`
    mesh: Mesh  # rest shape
    # identified values by name, see `learning.parameters`
    parameters: Mapping[str, float] = field(default_factory=dict)
    # standard deviations and correlations of the parameters, if identification estimated them
    uncertainty: Uncertainty | None = None
    payload_at: Place | None = None  # the vertices that a payload hangs on; None for none
    markers: MarkerSettings | None = (
        None  # settings of the markers; None if every vertex is observed
    )
    labels: tuple[str, ...] = ()  # of the M markers
    sets: tuple[tuple[int, ...], ...] = ()  # groups of markers, by their numbers
    bound: torch.Tensor | None = None  # (M, 3) positions of the markers on the undeformed body [m]
    placement: PlainPlacement | None = None  # identified positions of the markers
    # the network, with its input range and the frame of its forces; None for a simulator alone
    learned: Learned | None = None
    actuator: Mapping[str, InputNetwork] = field(default_factory=dict)  # changes of inputs, by name
    filters: tuple[float, ...] = ()  # time constants of the inputs that the network takes [s]
    sees_payload: bool = False  # whether the network takes the payload
    # (15,) which of the numbers of `frames.base_movement` the network takes; None for none
    told_of_base: tuple[bool, ...] | None = None
    # by input, the least and the largest value of each part in the experiment's trials
    seen: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(default_factory=dict)
    intervals: Intervals | None = (
        None  # half-widths of the markers' prediction intervals, at `level`
    )
    level: float = LEVEL  # nominal coverage of the intervals
    errors_mm: ErrorSummary | None = None  # of the model in the test trials
    recommended: str | None = (
        None  # model that the report of its run recommends; None if it is not known
    )
    built: Simulator | None = None  # a simulator of Python, in place of settings and material
    observation: Observation | None = (
        None  # what is observed of it, in place of `markers` and `bound`
    )

    def simulator(self, device: torch.device, on_failure: str) -> Simulator:
        """Builds the simulator."""
        if self.built is not None:
            solver = self.built.settings.changed(on_failure=on_failure)
            if (solver, device) == (self.built.settings, self.built.device):
                return self.built
            return replace(self.built, device=device, solver=solver, relative_tolerance=None)
        assert self.settings is not None
        assert self.material is not None
        settings = self.settings.model_copy(update={"device": str(device)})
        body = build_body(settings, self.mesh)
        return build_simulator(settings, self.material, body, on_failure=on_failure)

    def made_of(self, plain: Plain) -> list[Any]:
        """Returns what the simulator is made of as plain data,
        whose arrays are added to `plain`.
        """
        if self.settings is not None and self.material is not None:
            return [self.settings.plain(), self.material.plain()]
        return [plain.of(self.built, "simulator"), plain.of(self.observation, "markers")]

    def stepped_by(self, simulator: Simulator, without: Sequence[str] = ()) -> "Description":
        """Returns the description with integrator and gravity of a simulator,
        and without some parameters.
        """
        kept = {name: value for name, value in self.parameters.items() if name not in without}
        if self.settings is None:
            return replace(self, built=simulator, parameters=kept)
        gravity = tuple(np.asarray(simulator.gravity, dtype=np.float64).tolist())
        settings = self.settings.model_copy(
            update={"integrator": simulator.integrator, "gravity": gravity}
        )
        return replace(self, settings=settings, parameters=kept)

    def with_values(self, parameters: Mapping[str, torch.Tensor]) -> "Description":
        """Returns the description with other values (1,) of parameters.

        Raises:
            InputError: one has values of several environments.
        """
        values = dict(self.parameters)
        for name, value in parameters.items():
            if len(value) > 1:
                raise InputError(
                    f"{name} has {len(value)} values, "
                    "one for each environment: save a robot with one."
                )
            if name not in values or not torch.equal(value, value.new_tensor([values[name]])):
                values[name] = float(value)
        return replace(self, parameters=values)

    def to(self, device: torch.device) -> "Description":
        """Returns the description with its networks on a device."""
        learned = None if self.learned is None else self.learned.to(device)
        return replace(
            self,
            learned=learned,
            actuator={name: x.to(device) for name, x in self.actuator.items()},
        )

    def on(
        self, mesh: Mesh, parameters: Mapping[str, float], body: Mapping[str, Any]
    ) -> "Description":
        """Returns the description of a simulator with this material,
        without damping by mass, on another body.

        Args:
            mesh: rest shape.
            parameters: values of the material's constants that were identified.
            body: settings of the body that differ.

        Raises:
            InputError: an unknown or wrong setting, or a network in place of the simulator.
        """
        if self.learned is not None and isinstance(self.learned.network, NextState):
            raise InputError(
                f"{self.model} has no simulator, only a network for its mesh: load another model."
            )
        if self.settings is None or self.material is None:
            raise InputError(
                f"{self.name} was made from a simulator of Python, which is on its body: make a "
                "Simulator of the other body with robot.simulator.material, and Robot.of it."
            )
        settings = self.settings.changed(**body)
        material = MaterialSettings.model_validate({**self.material.plain(), MASS_DAMPING: None})
        return Description(self.name, self.model, settings, material, mesh, parameters)

    def observe(self) -> Observation | None:
        """Returns the map from vertices to markers, in float64 on the CPU.

        None if every vertex is observed.
        """
        seen = self.observation
        if self.markers is not None and self.bound is not None:
            bound = bound_markers(self.markers, self.mesh, self.bound.numpy(), self.labels)
            seen = ViewedMarkers.of(bound, marker_view_of(self.markers, self.labels, self.sets))
        if self.placement is None or not isinstance(seen, Markers):
            return seen
        return PlacedMarkers.of(seen, Placement.from_plain(self.placement, self.labels))

    def half_widths(self, markers: FloatArray, since: ArrayLike | None) -> FloatArray | None:
        """Half-widths (..., M) of prediction intervals,
        as for `Robot.half_widths`, of markers (..., M, 3) [m].
        """
        if self.intervals is None or self.bound is None:
            return None
        return self.intervals.half_widths(markers, self.bound.numpy(), since)

    def summary(self, time_step: float, inputs: Sequence[str]) -> str:
        """Returns a short description: vertices, markers,
        time step, lines of the inputs, parameters, error.
        """
        bodies = len(corners_of(self.labels))
        counts = {"marker": len(owners(self.labels)) - bodies, "rigid body": bodies}
        seen = (
            " and ".join(number_of(count, what) for what, count in counts.items() if count)
            or "no markers"
        )
        vertices = f"{len(self.mesh.vertices)} vertices"
        advice = "" if self.recommended is None else f" (the report recommends {self.recommended})"
        advice = " (recommended)" if self.recommended == self.model else advice
        body = f"{vertices}, {seen}, steps of {1e3 * time_step:g} ms"
        lines = [f"Robot {self.name}, {self.model}{advice}: {body}", *inputs]
        lines += [f"  identified {name}: {value:.6g}" for name, value in self.parameters.items()]
        if self.errors_mm is not None and self.errors_mm["mean"] is not None:
            lines.append(f"  mean error in the test trials: {self.errors_mm['mean']:.3g} mm")
        return "\n".join(lines)

    def _network(self) -> NetworkSettings | None:
        """Settings of the network."""
        return (
            None if self.learned is None else NetworkSettings(**self.learned.network.architecture)
        )

    def write(self, path: Path) -> Path:
        """Writes one safetensors file with JSON metadata.

        Raises:
            InputError: the name has another extension, or the simulator has a part that cannot be
                saved.
            DataFileError: the file cannot be written.
        """
        if path.suffix != SUFFIX:
            raise InputError(f"{path} does not end in {SUFFIX}: give such a name.")
        metadata: dict[str, Any] = {key: getattr(self, key) for key in _PLAIN}
        metadata["actuator"] = {name: network.plain() for name, network in self.actuator.items()}
        metadata["packages"] = packages_of(
            [self.settings, self.material, self.markers, self._network()]
        )
        metadata["intervals"] = None if self.intervals is None else self.intervals.plain()
        metadata["uncertainty"] = None if self.uncertainty is None else asdict(self.uncertainty)
        regions = {f"{_REGION}{name}": cells for name, cells in self.mesh.regions.items()}
        plain = Plain({"vertices": self.mesh.vertices, "cells": self.mesh.cells, **regions})
        metadata["built"] = plain.of(self.built, "simulator")
        metadata["observation"] = plain.of(self.observation, "markers")
        metadata["packages"] |= plain.packages
        tensors = plain.tensors
        tensors |= {} if self.bound is None else {"bound": self.bound}
        if self.learned is not None:
            network = self.learned.network
            tensors |= {
                f"{_NETWORK}{name}": weights for name, weights in network.state_dict().items()
            }
            metadata["network"] = {**network.description(), **self.learned.description()}
        write_checkpoint(path, _KIND, tensors, metadata)
        return path

    @classmethod
    def read(cls, path: Path) -> "Description":
        """Reads a file of `write`.

        Raises:
            DataFileError: the file is missing, damaged, of another kind or version, or made with a
                package that is not installed.
        """
        tensors, fields = read_checkpoint(path, _KIND)
        check_packages(fields.pop("packages", {}), path)
        stored, learned = fields.pop("network", None), None
        if stored is not None:
            weights = {
                name.removeprefix(_NETWORK): x
                for name, x in tensors.items()
                if name.startswith(_NETWORK)
            }
            network = restore(network_of(fields["model"]), weights, stored)
            range_ = (
                None if stored["range"] is None else Range.restore(stored["range"], network.linear)
            )
            learned = Learned(network, range_, stored["force_frame"])
        made_of = {
            key: made(fields.pop(key, None), tensors, path) for key in ("built", "observation")
        }
        intervals = fields.pop("intervals")
        actuator = {
            name: InputNetwork.of_plain(plain) for name, plain in fields.pop("actuator", {}).items()
        }
        for key, kind in _SETTINGS.items():
            fields[key] = None if fields[key] is None else parse(kind, fields[key], key)
        for key in ("labels", "filters", "told_of_base"):
            fields[key] = None if fields[key] is None else tuple(fields[key])
        fields["uncertainty"] = TypeAdapter(Uncertainty | None).validate_python(
            fields["uncertainty"]
        )
        fields["sets"] = tuple(tuple(members) for members in fields["sets"])
        fields["seen"] = {
            key: (tuple(low), tuple(high)) for key, (low, high) in fields["seen"].items()
        }
        regions = {
            name.removeprefix(_REGION): x.numpy()
            for name, x in tensors.items()
            if name.startswith(_REGION)
        }
        return cls(
            mesh=Mesh(tensors["vertices"].numpy(), tensors["cells"].numpy(), regions),
            bound=tensors.get("bound"),
            learned=learned,
            actuator=actuator,
            intervals=Intervals.from_plain(intervals),
            **fields,
            **made_of,
        )


def finished_experiment(folder: Path, model: str | None = None) -> Experiment:
    """Returns the experiment of a finished run.

    Args:
        folder: of the run, or of one of its folds.
        model: a simulator without a network, for which the run only has to have finished its
            identification.

    Raises:
        DataFileError: the run is missing, unfinished or changed, or it is a cross-validation.
    """
    if (folder / "stages" / f"{COMPARE}.json").is_file():
        raise DataFileError(
            f"{folder} has pictures, from which no robot is made: name a run with trials."
        )
    if not (folder / "stages" / f"{_EVALUATE}.json").is_file():
        records = folder.glob(f"{fold_folder('*')}/stages/{_EVALUATE}.json")
        folds = sorted(str(record.parent.parent) for record in records)
        if folds:
            raise DataFileError(
                f"{folder} is a cross-validation, which has a robot for each fold: "
                f"name one of {listed(folds)}."
            )
        needed, evaluated = _NEEDED.get(model or ""), planned(folder, _EVALUATE)
        if needed is not None and evaluated and (folder / "stages" / f"{needed}.json").is_file():
            if finished_record(folder, needed)["fingerprint"] != planned(folder, needed).get(
                "fingerprint"
            ):
                raise DataFileError(
                    f"{folder} is unfinished: the settings of '{needed}' changed; "
                    "run its command again."
                )
            log.info(
                "%s is not evaluated yet: errors and prediction intervals of %s are not known",
                folder,
                model,
            )
            return Experiment(_settings_of(evaluated), folder)
    return Experiment(_settings_of(finished_record(folder, _EVALUATE)), folder)


def _settings_of(record: Mapping[str, Any]) -> StageSettings:
    """Settings in the record of a stage.

    Those from before `reconstruction=none` lack the key: forces were learned.
    """
    settings = record["settings"]
    return parse(StageSettings, {**settings, "reads": [*settings["reads"], "reconstruction"]})


def describe(folder: Path, model: str | None = None) -> Description:
    """Returns the description of a robot of a finished run.

    Args:
        folder: of the run, or of one of its folds.
        model: one of those that the experiment compares; None: the one that its report recommends.

    Raises:
        DataFileError: the run is missing, unfinished or changed, or it is a cross-validation.
        InputError: the experiment has no such model.
        MeshError: the file with its mesh is missing.
    """
    experiment = finished_experiment(folder, model)
    settings, metrics = experiment.settings, read_if_there(folder / METRICS)
    models, advised = experiment.models, metrics.get("recommended") or None
    model = advised if model is None else model
    if model is None:
        raise DataFileError(
            f"{folder} recommends no model: name one of {listed(models)}, or run its command again."
        )
    if model not in models:
        raise InputError(f"the model is {model!r}: {folder} has {listed(models)}.")
    kind, _ = experiment.sources(model)
    kind = "simulation" if kind == "identified" and settings.identify is None else kind
    simulator, trials = experiment.simulator(kind), experiment.trials
    identified = experiment.identified(model)
    errors: ErrorTables = read_if_there(folder / ERRORS)
    calibrated = errors["intervals"]["models"].get(model, {}) if "intervals" in errors else {}
    learned, actuation = experiment.learned(model), settings.actuation
    if learned is None and model in LEARNED and experiment.has_forces:
        log.warning(
            "%s: the force of %s was learned and is not used; its report says why", folder, model
        )
    base = None if learned is None else experiment.motions.base_movement_mask(simulator)
    moved = trials.contact_at(trials.names, simulator.body, trials.time_step)
    return Description(
        name="/".join(folder.resolve().parts[-2:]),
        model=model,
        recommended=advised,
        settings=experiment.settings_of(kind),
        material=experiment.material_of(kind),
        mesh=simulator.body.mesh,
        parameters=identified.parameters,
        uncertainty=identified.uncertainty,
        payload_at=settings.payload_at,
        markers=settings.markers,
        labels=trials.labels,
        sets=trials.sets,
        bound=None if trials.bound is None else torch.from_numpy(trials.bound),
        placement=identified.placement,
        learned=learned,
        actuator=identified.actuator,
        filters=actuation.filter_time_constants,
        sees_payload=learned is not None and (actuation.sees_payload or model == SIMFREE),
        told_of_base=None if base is None else tuple(base.tolist()),
        seen={
            name: (tuple(x.min((0, 1)).tolist()), tuple(x.max((0, 1)).tolist()))
            for name, x in {**trials.inputs, **moved}.items()
        },
        intervals=Intervals.from_plain(calibrated.get("without_spread", calibrated)),
        level=errors["intervals"]["level"] if "intervals" in errors else LEVEL,
        errors_mm=errors.get("errors_mm", {}).get(model),
    )
