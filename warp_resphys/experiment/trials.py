"""Which trials an experiment has, how each begins, and how they are split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from ..io.errors import DataFileError, InputError
from ..settings.run import RunSettings
from ..settings.trials import LaboratorySettings, RecordedData, SimulatedData, Split, Trial, TrialSettings

T = TypeVar("T")

SPLITS: Final = ("train", "validation", "test")
_SUFFIXES = (".h5", ".hdf5", ".npz", ".c3d", ".tsv", ".csv")


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


def known_trials(run: RunSettings) -> dict[str, Trial]:
    """All trials there are, by name.

    Raises:
        DataFileError: there is no folder of recordings, or none in it.
    """
    data = run.data
    if not isinstance(data, RecordedData):
        variation = VARIATIONS[data.kind]
        values = (*data.amounts.train, *data.amounts.validation, *data.amounts.test)
        amounts = {variation.name(value): variation.factor * value for value in values}
        return {name: Trial(name=name, begins="given", amount=amount) for name, amount in amounts.items()}
    if data.folder is not None:
        folder = Path(data.folder).expanduser()
        entries = data.trials or _recordings(folder)
        return {
            name: _trial(name, each, data.begins, file=_in_folder(folder, name, each)) for name, each in entries.items()
        }
    assert run.laboratory is not None
    drawn = {f"t{number:03d}": number for number in range(data.sequences)}
    found = {name: Trial(name=name, begins=data.begins, sequence=number) for name, number in drawn.items()}
    for name, own in run.laboratory.trials.items():
        new = len(found) if data.sequences else None
        sequence = found[name].sequence if name in found else new
        found[name] = _trial(name, own, data.begins, sequence=sequence)
    return found


def _trial(name: str, own: TrialSettings, begins: str, file: str | None = None, sequence: int | None = None) -> Trial:
    """A trial from its entry in a table of trials."""
    return Trial(**{**dict(own), "name": name, "begins": own.begins or begins, "file": file, "sequence": sequence})


def _in_folder(folder: Path, name: str, own: TrialSettings) -> str:
    if own.file is None:
        raise InputError(f"data.trials.{name}.file is missing: give the name of a file in data.folder.")
    return str(folder / own.file)


def _recordings(folder: Path) -> dict[str, TrialSettings]:
    """The entries of all recordings in a folder."""
    if not folder.is_dir():
        raise DataFileError(f"{folder} is no folder: set data.folder to that of the recordings.")
    found: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in _SUFFIXES:
            continue
        other = found.setdefault(path.stem, path.name)
        if other != path.name:
            raise DataFileError(
                f"{folder} has {other} and {path.name}, two recordings of one name: list the trials in data.trials."
            )
    if not found:
        raise DataFileError(f"{folder} holds no recording ({', '.join(_SUFFIXES)}): set data.folder to that of yours.")
    return {name: TrialSettings(file=file) for name, file in found.items()}


def split_of(run: RunSettings) -> Split:
    """The trials of training, validation and test.

    A split is a list of names, or a number of trials: these are taken in order, of training first. A laboratory that
    has a split of its own is asked first. Validation may be empty where the force is trained on whole motions.

    Raises:
        InputError: an unknown trial, one in two splits, more than there are, or none to train or to test.
        DataFileError: see `known_trials`.
    """
    data = run.data
    lists = _named(run) if isinstance(data, RecordedData) else _valued(data)
    if data.limit is not None:
        lists = {name: evenly(row, getattr(data.limit, name)) if row else [] for name, row in lists.items()}
    return Split(train=tuple(lists["train"]), validation=tuple(lists["validation"]), test=tuple(lists["test"]))


def _valued(data: SimulatedData) -> dict[str, list[str]]:
    """The names of the trials that the splits of a simulated experiment list by their values."""
    kind = VARIATIONS[data.kind]
    values = {name: getattr(data.amounts, name) for name in SPLITS}
    for name, row in values.items():
        if not row:
            raise InputError(f"data.{kind.key}.{name} is empty: give the split at least one value, in {kind.unit}.")
    everything = [x for row in values.values() for x in row]
    twice = sorted({x for x in everything if everything.count(x) > 1})
    if twice:
        raise InputError(f"data.{kind.key} names {twice[0]:g} {kind.unit} twice: every trajectory is in one split.")
    return {name: [kind.name(x) for x in row] for name, row in values.items()}


def _splits(run: RunSettings) -> tuple[str, RecordedData | LaboratorySettings]:
    """The group whose split counts, and its name."""
    assert isinstance(run.data, RecordedData)
    if run.is_laboratory and run.laboratory is not None and run.laboratory.train is not None:
        return "laboratory", run.laboratory
    return "data", run.data


def _named(run: RunSettings) -> dict[str, list[str]]:
    """The names that the splits of a group list or count."""
    known, (group, settings) = list(known_trials(run)), _splits(run)
    wanted = {name: getattr(settings, name) for name in SPLITS}
    asked = sum(each for each in wanted.values() if isinstance(each, int))
    if asked > len(known):
        raise InputError(
            f"{group}.train, {group}.validation and {group}.test ask for {asked} trials, but there are {len(known)}."
        )
    rest, lists = iter(known), dict[str, list[str]]()
    for name, each in wanted.items():
        lists[name] = [*islice(rest, each)] if isinstance(each, int) else list(each)
        unknown = [trial for trial in lists[name] if trial not in known]
        if unknown:
            raise InputError(
                f"{group}.{name} names the trial '{unknown[0]}', which is not in {group}.trials: {', '.join(known)}."
            )
        if not lists[name] and not (name == "validation" and run.in_the_loop is not None):
            more = ", or set data.folds to leave_one_out" if group == "data" else ""
            raise InputError(f"{group}.{name} is empty: name one of {group}.trials there{more}.")
    _check_once(group, lists, run.train_fraction < 1.0)
    return lists


def _check_once(group: str, lists: Mapping[str, Sequence[str]], parted: bool) -> None:
    """Refuses a trial in two splits, but for one of training whose rest is a test."""
    seen: dict[str, str] = {}
    for name, trial in ((name, trial) for name, members in lists.items() for trial in members):
        if trial in seen:
            if parted and (seen[trial], name) == ("train", "test"):
                continue
            other = seen[trial]
            where = f"twice in {group}.{name}" if other == name else f"in {group}.{other} and {group}.{name}"
            raise InputError(f"the trial '{trial}' is {where}: every trial is in one split, once.")
        seen[trial] = name


def folds_of(run: RunSettings) -> dict[str, Split] | None:
    """By the name of the trial that is tested: the splits of a cross-validation; None where there is one split.

    A fold trains on all other trials and has none to validate with. With ``data.limit`` there are fewer folds, and each
    trains on fewer trials, evenly picked.

    Raises:
        InputError: fewer than two trials.
    """
    data = run.data
    if data.folds is None or (isinstance(data, RecordedData) and _splits(run)[0] == "laboratory"):
        return None
    names = list(known_trials(run))
    if len(names) < 2:
        raise InputError("data.folds is leave_one_out, which needs two trials or more in data.trials.")
    folds, members = (len(names), len(names)) if data.limit is None else (data.limit.test, data.limit.train)
    others = {name: [each for each in names if each != name] for name in evenly(names, folds)}
    return {name: Split(train=tuple(evenly(row, members)), validation=(), test=(name,)) for name, row in others.items()}


def trials_of(run: RunSettings) -> tuple[Trial, ...]:
    """The trials of an experiment, in the order of the files: that of the split, or, with folds, as configured."""
    known = known_trials(run)
    return tuple(known[name] for name in (known if folds_of(run) else split_of(run).names))


def scaled_name(name: str, scale: float) -> str:
    """The name of a test trial at scaled inputs."""
    return f"{name}_x{scale:g}"


def scaled_trials_of(run: RunSettings) -> tuple[Trial, ...]:
    """The test trials at ``data.input_scales``, scale by scale."""
    if not run.input_scales:
        return ()
    known = known_trials(run)
    test = [known[name] for name in split_of(run).test]
    return tuple(
        each.model_copy(update={"name": scaled_name(each.name, scale), "scale": scale})
        for scale in run.input_scales
        for each in test
    )


def test_groups(run: RunSettings, split: Split) -> dict[str, tuple[str, ...]]:
    """By scale of the inputs, the trials that are tested; the first is that of the training, ``1``."""
    scaled = {f"{scale:g}": tuple(scaled_name(name, scale) for name in split.test) for scale in run.input_scales}
    return {"1": split.test} | scaled


def evenly(row: Sequence[T], limit: int) -> list[T]:
    """At most that many values of a row, one or more, spread over it."""
    places = np.linspace(0, len(row) - 1, min(limit, len(row))).round().astype(int)
    return [row[i] for i in places]
