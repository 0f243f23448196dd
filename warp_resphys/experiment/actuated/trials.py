"""Which trials an experiment with pressures has, and how they are split."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...io.errors import DataFileError, InputError
from ..measured.files import recording_file
from ..trajectories import SPLITS, Split, evenly
from .files import RAISED_RECORDINGS

_SUFFIXES = (".h5", ".hdf5", ".npz", ".c3d", ".tsv", ".csv")


@dataclass(frozen=True)
class Trial:
    """One motion of the body.

    Attributes:
        name: also names its files.
        file: its recording; None where it is simulated.
        sequence: number of its pressures, where they are drawn.
        factor: by which they are raised.
    """

    name: str
    file: Path | None = None
    sequence: int = 0
    factor: float = 1.0

    @property
    def made(self) -> str:
        """Its recording in the run folder, where it is simulated; those at higher pressures have their own."""
        return recording_file(self.name) if self.factor == 1.0 else f"{RAISED_RECORDINGS}/{self.name}.h5"


def is_synthetic(config: Mapping[str, Any]) -> bool:
    """Whether there are no recordings, so that a simulation plays the real body."""
    return config["data"]["folder"] is None


def split_of(config: Mapping[str, Any]) -> Split:
    """The trials of training, validation and test, without those at higher pressures.

    A split is a list of names, or a number of trials: these are taken in order, of training first.

    Raises:
        InputError: an unknown trial, one in two splits, more than there are, or none to train, to validate or to test.
        DataFileError: see `_known`.
    """
    data = config["data"]
    known = _known(config)
    counted, lists = 0, {}
    wanted_at_least = sum(data[name] for name in SPLITS if isinstance(data[name], int))
    if wanted_at_least > len(known):
        raise InputError(
            f"data.train, data.validation and data.test ask for {wanted_at_least} trials, but there are {len(known)}."
        )
    for name in SPLITS:
        wanted = data[name]
        if isinstance(wanted, int):
            lists[name] = known[counted : counted + wanted]
            counted += wanted
        else:
            lists[name] = [str(each) for each in wanted]
        unknown = [each for each in lists[name] if each not in known]
        if unknown:
            raise InputError(f"data.{name} names the trial '{unknown[0]}', which is not among {', '.join(known)}.")
        if not lists[name]:
            raise InputError(f"data.{name} leaves no trial: give the split at least one.")
    everything = [trial for name in SPLITS for trial in lists[name]]
    twice = [trial for trial in everything if everything.count(trial) > 1]
    if twice:
        raise InputError(f"the trial '{twice[0]}' is in two splits, or twice in one: every trial is in one, once.")
    if data["limit"] is not None:
        lists = {name: evenly(row, data["limit"][name]) for name, row in lists.items()}
    return Split(*(tuple(lists[name]) for name in SPLITS))


def raised(name: str, factor: float) -> str:
    """The name of a test trial at higher pressures."""
    return f"{name}_x{factor:g}"


def groups_of(config: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """By pressure factor, the trials that are tested; the first is that of the training, ``1``."""
    test = split_of(config).test
    factors = [float(factor) for factor in config["data"]["factors"]]
    return {"1": test} | {f"{factor:g}": tuple(raised(name, factor) for name in test) for factor in factors}


def trials_of(config: Mapping[str, Any]) -> tuple[Trial, ...]:
    """The trials of training, validation and test, in this order.

    Raises:
        InputError: see `split_of`.
        DataFileError: see `_known`.
    """
    split = split_of(config)
    if is_synthetic(config):
        found = {name: Trial(name, sequence=int(name.removeprefix("t"))) for name in split.names}
    else:
        files = _files(config["data"])
        found = {name: Trial(name, files[name]) for name in split.names}
    return tuple(found.values())


def raised_trials_of(config: Mapping[str, Any]) -> tuple[Trial, ...]:
    """The test trials at higher pressures, factor by factor.

    Raises:
        InputError: see `split_of`.
    """
    names = split_of(config).test
    test = [trial for trial in trials_of(config) if trial.name in names]
    return tuple(
        replace(trial, name=raised(trial.name, float(factor)), factor=float(factor))
        for factor in config["data"]["factors"]
        for trial in test
    )


def _known(config: Mapping[str, Any]) -> list[str]:
    """Names of all trials there are."""
    data = config["data"]
    if is_synthetic(config):
        return [f"t{number:03d}" for number in range(data["sequences"])]
    return [*_files(data)]


def _files(data: Mapping[str, Any]) -> dict[str, Path]:
    """By the name of the trial, the recordings in the folder: those that are named, or all.

    Raises:
        DataFileError: there is no such folder, or no recording in it.
    """
    folder = Path(data["folder"]).expanduser()
    if not folder.is_dir():
        raise DataFileError(f"{folder} is no folder: set data.folder to that of the recordings.")
    if data["trials"]:
        return {str(name): folder / file for name, file in data["trials"].items()}
    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in _SUFFIXES]
    if not paths:
        raise DataFileError(f"{folder} holds no recording ({', '.join(_SUFFIXES)}): set data.folder to that of yours.")
    found: dict[str, Path] = {}
    for path in paths:
        other = found.setdefault(path.stem, path)
        if other != path:
            raise DataFileError(
                f"{folder} has {other.name} and {path.name}, two recordings of one name: list the trials in "
                "data.trials."
            )
    return found
