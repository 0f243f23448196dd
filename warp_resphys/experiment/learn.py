"""Stage: trains the residual force of a model, or the network in place of the simulator."""

from ..io.resuming import StageContext
from ..io.safe_files import resume_checkpoint, write_checkpoint, write_json
from ..learning.fitting import Fitting, Snapshot, fit
from ..settings.stage_keys import StageSettings
from .build import choose_device
from .experiment import LAW, SIMFREE, Experiment
from .files import training_file, weights_file


def train(context: StageContext) -> None:
    """Trains a model; writes <model>.safetensors, with the selected weights, and training_<model>.json.

    An interrupted training resumes.
    """
    settings: StageSettings = context.settings
    model, folder, name = settings.model, context.run_dir, context.name
    checkpoint = folder / f"{name}.safetensors"
    resumed = resume_checkpoint(checkpoint, "training", context.fingerprint)

    def save(kept: Snapshot) -> None:
        write_checkpoint(checkpoint, "training", kept[0], {**kept[1], "fingerprint": context.fingerprint})

    learned = fit(fitting_of(Experiment(settings, folder), model), settings.training, name, resumed, save)
    write_json(folder / training_file(model), learned.training)
    learned.write(folder / weights_file(model), context.fingerprint)
    checkpoint.unlink(missing_ok=True)


def fitting_of(experiment: Experiment, model: str) -> Fitting:
    """Returns what the network of a model is fitted to."""
    settings, split, data_driven = experiment.settings, experiment.settings.split, model == SIMFREE
    return Fitting(
        experiment.model_simulator(model),
        experiment.motions,
        experiment.reconstructed("resphys" if data_driven else model),
        split.train,
        split.validation,
        experiment.identified(model),
        data_driven,
        settings.force_frame,
        settings.range_guard,
        experiment.sources(model)[0] == LAW,
        choose_device(settings.device),
    )
