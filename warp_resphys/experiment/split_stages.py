"""The stages of one split of the trials, from identification to report."""

from collections.abc import Callable, Sequence
from functools import partial
from inspect import signature
from typing import Any

from ..core.energies.catalogue import law_path
from ..io.atomic import digest
from ..io.fan_out import Workers
from ..io.resuming import Stage
from ..settings.body import TargetSettings
from ..settings.performed import Split
from ..settings.run import RunSettings
from ..settings.stage_keys import LEARNING, NETWORKS, StageSettings
from . import files
from .digests import files_read
from .experiment import LEARNED, SIMFREE
from .learning_stages import evaluate, identify, identify_law, reconstruct, train, train_actuator
from .mesh_check import check_mesh
from .report import make_report
from .shapes import try_shapes
from .splits import folds_of, test_groups
from .timing import time_models


class SplitStages:
    """The stages of one split in the order in which they run; see `learning_stages`."""

    def __init__(
        self, run: RunSettings, split: Split, shared: str, acquired: str, workers: Workers
    ) -> None:
        self.run, self.split, self.workers = run, split, workers
        self.stages: list[Stage] = []
        # Stages of the identification, which all others follow.
        self._identified: tuple[str, ...] = ()
        self._common: dict[str, Any] = {
            "files": files_read(run, run),
            "shared": shared,
            "split": split,
        }
        self._common["acquired"] = acquired

    def add(
        self,
        name: str,
        work: Callable[..., None],
        outputs: tuple[str, ...],
        keys: Sequence[str] = (),
        upstream: Sequence[str] = (),
        run: RunSettings | None = None,
        **values: Any,
    ) -> None:
        """Adds a stage.

        Args:
            name: of the stage.
            work: its function, which may take ``workers`` beside its context.
            outputs: its files.
            keys: of the run that it reads besides `LEARNING`.
            upstream: stages besides the identification whose files it reads.
            run: settings in place of those of the run.
            values: derived from the run.
        """
        work = (
            partial(work, workers=self.workers) if "workers" in signature(work).parameters else work
        )
        settings = StageSettings.reading(
            run or self.run, *LEARNING, *keys, **{**self._common, **values}
        )
        self.stages.append(Stage(name, work, outputs, settings, (*self._identified, *upstream)))

    def identification(self) -> None:
        """Adds the identification of parameters and law,
        its test on other bodies, and the learned actuator.
        """
        run = self.run.model_copy(update={"actuator": None, "control": None})
        digests = self._common["files"]
        if run.identify is not None:
            self.add(
                "identify",
                identify,
                (files.IDENTIFICATION,),
                ("seed",),
                run=run.model_copy(update={"law": None}),
            )
            self._identified = ("identify",)
        if run.law is not None:
            law = {} if run.law.file is None else {run.law.file: digest(law_path(run.law.file))}
            self.add(
                "identify_law",
                identify_law,
                (files.LAW_FILE,),
                ("name",),
                run=run,
                files=digests | law,
            )
            self._identified += ("identify_law",)
        if run.shapes:
            bodies = [body for shape in run.shapes.values() for body in (shape, shape.target_body)]
            keys = ("target", "shapes", "data.steps")
            self.add(
                "shapes",
                try_shapes,
                (files.SHAPES,),
                keys,
                run=run,
                files=digests | files_read(run, *bodies),
            )
        if self.run.actuator is not None:
            self.add("train_actuator", train_actuator, (files.ACTUATOR_FILE,))
            self._identified += ("train_actuator",)

    def learning(self) -> None:
        """Adds the reconstruction of residual forces, and the training of the networks."""
        run, split = self.run, self.split
        if run.reconstruction is None:
            return
        # For the published comparison, where all vertices are observed, test trials are
        # reconstructed, too.
        compared = split.test if run.markers is None and run.law is None else ()
        reconstructed = split.train + split.validation + compared
        for model in (model for model in LEARNED if model in run.models and model != SIMFREE):
            self.add(
                f"reconstruct_{model}",
                reconstruct,
                (files.reconstruction_file(model),),
                ("reconstruction", "network.acts"),
                model=model,
                reconstructed=reconstructed,
            )
            outputs = (files.weights_file(model), files.training_file(model))
            training = run.training_of(model)
            upstream = (f"reconstruct_{model}",)
            self.add(
                f"train_{model}", train, outputs, NETWORKS, upstream, model=model, training=training
            )
        outputs = (files.weights_file(SIMFREE), files.training_file(SIMFREE))
        training = run.training_of(SIMFREE)
        needed = () if run.markers is None else ("reconstruct_resphys",)
        alone = (
            run
            if run.markers is not None or run.target is None
            else _without_simulator(run, run.target)
        )
        self.add(
            "train_simfree",
            train,
            outputs,
            NETWORKS,
            needed,
            alone,
            model=SIMFREE,
            training=training,
        )

    def evaluation(self) -> None:
        """Adds the roll-outs of all models on the test trials,
        their times, and the error of the mesh.
        """
        run, split, groups = self.run, self.split, test_groups(self.run, self.split)
        calibration = (
            (split.validation or split.train)
            if run.markers is not None and folds_of(run) is None
            else ()
        )
        made = [
            stage.name
            for stage in self.stages
            if stage.name.startswith(("train_", "reconstruct_resphys"))
        ]
        self.add(
            "evaluate",
            evaluate,
            (files.ROLLOUTS, files.ERRORS),
            (*NETWORKS, "reconstruction", "published", "correct_uncorrected", "data.horizons"),
            made,
            groups=groups,
            calibration=calibration,
        )
        if run.timing:
            keys = (*NETWORKS, "reconstruction", "target")
            self.add("time", time_models, (files.TIMES,), keys, made, groups=groups)
        played = run.laboratory if run.is_laboratory else None
        same = played is not None and (played.mesh, played.parts) == (run.mesh, run.parts)
        if run.mesh_check is not None and not same:
            first = {"1": groups["1"]}
            self.add(
                "mesh_check",
                check_mesh,
                (files.MESH_CHECK,),
                (*NETWORKS, "mesh_check"),
                groups=first,
            )

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the files that all stages read, by path."""
        return dict(self._common["files"])

    def with_report(self) -> list[Stage]:
        """Returns all stages, with that of the report, which shows the whole configuration."""
        shown = [
            stage.name
            for stage in self.stages
            if stage.name in ("shapes", "evaluate", "time", "mesh_check", "drive")
        ]
        return [*self.stages, Stage("report", make_report, (files.REPORT,), self.run, tuple(shown))]


def _without_simulator(run: RunSettings, target: TargetSettings) -> RunSettings:
    """Settings of a network that replaces the simulator, without those that identify the latter."""
    without = dict.fromkeys(("identify", "law", "actuator"))
    return run.model_copy(update={"simulation": target.material, "shapes": {}, **without})
