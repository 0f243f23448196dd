"""Stage: reconstructs the residual forces with which a simulator follows the observed trials."""

import numpy as np

from ..io.fan_out import ALONE, Workers
from ..io.parts import Parts
from ..io.resuming import StageContext
from ..io.safe_files import atomic_hdf5, create, write_json
from ..learning import reconstruction
from ..settings.stage_keys import StageSettings
from .experiment import Experiment
from .files import RECONSTRUCTION, read_if_there, reconstruction_file


def reconstruct(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes reconstruction_<model>.h5, see `ReconstructedTrials`, and adds to reconstruction.json.

    The summary has the distance between reconstructed and observed points.
    """
    settings: StageSettings = context.settings
    experiment, model, folder = Experiment(settings, context.run_dir), settings.model, context.run_dir
    parts = Parts.of(context, workers, settings.batch)
    found = reconstruction.reconstruct(
        experiment.model_simulator(model),
        experiment.motions,
        settings.reconstructed,
        parameters=experiment.identified(model),
        settings=settings.reconstruction,
        parts=parts,
    )
    with atomic_hdf5(folder / reconstruction_file(model), "reconstruction", {"names": [*found.names]}) as file:
        for name, unit in reconstruction.UNITS.items():  # One array at a time, as many trials take much memory.
            create(file, name, found.read(name), unit, time_axis=1)
    errors = found.read("error")
    summary = {"mean_mm": float(np.nanmean(errors)), "max_mm": float(np.nanmax(errors))}
    write_json(folder / RECONSTRUCTION, {**read_if_there(folder / RECONSTRUCTION), model: summary})
    parts.remove()
