"""Which trials an experiment on recordings has, and how they are split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...io.errors import InputError
from ..trajectories import SPLITS, Split, evenly

FOLDS = ("leave_one_out",)
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Trial:
    """One motion of the body.

    Attributes:
        name: also names its files.
        hung: weight that hangs on the body [kg].
        file: its recording; None where it is simulated.
    """

    name: str
    hung: float
    file: Path | None = None


def is_synthetic(config: Mapping[str, Any]) -> bool:
    """Whether there are no recordings, so that a simulation plays the real body."""
    return config["data"]["folder"] is None


def trials_of(config: Mapping[str, Any]) -> tuple[Trial, ...]:
    """The trials of an experiment, in the order of the files: that of the split, or, with folds, of ``data.trials``.

    Args:
        config: with the groups ``data`` and ``synthetic``.

    Raises:
        InputError: see `split_of`.
    """
    data = config["data"]
    if is_synthetic(config):
        hung = config["synthetic"]["trials"]
        return tuple(Trial(name, float(hung[name]["hung"])) for name in split_of(config).names)
    names = data["trials"] if data["folds"] else split_of(config).names
    folder = Path(data["folder"]).expanduser()
    return tuple(
        Trial(name, float(data["trials"][name]["hung"]), folder / data["trials"][name]["file"]) for name in names
    )


def split_of(config: Mapping[str, Any]) -> Split:
    """The configured split, of the recordings or, without any, of the simulated trials.

    Validation may be empty, as where there are few recordings.

    Raises:
        InputError: no trial to train on or to test on, an unknown trial, or one that is named twice.
    """
    group = "synthetic" if is_synthetic(config) else "data"
    settings = config[group]
    lists = {name: [str(each) for each in settings[name]] for name in SPLITS}
    for name in ("train", "test"):
        if not lists[name]:
            more = ", or set data.folds to leave_one_out" if group == "data" else ""
            raise InputError(f"{group}.{name} is empty: name one of {group}.trials there{more}.")
    for name, members in lists.items():
        for trial in members:
            if trial not in settings["trials"]:
                known = ", ".join(map(str, settings["trials"]))
                raise InputError(f"{group}.{name} names the trial '{trial}', which is not in {group}.trials: {known}.")
    everything = [(trial, name) for name, members in lists.items() for trial in members]
    for place, (trial, name) in enumerate(everything):
        before = [other for same, other in everything[:place] if same == trial]
        if before:
            where = f"twice in {group}.{name}" if before[0] == name else f"in {group}.{before[0]} and {group}.{name}"
            raise InputError(f"the trial '{trial}' is {where}: every trial is in one split, once.")
    limit = config["data"].get("limit")
    if limit is not None:
        lists = {name: evenly(members, limit[name]) if members else [] for name, members in lists.items()}
    return Split(*(tuple(lists[name]) for name in SPLITS))


def folds_of(config: Mapping[str, Any]) -> dict[str, Split] | None:
    """By the name of the trial that is tested: the splits of a cross-validation; None where there is one split.

    A fold trains on all other trials and has none to validate with. With ``data.limit`` there are fewer folds, and each
    trains on fewer trials, evenly picked.

    Raises:
        InputError: fewer than two trials.
    """
    if is_synthetic(config) or not config["data"]["folds"]:
        return None
    names = [trial.name for trial in trials_of(config)]
    if len(names) < 2:
        raise InputError("data.folds is leave_one_out, which needs two trials or more in data.trials.")
    limit = config["data"].get("limit") or {"train": len(names), "test": len(names)}
    others = {name: [each for each in names if each != name] for name in evenly(names, limit["test"])}
    return {name: Split(tuple(evenly(row, limit["train"])), (), (name,)) for name, row in others.items()}


def vertical(up: str | Sequence[float] | None) -> NDArray[np.float64] | None:
    """(3,) unit vector against gravity in the frame of the recordings; None if that is not known.

    Args:
        up: ``x``, ``-x``, ``y`` and so on, or three numbers.

    Raises:
        InputError: anything else, or a vector of no length.
    """
    if up is None:
        return None
    if isinstance(up, str):
        axis = up.removeprefix("-").removeprefix("+")
        if axis in _AXES:
            return np.eye(3)[_AXES.index(axis)] * (-1.0 if up.startswith("-") else 1.0)
    elif len(up) == 3:
        vector = np.asarray(up, dtype=np.float64)
        if np.isfinite(vector).all() and vector.any():
            return np.asarray(vector / np.linalg.norm(vector))
    raise InputError(f"data.up is {up!r}: give x, -x, y, -y, z, -z, three numbers, or null.")
