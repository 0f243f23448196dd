"""The first stages of an experiment on recordings: from the laboratory to markers.h5."""

from collections.abc import Mapping
from typing import Any

from ...io.errors import DataFileError
from ...io.files import digest
from ...io.stages import Stage
from .files import MARKERS, QUALITY, REGISTRATION, TRUTH, recording_file
from .importing import import_recordings
from .synthesise import synthesise
from .trials import is_synthetic, trials_of

_SYNTHESISED = ("synthetic", "fixed", "gravity", "solver", "device", "dtype", "seed")
_SYNTHESISED_DATA = ("folder", "hung_on", "up", "limit")
_SYNTHESISED_MARKERS = ("followed", "others", "bind", "bind_to", "largest_distance")
_IMPORTED = ("data", "markers", "mesh", "gravity", "time_step")


def import_stages(config: Mapping[str, Any]) -> list[Stage]:
    """The stages ``synthesise``, where there are no recordings, and ``import``.

    Args:
        config: that `check_configuration` accepts.

    Raises:
        DataFileError: a recording that is not there.
    """
    trials = trials_of(config)
    imported: dict[str, Any] = {key: config[key] for key in _IMPORTED}
    if config["mesh"]["kind"] == "file":
        imported["mesh_digest"] = digest(config["mesh"]["path"])
    outputs = (MARKERS, QUALITY, REGISTRATION)
    if not is_synthetic(config):
        imported["recordings"] = {trial.name: _digest(trial.name, trial.file) for trial in trials}
        return [Stage("import", import_recordings, outputs, imported)]
    settings = {key: config[key] for key in _SYNTHESISED}
    settings["data"] = {key: config["data"].get(key) for key in _SYNTHESISED_DATA}
    settings["markers"] = {key: config["markers"][key] for key in _SYNTHESISED_MARKERS}
    files = (*(recording_file(trial.name) for trial in trials), TRUTH)
    return [
        Stage("synthesise", synthesise, files, settings),
        Stage("import", import_recordings, outputs, {**imported, "synthetic": config["synthetic"]}, ("synthesise",)),
    ]


def _digest(trial: str, path: Any) -> str:
    try:
        return digest(path)
    except OSError as error:
        raise DataFileError(
            f"cannot read {path} ({error.strerror}): check data.folder and data.trials.{trial}.file."
        ) from error
