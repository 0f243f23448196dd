"""The `Experiment` that all stages share: the body, its trials, its simulators and its models."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import torch
from numpy.typing import NDArray

from ..core.dynamics.simulator import Simulator
from ..core.fem.bodies import Body
from ..data.input_network import InputNetwork
from ..data.marker_view import ViewedMarkers
from ..data.markers import WHOLE_STATE, Observation
from ..data.trials import Trials
from ..io.safe_files import read_array, read_attribute, read_hdf5, read_json
from ..learning.comparison import Model
from ..learning.identification.search import Identification
from ..learning.observed_motions import ObservedMotions
from ..learning.parameters import split_name
from ..learning.residuals.correction import Learned
from ..learning.residuals.networks import NextState, ResidualForce, StateMap
from ..learning.residuals.reconstruction import ReconstructedTrials
from ..settings.body import MaterialSettings, SimulatorSettings
from ..settings.run import RunSettings
from ..settings.run_keys import models_of
from ..settings.stage_keys import StageSettings
from .build import bound_markers, build_body, build_simulator, force_sensor, marker_view_of
from .files import (
    ACTUATOR_FILE,
    DATASET,
    IDENTIFICATION,
    LAW_FILE,
    SCALED_DATASET,
    read_if_there,
    reconstruction_file,
    training_file,
    weights_file,
)
from .simulate import target_settings

LAW: Final = "law"
ACTUATOR: Final = "actuator"
SIMFREE: Final = "simfree"
# With prediction intervals, beside the baselines.
INTERVAL_MODELS: Final = ("sysid", LAW, ACTUATOR, SIMFREE, "resphys")
LEARNED: Final = (SIMFREE, "resphys_uncorrected", "resphys")
# By model: the simulator that it uses or corrects, and the identification that provides its
# parameters.
MODELS: Final[Mapping[str, tuple[str, str | None]]] = {
    "published": ("published", None),
    "simulation": ("simulation", None),
    "sysid_elastic": ("simulation", "sysid_elastic"),
    "sysid": ("identified", "sysid"),
    "law": ("law", "law"),
    "actuator": ("identified", "sysid"),
    "simfree": ("identified", "sysid"),
    "resphys_uncorrected": ("simulation", None),
    "resphys": ("identified", "sysid"),
}


def network_of(model: str) -> type[StateMap]:
    """Returns the class of a learned model's network."""
    return NextState if model == SIMFREE else ResidualForce


def read_actuator(folder: Path) -> dict[str, InputNetwork]:
    """Networks of actuator.json by input; none without the file."""
    plain = read_if_there(folder / ACTUATOR_FILE).get("inputs", {})
    return {name: InputNetwork.of_plain(network) for name, network in plain.items()}


def training_files(folder: Path, run: RunSettings) -> dict[str, Path]:
    """Files with the epochs of what a run learned and the weights that were kept, by model.

    Some may be missing.
    """
    files = {ACTUATOR: folder / ACTUATOR_FILE} if run.with_actuator else {}
    forces = () if run.reconstruction is None else LEARNED
    return {**files, **{model: folder / training_file(model) for model in forces}}


@dataclass(frozen=True)
class Experiment:
    """The trials and the simulators of an experiment.

    Attributes:
        settings: settings of the stage.
        folder: folder of the split.
        on_failure: whether a failed step raises an error (``raise``) or is counted (``count``).
    """

    settings: StageSettings
    folder: Path
    on_failure: str = "raise"

    @cached_property
    def trials(self) -> Trials:
        """All trials, including those with scaled inputs if the stage tests them."""
        shared = self.folder / self.settings.shared
        trials = Trials.read(shared / DATASET)
        if len(self.settings.groups) > 1:
            trials = trials.joined(Trials.read(shared / SCALED_DATASET))
        return trials

    @cached_property
    def body(self) -> Body:
        """The simulated body."""
        return build_body(self.settings)

    @cached_property
    def _simulators(self) -> dict[str, Simulator]:
        return {}

    def simulator(self, kind: str) -> Simulator:
        """Returns a simulator with the gravity of the trials.

        Args:
            kind: ``simulation`` (uncorrected), ``target`` (which generated the trials),
                ``published``, ``identified``, which may use another integrator and a shorter time
                step, or ``law``, which has an identified material as well.
        """
        if kind not in self._simulators:
            body = None if kind in ("published", "target") else self.body
            made_of, material = self.settings_of(kind), self.material_of(kind)
            self._simulators[kind] = build_simulator(
                made_of, material, body, on_failure=self.on_failure
            )
        return self._simulators[kind]

    def settings_of(self, kind: str) -> SimulatorSettings:
        """Settings of a simulator of some kind, see `simulator`."""
        settings, identified = self.settings, self.settings.identify
        changes: dict[str, Any] = {"gravity": tuple(self.trials.gravity.tolist())}
        if kind == "published":
            published = settings.published
            assert published is not None
            changes |= {"physics": published.physics, "integrator": published.integrator}
        elif (
            kind in ("identified", LAW)
            and identified is not None
            and identified.integrator is not None
        ):
            changes |= {
                "integrator": identified.integrator,
                "time_step": settings.time_step / identified.substeps,
            }
        chosen = (
            target_settings(settings, settings.target)
            if kind == "target"
            else SimulatorSettings.of(settings)
        )
        return chosen.model_copy(update=changes)

    def material_of(self, kind: str) -> MaterialSettings:
        """Material of a simulator of some kind, see `simulator`."""
        if kind == "published":
            assert self.settings.published is not None
            return self.settings.published.simulation
        if kind == LAW:
            law = read_json(self.folder / LAW_FILE)
            return MaterialSettings(model=law["model"], **law["parameters"])
        return self.settings.target.material if kind == "target" else self.settings.simulation

    @property
    def like(self) -> torch.Tensor:
        """A tensor with the device and data type of the simulators."""
        return self.simulator("simulation").rest_positions

    @cached_property
    def motions(self) -> ObservedMotions:
        """The trials with their observation: M markers, or all vertices."""
        settings, trials = self.settings, self.trials
        observe: Observation = WHOLE_STATE
        if trials.bound is not None:
            markers = settings.markers
            assert markers is not None
            bound = bound_markers(markers, self.body.mesh, trials.bound, trials.labels)
            observe = ViewedMarkers.of(
                bound, marker_view_of(markers, trials.labels, trials.sets)
            ).to(self.like)
        sensors = {name: force_sensor(settings.sensors[name]) for name in trials.loads}
        more: dict[str, Any] = (
            {"actuation": settings.actuation} if "actuation" in settings.reads else {}
        )
        return ObservedMotions(
            trials,
            observe,
            settings.release,
            settings.payload_at,
            train_fraction=settings.train_fraction,
            sensors=sensors,
            **more,
        )

    def identified(self, model: str) -> Identification:
        """Returns what was identified of a model's simulator,
        with the learned actuator if the model uses it.
        """
        found = self._parameters_of(model)
        if model not in (ACTUATOR, "resphys") or not self.has_actuator:
            return found
        return replace(
            found,
            actuator=self._actuator,
            test=read_json(self.folder / ACTUATOR_FILE)["kept"]["test"],
        )

    @cached_property
    def _actuator(self) -> dict[str, InputNetwork]:
        """Networks of the learned actuator, by input."""
        return {
            name: network.to(self.like.device)
            for name, network in read_actuator(self.folder).items()
        }

    def _parameters_of(self, model: str) -> Identification:
        """Parameters of a model's simulator, their uncertainty and marker places; or none."""
        key = self.sources(model)[1]
        if key is None or (key != LAW and self.settings.identify is None):
            return Identification()
        identified = Identification.read(self.folder / IDENTIFICATION)
        if key != LAW:
            return identified[key]
        sysid = identified.get("sysid", Identification())
        parameters = read_json(self.folder / LAW_FILE)["others"]
        of_trials = {
            name: value
            for name, value in sysid.of_trials.items()
            if split_name(name)[0] in parameters
        }
        return Identification(parameters, of_trials, sysid.placement, sysid.first_frames)

    def parameters(self, model: str) -> dict[str, torch.Tensor]:
        """(1,) identified parameters of a model's simulator, by name, and those of trials.

        Empty without any.
        """
        return self.identified(model).values(self.simulator("simulation"))

    @property
    def models(self) -> list[str]:
        """Names of the models that are compared.

        Law and actuator are among them if they help on held-out trials.
        """
        settings, found = self.settings, (self.has_law, self.has_actuator, self.has_forces)
        return models_of(
            settings.published, settings.identify, settings.correct_uncorrected, *found
        )

    @property
    def has_forces(self) -> bool:
        """Whether forces are reconstructed and learned."""
        return self.settings.reconstruction is not None

    @property
    def has_law(self) -> bool:
        """Whether a law was identified, and helps on the validation trials."""
        return self.settings.with_law and bool(
            read_if_there(self.folder / LAW_FILE).get("accepted")
        )

    @property
    def has_actuator(self) -> bool:
        """Whether changes of the inputs were learned, and help on held-out trials."""
        learned = read_if_there(self.folder / ACTUATOR_FILE) if self.settings.with_actuator else {}
        return bool(learned) and ((test := learned["kept"]["test"]) is None or test["used"])

    def sources(self, model: str) -> tuple[str, str | None]:
        """Returns the entry of `MODELS`; actuator and force correct the law, if there is one."""
        return MODELS[LAW if model in (ACTUATOR, "resphys") and self.has_law else model]

    def model_simulator(self, model: str) -> Simulator:
        """The simulator that a model uses or corrects."""
        kind = self.sources(model)[0]
        return self.simulator(
            "simulation" if kind == "identified" and self.settings.identify is None else kind
        )

    def model(self, name: str) -> Model:
        """Returns a model that is compared, with what this run has learned for it."""
        learned = self.learned(name)
        return Model(
            self.model_simulator(name), self.identified(name), learned, name in INTERVAL_MODELS
        )

    def learned(self, model: str) -> Learned | None:
        """Trained network of a model.

        None for models without one, and for a force that is no clear gain.

        Raises:
            DataFileError: the file is missing or damaged.
        """
        if model not in LEARNED or not self.has_forces:
            return None
        learned = Learned.read(
            self.folder / weights_file(model), network_of(model), self.like.device
        )
        refused = (
            learned.test is not None and not learned.test["used"] and not learned.replaces_simulator
        )
        return None if refused else learned

    def reconstructed(self, model: str) -> ReconstructedTrials | None:
        """Trials that were reconstructed with a model's simulator; None without any."""
        path = self.folder / reconstruction_file(model)
        if not path.is_file():
            return None
        with read_hdf5(path, "reconstruction") as file:
            names = tuple(map(str, read_attribute(file, "names")))

        def read(name: str) -> NDArray[Any]:
            with read_hdf5(path, "reconstruction") as file:
                return read_array(file, name)

        return ReconstructedTrials(names, read)
