"""All that a robot consists of, as plain data and tensors: from a run folder, to one safe file and back."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch

from ..data.marker_view import ViewedMarkers
from ..data.markers import Markers
from ..dynamics.simulator import Simulator
from ..experiment.build import bound_markers, build_body, build_simulator, marker_view_of
from ..experiment.experiment import LEARNED, MODELS, Experiment
from ..experiment.files import ERRORS, IDENTIFICATION, fold_folder, read_if_there
from ..experiment.models import SIMFREE, Learned, kind_of, learned_of
from ..io.errors import DataFileError, InputError, listed
from ..io.files import read_checkpoint, write_checkpoint
from ..io.settings import Settings, parse
from ..io.stages import finished_record
from ..learning.intervals import LEVEL, Intervals
from ..learning.networks import restore
from ..learning.placement import PlacedMarkers, Placement
from ..learning.predictors import Range
from ..mesh.mesh import Mesh
from ..settings.body import MaterialSettings, PlaceSettings, SimulatorSettings
from ..settings.run import models_of
from ..settings.stages import EvaluateStage
from ..settings.trials import MarkerSettings

_KIND: Final = "robot"
_EVALUATE: Final = "evaluate"
_NETWORK: Final = "network."
_REGION: Final = "region."
_PLAIN: Final = (  # fields that are written as they are
    *("name", "model", "settings", "material", "parameters", "uncertainty", "payload_at", "markers", "labels", "sets"),
    *("placement", "filters", "sees_payload", "told_of_base", "seen", "level", "errors_mm"),
)

_SETTINGS: Final[Mapping[str, type[Settings]]] = {
    "settings": SimulatorSettings,
    "material": MaterialSettings,
    "payload_at": PlaceSettings,
    "markers": MarkerSettings,
}


@dataclass(frozen=True)
class Description:
    """What a robot is.

    Attributes:
        name: of the experiment and the run.
        model: which of the experiment's models, such as ``resphys``.
        settings: that its simulator is made of, but for the mesh and the device.
        material: of its body, before identification.
        mesh: its rest shape.
        parameters: identified values by name, see `learning.parameters`.
        uncertainty: their standard deviations and correlations, where the identification has them.
        payload_at: the vertices that a payload hangs on; None for none.
        markers: their settings; None where every vertex is observed.
        labels: of the M markers.
        bound: (M, 3) where they are bound on the undeformed body [m].
        placement: where identification found that they sit, as `Placement.plain` has it.
        learned: the network, with its range and how its forces turn; None for a simulator alone.
        filters: time constants of the means of the inputs that the network is told of [s].
        sees_payload: whether it is told of the payload.
        told_of_base: which of the 15 numbers of `frames.base_movement` it is told; None if it is told none.
        seen: by input, the least and the largest value of each part in the experiment's trials.
        intervals: half-widths of the markers' prediction intervals, at `level`.
        level: share of the coordinates that the intervals are to cover.
        errors_mm: of the model in the trials that tested it, as errors.json has them.
    """

    name: str
    model: str
    settings: SimulatorSettings
    material: MaterialSettings
    mesh: Mesh
    parameters: Mapping[str, float] = field(default_factory=dict)
    uncertainty: Mapping[str, Any] | None = None
    payload_at: PlaceSettings | None = None
    markers: MarkerSettings | None = None
    labels: tuple[str, ...] = ()
    sets: tuple[tuple[int, ...], ...] = ()
    bound: torch.Tensor | None = None
    placement: Mapping[str, Any] | None = None
    learned: Learned | None = None
    filters: tuple[float, ...] = ()
    sees_payload: bool = False
    told_of_base: tuple[bool, ...] | None = None
    seen: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(default_factory=dict)
    intervals: Intervals | None = None
    level: float = LEVEL
    errors_mm: Mapping[str, Any] = field(default_factory=dict)

    def simulator(self, device: torch.device, on_failure: str) -> Simulator:
        """The simulator of its model."""
        settings = self.settings.model_copy(update={"device": str(device)})
        body = build_body(settings, self.payload_at, self.mesh)
        return build_simulator(settings, self.material, body, on_failure=on_failure)

    def observe(self) -> Markers | None:
        """What markers a body shows, in float64 on the CPU; None where every vertex is observed."""
        if self.markers is None or self.bound is None:
            return None
        found = bound_markers(self.markers, self.mesh, self.bound.numpy(), self.labels)
        seen = ViewedMarkers.of(found, marker_view_of(self.markers, self.labels, self.sets))
        placed = self.placement
        return seen if placed is None else PlacedMarkers.of(seen, Placement.from_plain(placed, self.labels))

    def write(self, path: Path) -> None:
        """Writes one safetensors file whose metadata are JSON, for `read`.

        Raises:
            DataFileError: it cannot be written.
        """
        metadata: dict[str, Any] = {key: getattr(self, key) for key in _PLAIN}
        metadata["intervals"] = None if self.intervals is None else self.intervals.plain()
        tensors = {"vertices": torch.from_numpy(self.mesh.vertices), "cells": torch.from_numpy(self.mesh.cells)}
        tensors |= {f"{_REGION}{name}": torch.from_numpy(cells) for name, cells in self.mesh.regions.items()}
        tensors |= {} if self.bound is None else {"bound": self.bound}
        if self.learned is not None:
            network = self.learned.network
            tensors |= {f"{_NETWORK}{name}": each for name, each in network.state_dict().items()}
            metadata["network"] = {**network.description(), **self.learned.description()}
        write_checkpoint(path, _KIND, tensors, metadata)

    @classmethod
    def read(cls, path: Path) -> "Description":
        """From the file that `write` made.

        Raises:
            DataFileError: it is missing, damaged, or of another kind or version.
        """
        tensors, found = read_checkpoint(path, _KIND)
        known, learned = found.pop("network", None), None
        if known is not None:
            own = {name.removeprefix(_NETWORK): x for name, x in tensors.items() if name.startswith(_NETWORK)}
            network = restore(kind_of(found["model"])[0], own, known)
            range_ = None if known["range"] is None else Range.restore(known["range"], network.linear)
            learned = Learned(network, range_, known["force_frame"])
        intervals = found.pop("intervals")
        for key, kind in _SETTINGS.items():
            found[key] = None if found[key] is None else parse(kind, found[key], key)
        for key in ("labels", "filters"):
            found[key] = tuple(found[key])
        found["sets"] = tuple(tuple(some) for some in found["sets"])
        if found["told_of_base"] is not None:
            found["told_of_base"] = tuple(found["told_of_base"])
        found["seen"] = {key: (tuple(low), tuple(high)) for key, (low, high) in found["seen"].items()}
        regions = {name.removeprefix(_REGION): x.numpy() for name, x in tensors.items() if name.startswith(_REGION)}
        return cls(
            mesh=Mesh(tensors["vertices"].numpy(), tensors["cells"].numpy(), regions),
            bound=tensors.get("bound"),
            learned=learned,
            intervals=None if intervals is None else Intervals.from_plain(intervals),
            **found,
        )


def finished_experiment(folder: Path) -> Experiment:
    """The experiment of a run that is done.

    Raises:
        DataFileError: see `stages.finished_record`; or the run has a folder for each of its folds.
    """
    if not (folder / "stages" / f"{_EVALUATE}.json").is_file():
        folds = sorted(each.parent.parent for each in folder.glob(f"{fold_folder('*')}/stages/{_EVALUATE}.json"))
        if folds:
            names = listed([str(each) for each in folds])
            raise DataFileError(
                f"{folder} is a cross-validation, which has a robot for each fold: name one of {names}."
            )
    return Experiment(parse(EvaluateStage, finished_record(folder, _EVALUATE)["settings"]), folder)


def describe(folder: Path, model: str) -> Description:
    """What a robot of a finished run is.

    Args:
        folder: of the run, or of one of its folds.
        model: one of those that the experiment compares.

    Raises:
        DataFileError: see `finished_experiment`.
        InputError: the experiment has no such model.
        MeshError: the file with its mesh is not there any more.
    """
    experiment = finished_experiment(folder)
    made = experiment.settings
    assert isinstance(made, EvaluateStage)
    known = models_of(made.published, made.identified, made.correct_uncorrected)
    if model not in known:
        raise InputError(f"the model is {model!r}: {folder} has {listed(known)}.")
    kind, key = MODELS[model]
    kind = "simulation" if kind == "identified" and made.identified is None else kind
    simulator, dataset = experiment.simulator(kind), experiment.dataset
    found = read_if_there(folder / IDENTIFICATION).get(key or "", {})
    errors = read_if_there(folder / ERRORS)
    intervals = errors.get("intervals", {"level": LEVEL, "models": {}})
    learned, actuation = learned_of(experiment, model), made.actuation
    told = None if learned is None else experiment.told_of_base(simulator)
    return Description(
        name="/".join(folder.resolve().parts[-2:]),
        model=model,
        settings=experiment.settings_of(kind),
        material=experiment.material_of(kind),
        mesh=simulator.body.mesh,
        parameters=found.get("parameters", {}),
        uncertainty=found.get("uncertainty"),
        payload_at=made.payload_at,
        markers=made.markers,
        labels=dataset.labels,
        sets=dataset.sets,
        bound=None if dataset.bound is None else torch.from_numpy(dataset.bound),
        placement=found.get("placement"),
        learned=learned,
        filters=actuation.filter_time_constants,
        sees_payload=model in LEARNED and (actuation.sees_payload or model == SIMFREE),
        told_of_base=None if told is None else tuple(told.tolist()),
        seen={n: (tuple(x.min((0, 1)).tolist()), tuple(x.max((0, 1)).tolist())) for n, x in dataset.inputs.items()},
        intervals=Intervals.from_plain(intervals["models"][model]) if model in intervals["models"] else None,
        level=intervals["level"],
        errors_mm=errors.get("errors_mm", {}).get(model, {}),
    )
