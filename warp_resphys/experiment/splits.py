"""Trials of an experiment: their names, how they begin,
and their split into training, validation and test.
"""

from itertools import chain, islice, product
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..data.rigid_bodies import owners
from ..data.trials import evenly
from ..io.errors import DataFileError, InputError, listed
from ..settings.data_kinds import RecordedData, ReleaseFromLoad, SimulatedData
from ..settings.performed import Split, Trial, TrialSettings
from ..settings.played import LaboratorySettings
from ..settings.run import RunSettings

SPLITS: Final = ("train", "validation", "test")
OTHERS: Final = "others"
_SUFFIXES = (".h5", ".hdf5", ".npz", ".c3d", ".tsv", ".csv")

# Key with a list of values per split, unit of these and factor to SI units, of what differs between
# simulated trials.
_VARIATIONS: Final = {
    "release_from_load": ("weights_g", " g", 1e-3),
    "release_from_twist": ("angles_deg", "°", np.pi / 180.0),
    "moving_base": ("amplitudes", " times", 1.0),
}


def all_trials(run: RunSettings) -> dict[str, Trial]:
    """All configured or recorded trials, by name.

    Raises:
        DataFileError: the folder of recordings does not exist or has no recordings.
        InputError: there are none, a trial has no file or that of another one, or a marker is in no
            trial.
    """
    data, trials = run.trial_data, dict[str, Trial]()
    if not isinstance(data, RecordedData):
        _, unit, factor = _VARIATIONS[data.kind]
        for value in (*data.amounts.train, *data.amounts.validation, *data.amounts.test):
            name = f"{value:g}{unit}"
            trials[name] = Trial(name=name, begins="given", amount=factor * value)
        others = data.others.items() if isinstance(data, ReleaseFromLoad) else ()
        return trials | {name: Trial(name=name, begins="given", load=load) for name, load in others}

    trials = _recorded(data) if data.folder is not None else _played(run, data)
    if run.markers is not None:
        tracked = run.markers.observed
        nowhere = [
            label for label in tracked if not any(trial.has(label) for trial in trials.values())
        ]
        if nowhere:
            raise InputError(
                f"{listed(owners(nowhere))} of markers.tracked or rigid_bodies is in no "
                "data.trials.NAME.labels: add it there, or leave it out."
            )
    return trials


def _trial(data: RecordedData, name: str, settings: TrialSettings, **more: Any) -> Trial:
    begins = settings.begins or data.begins
    return Trial(**{**dict(settings), "name": name, "begins": begins, "file": None, **more})


def _recorded(data: RecordedData) -> dict[str, Trial]:
    """Trials with a recording in a folder."""
    assert data.folder is not None
    folder = Path(data.folder).expanduser()
    trials = dict[str, Trial]()
    files = dict[str, str]()
    for name, settings in (data.trials or _recordings(folder)).items():
        if settings.file is None:
            raise InputError(
                f"data.trials.{name}.file is missing: give the name of a file in data.folder."
            )
        other = files.setdefault(settings.file, name)
        if other != name:
            raise InputError(
                f"the trials '{other}' and '{name}' have the same file, "
                f"{settings.file}: use it once."
            )
        trials[name] = _trial(data, name, settings, file=str(folder / settings.file))
    return trials


def _played(run: RunSettings, data: RecordedData) -> dict[str, Trial]:
    """Trials of the simulated laboratory."""
    assert run.laboratory is not None
    if not run.laboratory.trials and not data.sequences:
        raise InputError("laboratory.trials is empty: name the trials, or set data.sequences.")
    drawn = {f"t{number:03d}": number for number in range(data.sequences)}
    trials = {
        name: Trial(name=name, begins=data.begins, sequence=number)
        for name, number in drawn.items()
    }
    for name, settings in run.laboratory.trials.items():
        new = len(trials) if data.sequences else None
        trials[name] = _trial(
            data, name, settings, sequence=trials[name].sequence if name in trials else new
        )
    return trials


def _recordings(folder: Path) -> dict[str, TrialSettings]:
    """Makes entries for all recordings in a folder."""
    if not folder.is_dir():
        raise DataFileError(f"{folder} is not a folder: set data.folder to your recordings.")
    files: dict[str, str] = {}
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES):
        other = files.setdefault(path.stem, path.name)
        if other != path.name:
            raise DataFileError(
                f"{folder} has two recordings of one name, {other} and {path.name}: list the "
                "trials in data.trials."
            )
    if not files:
        suffixes = ", ".join(_SUFFIXES)
        raise DataFileError(
            f"{folder} has no recordings ({suffixes}): "
            "set data.folder to the folder of the recordings."
        )
    return {name: TrialSettings(file=file) for name, file in files.items()}


def split_of(run: RunSettings) -> Split:
    """Splits the trials into training, validation and test.

    Each split is configured as a list of names, as a number of trials, or as ``others``; numbered
    trials are assigned in order, training first. The split of a laboratory takes precedence.
    Validation may be empty if the force is trained on whole motions.

    Raises:
        InputError: an unknown trial, a trial in two splits, too few trials, or an empty training or
            test split.
        DataFileError: see `all_trials`.
    """
    data = run.trial_data
    lists = _named(run) if isinstance(data, RecordedData) else _valued(data)
    if data.limit is not None:
        lists = {
            name: evenly(row, getattr(data.limit, name)) if row else []
            for name, row in lists.items()
        }
    return Split(
        train=tuple(lists["train"]),
        validation=tuple(lists["validation"]),
        test=tuple(lists["test"]),
    )


def _valued(data: SimulatedData) -> dict[str, list[str]]:
    """Names of the trials in each split of a simulated experiment, from the configured values."""
    key, unit, _ = _VARIATIONS[data.kind]
    named = {name: [f"{value:g}{unit}" for value in getattr(data.amounts, name)] for name in SPLITS}
    empty = [name for name, row in named.items() if not row]
    if empty:
        raise InputError(
            f"data.{key}.{empty[0]} is empty: give the split at least one value, in {unit.strip()}."
        )
    names = [*chain.from_iterable(named.values())]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"data.{key} names {twice[0]} twice: a trial belongs to one split only.")
    if isinstance(data, ReleaseFromLoad):
        double = [name for name in data.others if name in names]
        if double:
            raise InputError(
                f"data.others names '{double[0]}', which is a trial of data.{key}: rename it."
            )
        named["test"] += data.others
    return named


def _splits(run: RunSettings) -> tuple[str, RecordedData | LaboratorySettings | Split]:
    """Name and settings of the group that configures the split."""
    assert isinstance(run.data, RecordedData)
    if run.is_laboratory and run.laboratory is not None and run.laboratory.train is not None:
        return "laboratory", run.laboratory
    if run.data.split is not None:
        return f"data.splits.{run.data.split}", run.data.splits[run.data.split]
    return "data", run.data


def _named(run: RunSettings) -> dict[str, list[str]]:
    """Names of the trials in each split, from the configured lists or numbers."""
    names, (group, settings) = list(all_trials(run)), _splits(run)
    table = group.partition(".")[0]
    wanted = {name: getattr(settings, name) for name in SPLITS}
    asked = sum(members for members in wanted.values() if isinstance(members, int))
    if asked > len(names):
        raise InputError(
            f"{group}.train, {group}.validation and {group}.test ask for {asked} trials, but "
            f"there are {len(names)}."
        )
    rest, lists = iter(names), dict[str, list[str]]()
    open_ends = [name for name, members in wanted.items() if members == OTHERS]
    if open_ends:
        given = [members for members in wanted.values() if not isinstance(members, int | str)]
        taken = [*chain.from_iterable(given)]
        if len(open_ends) > 1 or asked:
            raise InputError(
                f"{group}.{open_ends[0]} is others, the trials that the other two do not name: "
                "give these as lists."
            )
        wanted[open_ends[0]] = [name for name in names if name not in taken]
    for name, members in wanted.items():
        lists[name] = [*islice(rest, members)] if isinstance(members, int) else list(members)
        unknown = [trial for trial in lists[name] if trial not in names]
        if unknown:
            raise InputError(
                f"{group}.{name} names the trial '{unknown[0]}', which is not in {table}.trials: "
                f"{', '.join(names)}."
            )
        if not lists[name] and not (name == "validation" and run.in_the_loop is not None):
            more = ", or set data.folds to leave_one_out" if group == "data" else ""
            raise InputError(f"{group}.{name} is empty: add at least one of {table}.trials{more}.")
    seen: dict[str, str] = {}
    of_splits = [(name, trial) for name, members in lists.items() for trial in members]
    for name, trial in of_splits:
        # The remainder of a partly trained trial is tested.
        if trial in seen and not (
            run.train_fraction < 1.0 and (seen[trial], name) == ("train", "test")
        ):
            other = seen[trial]
            where = (
                f"twice in {group}.{name}"
                if other == name
                else f"in {group}.{other} and {group}.{name}"
            )
            raise InputError(f"the trial '{trial}' is {where}: a trial belongs to one split only.")
        seen.setdefault(trial, name)
    return lists


def folds_of(run: RunSettings) -> dict[str, Split] | None:
    """Splits of a leave-one-out cross-validation, by the name of the tested trial.

    None without cross-validation.

    A fold trains on all other trials and has no validation trials. ``data.limit`` reduces the
    number of folds and of training trials per fold, which are picked evenly.

    Raises:
        InputError: fewer than two trials.
    """
    data = run.trial_data
    if data.folds is None or (isinstance(data, RecordedData) and _splits(run)[0] == "laboratory"):
        return None
    names = list(all_trials(run))
    if len(names) < 2:
        raise InputError(
            "data.folds is leave_one_out, which needs at least two trials in data.trials."
        )
    folds, members = (
        (len(names), len(names)) if data.limit is None else (data.limit.test, data.limit.train)
    )
    others = {name: [other for other in names if other != name] for name in evenly(names, folds)}
    return {
        name: Split(train=tuple(evenly(row, members)), validation=(), test=(name,))
        for name, row in others.items()
    }


def trials_of(run: RunSettings) -> tuple[Trial, ...]:
    """Trials of an experiment in the order of the files:
    by split, or as configured if there are folds.
    """
    trials = all_trials(run)
    return tuple(trials[name] for name in (trials if folds_of(run) else split_of(run).names))


def scaled_name(name: str, scale: float) -> str:
    """Name of a test trial with scaled inputs."""
    return f"{name}_x{scale:g}"


def scaled_trials_of(run: RunSettings) -> tuple[Trial, ...]:
    """Test trials with inputs scaled by ``data.input_scales``, ordered by scale."""
    if not run.input_scales:
        return ()
    trials = all_trials(run)
    test = [trials[name] for name in split_of(run).test]
    return tuple(
        trial.model_copy(update={"name": scaled_name(trial.name, scale), "scale": scale})
        for scale, trial in product(run.input_scales, test)
    )


def test_groups(run: RunSettings, split: Split) -> dict[str, tuple[str, ...]]:
    """Names of the tested trials by input scale.

    The first group, ``1``, has the original inputs.
    """
    scaled = {
        f"{scale:g}": tuple(scaled_name(name, scale) for name in split.test)
        for scale in run.input_scales
    }
    return {"1": split.test} | scaled
