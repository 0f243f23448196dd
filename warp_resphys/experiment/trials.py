"""Which trials an experiment has, how each begins, and how they are split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from ..io.errors import DataFileError, InputError

T = TypeVar("T")

SPLITS: Final = ("train", "validation", "test")
FOLDS: Final = ("leave_one_out",)
# Held at rest until it is let go; let go with the first frame; at rest until its inputs come; a pose without time.
BEGINNINGS: Final = ("held", "released", "rest", "static")
_SUFFIXES = (".h5", ".hdf5", ".npz", ".c3d", ".tsv", ".csv")
_SCALED_RECORDINGS = "recordings_scaled"  # not beside the others: that folder may become another experiment's data


@dataclass(frozen=True)
class Trial:
    """One motion of the body, or one pose.

    Attributes:
        name: also names its files.
        begins: one of `BEGINNINGS`; ``given`` where a simulation knows the state.
        file: its recording; None where it is simulated.
        payload: mass that hangs on the body [kg].
        pull: force that holds the body before the release, where the laboratory is simulated [N].
        sequence: number of its pressures, where they are drawn; None without any.
        scale: by which these are multiplied.
        amount: what sets simulated trajectories apart: a weight [kg], an angle [rad], or a factor of `base_motion`.
        inputs: what drives it all the time, one number for each part of the body; None where the recording tells.
        onset: when these come, on the clock of the recording [s]; with its first frame, if left out.
        input_delay: how much later than its log says what drives it came, as clocks differ; negative for earlier [s].
        labels: of the markers of its recording, in their order; None where that tells. It has no others.
        base_motion: how what it is fixed to moves, if otherwise than ``data.base_motion`` says; see
            `data.base_motion.prescribed`.
    """

    name: str
    begins: str
    file: Path | None = None
    payload: float = 0.0
    pull: tuple[float, ...] | None = None
    sequence: int | None = None
    scale: float = 1.0
    amount: float = 0.0
    inputs: Sequence[float] | None = None
    onset: float | None = None
    input_delay: float = 0.0
    labels: Sequence[str] | None = None
    base_motion: Mapping[str, Any] | None = None

    @property
    def is_released(self) -> bool:
        """Whether it is let go at time zero."""
        return self.begins in ("held", "released")

    def tracked(self, known: Sequence[str]) -> list[int]:
        """Which of the tracked markers it has, by their numbers."""
        return [number for number, label in enumerate(known) if self.labels is None or label in self.labels]

    @property
    def recording(self) -> str:
        """Where its recording is in the run folder, if the laboratory is simulated."""
        return f"{'recordings' if self.scale == 1.0 else _SCALED_RECORDINGS}/{self.name}.h5"


@dataclass(frozen=True)
class Split:
    """Names of the trials of each split; their order is that of the files.

    A trial of which a part is learned from (``data.train_fraction``) may be tested on the rest of it.
    """

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return tuple(dict.fromkeys(self.train + self.validation + self.test))

    def plain(self) -> dict[str, list[str]]:
        """As settings of a stage."""
        return {name: list(getattr(self, name)) for name in SPLITS}


@dataclass(frozen=True)
class Variation:
    """What sets the trajectories of a simulated experiment apart.

    Attributes:
        key: under ``data``, with a list for each split.
        unit: of the configured values.
        factor: from there to SI units.
    """

    key: str
    unit: str
    factor: float

    def name(self, value: float) -> str:
        """Of the trajectory with a configured value."""
        return f"{value:g}{'' if self.unit == '°' else ' '}{self.unit}"


VARIATIONS: Final = {
    "release_from_load": Variation("weights_g", "g", 1e-3),
    "release_from_twist": Variation("angles_deg", "°", np.pi / 180.0),
    "moving_base": Variation("amplitudes", "times", 1.0),
}


def sees_markers(config: Mapping[str, Any]) -> bool:
    """Whether bodies are observed through markers; else every vertex is."""
    return config.get("markers") is not None


def is_laboratory(config: Mapping[str, Any]) -> bool:
    """Whether there are no recordings, so that a simulated laboratory makes them."""
    return sees_markers(config) and config["data"]["folder"] is None


def variation_of(data: Mapping[str, Any]) -> Variation:
    """What sets simulated trajectories apart.

    Raises:
        InputError: an unknown kind.
    """
    if data.get("kind") not in VARIATIONS:
        raise InputError(f"data.kind is {data.get('kind')!r}: choose one of {', '.join(VARIATIONS)}.")
    found = VARIATIONS[data["kind"]]
    if found.key not in data:
        raise InputError(
            f"data.{found.key} is missing: data.kind {data['kind']} needs it, as "
            f"{{train: [..], validation: [..], test: [..]}} in {found.unit}."
        )
    return found


def known_trials(config: Mapping[str, Any]) -> dict[str, Trial]:
    """All trials there are, by name.

    Raises:
        DataFileError: there is no folder of recordings, or none in it.
    """
    data = config["data"]
    if not sees_markers(config):
        variation = variation_of(data)
        amounts = {variation.name(x): variation.factor * x for name in SPLITS for x in data[variation.key][name]}
        return {name: Trial(name, "given", amount=amount) for name, amount in amounts.items()}
    if not is_laboratory(config):
        return {name: replace(Trial(name, data["begins"]), **own) for name, own in _recordings(data).items()}
    found = {f"t{n:03d}": Trial(f"t{n:03d}", data["begins"], sequence=n) for n in range(data["sequences"])}
    for name, own in config["laboratory"]["trials"].items():
        new = Trial(str(name), data["begins"], sequence=len(found) if data["sequences"] else None)
        found[new.name] = replace(found.get(new.name, new), **own)
    return found


def _recordings(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The entries of the recordings in the folder, with their paths: those that are named, or all."""
    folder = Path(data["folder"]).expanduser()
    if data["trials"]:
        entries = {str(k): {"file": v} if isinstance(v, str) else dict(v) for k, v in data["trials"].items()}
        return {name: {**each, "file": folder / each["file"]} for name, each in entries.items()}
    if not folder.is_dir():
        raise DataFileError(f"{folder} is no folder: set data.folder to that of the recordings.")
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in _SUFFIXES:
            continue
        other = found.setdefault(path.stem, {"file": path})["file"]
        if other != path:
            raise DataFileError(
                f"{folder} has {other.name} and {path.name}, two recordings of one name: list the trials in "
                "data.trials."
            )
    if not found:
        raise DataFileError(f"{folder} holds no recording ({', '.join(_SUFFIXES)}): set data.folder to that of yours.")
    return found


def split_of(config: Mapping[str, Any]) -> Split:
    """The trials of training, validation and test.

    A split is a list of names, or a number of trials: these are taken in order, of training first. A laboratory that
    has a split of its own is asked first. Validation may be empty where the force is trained on whole motions.

    Raises:
        InputError: an unknown trial, one in two splits, more than there are, or none to train or to test.
        DataFileError: see `known_trials`.
    """
    data = config["data"]
    if not sees_markers(config):
        lists = _valued(data)
    else:
        group = "laboratory" if is_laboratory(config) and "train" in config["laboratory"] else "data"
        lists = _named(config, group)
    if data.get("limit") is not None:
        lists = {name: evenly(row, data["limit"][name]) if row else [] for name, row in lists.items()}
    return Split(*(tuple(lists[name]) for name in SPLITS))


def _valued(data: Mapping[str, Any]) -> dict[str, list[str]]:
    """The names of the trials that the splits of a simulated experiment list by their values."""
    kind = variation_of(data)
    values = {name: [float(x) for x in data[kind.key][name]] for name in SPLITS}
    for name, row in values.items():
        if not row:
            raise InputError(f"data.{kind.key}.{name} is empty: give the split at least one value.")
        if not all(np.isfinite(x) and x > 0.0 for x in row):
            raise InputError(f"data.{kind.key}.{name} holds a value that is not positive: {row}.")
    everything = [x for row in values.values() for x in row]
    twice = sorted({x for x in everything if everything.count(x) > 1})
    if twice:
        raise InputError(f"data.{kind.key} names {twice[0]:g} {kind.unit} twice: every trajectory is in one split.")
    return {name: [kind.name(x) for x in row] for name, row in values.items()}


def _named(config: Mapping[str, Any], group: str) -> dict[str, list[str]]:
    """The names that the splits of a group list or count."""
    known, settings = list(known_trials(config)), config[group]
    asked = sum(settings[name] for name in SPLITS if isinstance(settings[name], int))
    if asked > len(known):
        raise InputError(
            f"{group}.train, {group}.validation and {group}.test ask for {asked} trials, but there are {len(known)}."
        )
    rest, lists = iter(known), {}
    for name in SPLITS:
        wanted = settings[name]
        lists[name] = [*islice(rest, wanted)] if isinstance(wanted, int) else [str(each) for each in wanted]
        unknown = [each for each in lists[name] if each not in known]
        if unknown:
            raise InputError(
                f"{group}.{name} names the trial '{unknown[0]}', which is not in {group}.trials: {', '.join(known)}."
            )
        if not lists[name] and not (name == "validation" and config["in_the_loop"]):
            more = ", or set data.folds to leave_one_out" if group == "data" else ""
            raise InputError(f"{group}.{name} is empty: name one of {group}.trials there{more}.")
    seen: dict[str, str] = {}
    parted = config["data"].get("train_fraction", 0.0) < 1.0  # A stage that is not told it is told checked splits.
    for name, trial in ((name, trial) for name, members in lists.items() for trial in members):
        if trial in seen:
            if parted and (seen[trial], name) == ("train", "test"):
                continue
            other = seen[trial]
            where = f"twice in {group}.{name}" if other == name else f"in {group}.{other} and {group}.{name}"
            raise InputError(f"the trial '{trial}' is {where}: every trial is in one split, once.")
        seen[trial] = name
    return lists


def folds_of(config: Mapping[str, Any]) -> dict[str, Split] | None:
    """By the name of the trial that is tested: the splits of a cross-validation; None where there is one split.

    A fold trains on all other trials and has none to validate with. With ``data.limit`` there are fewer folds, and each
    trains on fewer trials, evenly picked.

    Raises:
        InputError: fewer than two trials.
    """
    data = config["data"]
    if not data.get("folds") or (is_laboratory(config) and "train" in config["laboratory"]):
        return None
    names = list(known_trials(config))
    if len(names) < 2:
        raise InputError("data.folds is leave_one_out, which needs two trials or more in data.trials.")
    limit = data.get("limit") or {"train": len(names), "test": len(names)}
    others = {name: [each for each in names if each != name] for name in evenly(names, limit["test"])}
    return {name: Split(tuple(evenly(row, limit["train"])), (), (name,)) for name, row in others.items()}


def trials_of(config: Mapping[str, Any]) -> tuple[Trial, ...]:
    """The trials of an experiment, in the order of the files: that of the split, or, with folds, as configured."""
    known = known_trials(config)
    return tuple(known[name] for name in (known if folds_of(config) else split_of(config).names))


def scaled_name(name: str, scale: float) -> str:
    """The name of a test trial at scaled inputs."""
    return f"{name}_x{scale:g}"


def scaled_trials_of(config: Mapping[str, Any]) -> tuple[Trial, ...]:
    """The test trials at ``data.input_scales``, scale by scale."""
    scales = [float(scale) for scale in config["data"].get("input_scales") or ()]
    if not scales:
        return ()
    known = known_trials(config)
    test = [known[name] for name in split_of(config).test]
    return tuple(replace(each, name=scaled_name(each.name, scale), scale=scale) for scale in scales for each in test)


def test_groups(config: Mapping[str, Any], split: Split) -> dict[str, list[str]]:
    """By scale of the inputs, the trials that are tested; the first is that of the training, ``1``."""
    scales = [float(scale) for scale in config["data"].get("input_scales") or ()]
    return {"1": list(split.test)} | {f"{s:g}": [scaled_name(name, s) for name in split.test] for s in scales}


def evenly(row: Sequence[T], limit: int) -> list[T]:
    """At most that many values of a row, one or more, spread over it."""
    places = np.linspace(0, len(row) - 1, min(limit, len(row))).round().astype(int)
    return [row[i] for i in places]
