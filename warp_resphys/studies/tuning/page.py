"""The page of a search for settings, which needs nothing beside it, and its figures as PNG files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...io.errors import DataFileError
from ...io.files import disk_full_error, is_disk_full, write_text
from ...report.page import (
    NO_BREAK_SPACE,
    Picture,
    duration_text,
    flatten,
    number_text,
    page_template,
    svg_address,
)
from .space import Dimension, described

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

    from .study import Outcome

_MODELS = {"resphys": "ResPhys", "simfree": "SimFree"}


@dataclass(frozen=True)
class TuningReport:
    """Everything that the page shows.

    Attributes:
        title: Of the experiment.
        experiment: Its name.
        model: ``resphys`` or ``simfree``.
        wanted: How many trials are to be finished.
        outcomes: All trials, by number.
        ranked: The complete ones that did not diverge, the best one first.
        configured_mm: Error of the network that is trained as configured [mm]; None where it diverges.
        importance: How much each setting matters, by dotted key; may be empty.
        space: What each setting may be, by dotted key.
        option: The file with the best settings.
        name: By which a run names them.
        settings: What all trials have in common, nested.
    """

    title: str
    experiment: str
    model: str
    wanted: int
    outcomes: "Sequence[Outcome]"
    ranked: "Sequence[Outcome]"
    configured_mm: float | None
    importance: Mapping[str, float]
    space: Mapping[str, Dimension]
    option: str
    name: str
    settings: Mapping[str, Any]


def write_tuning_report(path: Path, data: TuningReport) -> None:
    """Write the page, and its figures as PNG files beside it.

    Raises:
        DataFileError: A file could not be written.
    """
    try:
        pictures = _draw(data, path.parent)
    except OSError as error:
        if is_disk_full(error):
            raise disk_full_error(path.parent) from error
        raise DataFileError(f"cannot write figures to {path.parent}: {error.strerror or error}") from error
    page = page_template("tuning.html").render(
        data=data,
        pictures=pictures,
        model=_MODELS[data.model],
        verdict=verdict(data),
        names=_names(data.space),
        space=described(data.space),
        number=number_text,
        duration=duration_text,
        short=short_text,
        settings=[(key, value) for key, value in flatten(data.settings) if key not in data.space],
    )
    write_text(path, page)


def verdict(data: TuningReport) -> str:
    """Say what the best trial came to, and how many there were."""
    counts = {state: sum(each.state == state for each in data.outcomes) for state in ("complete", "pruned")}
    finished = counts["complete"] + counts["pruned"]
    diverged = counts["complete"] - len(data.ranked)
    said = f"{finished} of {data.wanted} trials are finished"
    asides = [f"{counts['pruned']} given up, as they took too long"] if counts["pruned"] else []
    asides += [f"{diverged} diverged"] if diverged else []
    said += f" ({', '.join(asides)})." if asides else "."
    if not data.ranked:
        return f"{said} None of them came to a roll-out that stays finite."
    best = data.ranked[0]
    found = f"The best settings, of trial {best.number}, come to {number_text(best.error)} mm on the validation split."
    if data.configured_mm is not None:
        configured = number_text(data.configured_mm)
        beaten = best.error is not None and best.error < data.configured_mm
        found += f" As configured: {configured} mm{'' if beaten else ', which no trial has beaten'}."
    return f"{found} {said}".replace(" mm", f"{NO_BREAK_SPACE}mm")


def short_text(value: Any) -> str:
    """Return a setting as one reads it."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _names(space: Mapping[str, Dimension]) -> dict[str, str]:
    """The last part of each dotted key, or the whole where that is not unique."""
    last = [key.rpartition(".")[2] for key in space]
    return {key: name if last.count(name) == 1 else key for key, name in zip(space, last, strict=True)}


def _draw(data: TuningReport, folder: Path) -> dict[str, Picture]:
    """Draw the figures in two widths, and save the wide ones."""
    from ...report import figures
    from . import figures as tuning_figures

    def both(name: str, draw: "Callable[..., Figure]", alt: str) -> Picture:
        wide, narrow = draw(narrow=False), draw(narrow=True)
        figures.save_png(wide, folder / f"{name}.png")
        return Picture(svg_address(figures.themed_svg(wide, name)), svg_address(figures.themed_svg(narrow, name)), alt)

    names = _names(data.space)
    numbers = max((each.number for each in data.outcomes), default=-1) + 1
    errors, pruned = np.full(numbers, np.nan), np.full(numbers, np.nan)
    for each in data.outcomes:
        if each.error is not None and each.state in ("complete", "pruned"):
            (errors if each.state == "complete" else pruned)[each.number] = each.error
    shares = {names[key]: share for key, share in data.importance.items()}
    tried = [{names[key]: value for key, value in each.settings.items()} for each in data.ranked]
    space = {names[key]: dimension for key, dimension in data.space.items()}
    scatter = np.array([each.error for each in data.ranked], dtype=np.float64)
    told = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    return {
        "history": both(
            "history",
            partial(tuning_figures.search_history, errors, pruned, data.configured_mm),
            f"Validation roll-out error of {numbers} trials and the best so far, on a logarithmic axis.",
        ),
        "importance": both(
            "importance", partial(tuning_figures.importance_bars, shares), f"Importance of each setting: {told}."
        ),
        "settings": both(
            "settings",
            partial(tuning_figures.setting_scatter, scatter, tried, space),
            "Validation roll-out error against each setting, a panel each, on a logarithmic axis.",
        ),
    }
