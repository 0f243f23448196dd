"""Sections of the page of a run: errors by horizon and input, what was identified and learned, its recordings."""

import math
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..learning.metrics import PUBLISHED_WINDOWS_MM
from ..learning.parameters import command_of
from .data import MODELS, FloatArray, RunReport
from .page import (
    MINUS,
    NO_BREAK_SPACE,
    NONE,
    Canvas,
    Cell,
    Drawn,
    Items,
    Part,
    Row,
    Table,
    Text,
    drawn_file,
    error_parts,
    percent_text,
    published_parts,
)
from .verdict import published_growth

_MOST_WIDE: Final = 8  # Markers that stand beside each other in a table.
# A name, the unit that it is written in, and how many of these make an SI unit.
_PARAMETERS: Final[Mapping[str, tuple[str, str, float]]] = {
    "youngs_modulus": ("Young's modulus", "kPa", 1e-3),
    "poissons_ratio": ("Poisson's ratio", "", 1.0),
    "density": ("Density", "kg/m³", 1.0),
    "mass_damping": ("Damping by mass", "1/s", 1.0),
    "stiffness_damping": ("Damping by stiffness", "ms", 1e3),
    "attached_mass_factor": ("Factor of the attached masses", "", 1.0),
    "gravity_tilt_1": ("First tilt of gravity", "°", 180.0 / np.pi),
    "gravity_tilt_2": ("Second tilt of gravity", "°", 180.0 / np.pi),
    "tendon_offset_1": ("First offset of the tendons", "mm", 1e3),
    "tendon_offset_2": ("Second offset of the tendons", "mm", 1e3),
}
_COMMANDS: Final[Mapping[str, tuple[str, str, float]]] = {
    "factor": ("Factor", "", 1.0),
    "delay": ("Delay", "ms", 1e3),
    "rise": ("Time constant", "ms", 1e3),
}
_WHOLE: Final = 99.5  # [%] of a parameter's range.
_OPEN: Final = "and leave that open over the whole range: a prior would settle it"
_TIED: Final = 0.9  # From this correlation on, two parameters are named as not told apart.
_NOTHING_NEW: Final = (
    0.8  # From this share of the deviation of its prior on, the data tell next to nothing about a parameter.
)


def _parameter(name: str) -> tuple[str, str, float]:
    """What a parameter is called, the unit that it is written in, and how many of these make an SI unit."""
    driven, command = command_of(name)
    if driven:
        (kind, unit, per), words = _COMMANDS[command], driven.rpartition("_")[2]
        return f"{kind} of the {words}{'es' if words.endswith('s') else 's'}", unit, per
    offset = re.fullmatch(r"(tendon_offset_[12])_(.+)", name)
    if offset is not None:
        kind, unit, per = _PARAMETERS[offset[1]]
        return f"{kind.removesuffix(' of the tendons')} of the tendon '{offset[2]}'", unit, per
    branch = re.fullmatch(r"prony_(ratio|time)_(\d+)", name)
    if branch is None:
        return _PARAMETERS.get(name, (name, "", 1.0))
    kind, number = branch.groups()
    return (f"Relaxation time {number}", "s", 1.0) if kind == "time" else (f"Prony ratio {number}", "", 1.0)


def against(errors: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """Return the model that the others are compared with, and by how many per cent each is above or below it."""
    base = next((m for m in ("sysid_elastic", "sysid") if m in errors and errors[m]["mean"]), "")
    if not base:
        return "", {}
    ratios = {m: each["mean"] / errors[base]["mean"] - 1.0 for m, each in errors.items() if each["mean"] is not None}
    return base, {m: NONE if m == base else percent_text(ratio) for m, ratio in ratios.items()}


def horizons_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The errors by length of the roll-out."""
    table = horizon_table(data.metrics, PUBLISHED_WINDOWS_MM.get(data.experiment, {}))
    if table is None:
        return None
    longer = data.settings["data"].get("train_fraction", 1.0) < 1.0
    return Part("Longer than the training" if longer else "By length of the roll-out", [table])


def model_table(
    head: str, rows: Mapping[str, Mapping[str, Cell]], note: str = "", pages: Mapping[str, str] | None = None
) -> Table:
    """Return cells by what a row is and model; a row may lead to a page."""
    models = [model for model in MODELS if any(model in row for row in rows.values())]
    found = [Row(n, [r.get(m, Cell(NONE)) for m in models], address=(pages or {}).get(n, "")) for n, r in rows.items()]
    return Table(head, [MODELS[model][0] for model in models], found, note)


def horizon_table(metrics: Mapping[str, Any], published: Mapping[str, Mapping[str, Any]]) -> Table | None:
    """Return the errors over the first seconds of the roll-outs and their growth, with the published ones below them.

    Args:
        metrics: With `horizons` (a summary by seconds and model) and `growth`; there is no table without them.
        published: Published errors by seconds and model.
    """
    found, rows = metrics.get("horizons", {}), {}
    for horizon in sorted(found, key=float):
        theirs = {model: " ".join(published_parts(each)) for model, each in published.get(horizon, {}).items()}
        rows[f"First {float(horizon):g} s"] = {m: Cell(_whole(e), theirs.get(m, "")) for m, e in found[horizon].items()}
    if len(rows) > 1 and metrics.get("growth"):
        ours = {m: NONE if each is None else percent_text(each, 1) for m, each in metrics["growth"].items()}
        shares = published_growth(published, min(found, key=float), max(found, key=float))
        theirs = {m: percent_text(each, 1) for m, each in shares.items()}
        rows["Growth"] = {m: Cell(ours.get(m, NONE), theirs.get(m, "")) for m in next(iter(rows.values()))}
    note = "Growth is that of the mean error from the shortest to the longest part of the same roll-outs."
    return model_table("Mean error [mm]", rows, note + (" Small: published." if published else "")) if rows else None


def scales_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The errors at multiples of the inputs."""
    found = data.metrics.get("scales", {})
    table = scale_table(found)
    if table is None:
        return None
    from . import figures

    diverged = sum(summary["diverged"] for each in found.values() for summary in each.values())
    means = {
        model: {float(s): e[model]["mean"] for s, e in found.items() if model in e and e[model]["mean"] is not None}
        for model in MODELS
        if any(model in each for each in found.values())
    }
    figure = canvas.figure(
        "error_over_scale",
        partial(figures.error_over_scale, means),
        "Mean marker error of the models against the scale of the inputs, on a logarithmic axis.",
        f"Mean error over the roll-outs.{' Where a roll-out diverged, a point is missing.' if diverged else ''}",
    )
    return Part("Beyond the inputs of the training", [table, figure])


def scale_table(found: Mapping[str, Mapping[str, Any]]) -> Table | None:
    """Return the errors at multiples of the inputs (a summary by scale and model), with how they stand to SysID."""
    rows = {}
    for scale in sorted(found, key=float):
        base, shares = against(found[scale])
        cells = {m: Cell(_whole(e), "" if m == base else shares.get(m, "")) for m, e in found[scale].items()}
        rows[f"\N{MULTIPLICATION SIGN} {float(scale):g}"] = cells
    note = "The inputs of the test trials, multiplied; below the error, how it stands to that of SysID."
    return model_table("Inputs; mean error [mm]", rows, note) if rows else None


def _whole(summary: Mapping[str, Any]) -> str:
    """A mean with its deviation."""
    return " ".join(error_parts(summary)).strip()


def identification_section(data: RunReport, canvas: Canvas) -> Part | None:
    """What was identified, how well the data tell it, and the loss around it."""
    found = {name: data.identification[name] for name in MODELS if name in data.identification}
    if not found:
        return None
    columns = ["Data sheet", "Identified", *(["True"] if data.truth else []), "At a bound"]
    blocks: list[Any] = [
        Table(MODELS[name][0], columns, parameter_rows(each, data.start, data.truth)) for name, each in found.items()
    ]
    ranges = (data.settings.get("identify") or {}).get("parameters", {})
    uncertain = [said for name, each in found.items() if (said := uncertainty_text(name, each, ranges))]
    notes = []
    if uncertain:
        notes.append(
            "± is one standard deviation in the Gauss-Newton approximation, for residuals that are correlated in time."
        )
    if data.truth:
        model = data.truth.get("model", "corotated").replace("_", " ")
        notes.append(f"The true values are those of the simulated laboratory, whose material is {model}.")
    blocks += [Text(" ".join(notes), note=True)] if notes else []
    blocks += [Text(said) for said in uncertain]
    blocks += [Text(placement_text(name, each["placement"])) for name, each in found.items() if each.get("placement")]
    return Part("Identification", blocks + _loss_figures(data, found, canvas))


def _loss_figures(data: RunReport, found: Mapping[str, Any], canvas: Canvas) -> list[Drawn]:
    """The losses of the identifications over their evaluations, and over a grid."""
    from . import figures

    blocks = []
    histories = {name: each["history"] for name, each in found.items() if any(each["history"])}
    if histories:
        blocks.append(
            canvas.figure(
                "loss_history",
                partial(figures.loss_histories, histories),
                "Loss of the identification over its evaluations, a line a start, on a logarithmic axis.",
                "Lowest loss so far over the evaluations, a line a start; the start that was kept is the bold one. The "
                "loss is the mean squared distance of the markers over the square of the motion’s amplitude.",  # noqa: RUF001
            )
        )
    grid = data.identification.get("landscape")
    if grid:
        loss, modulus = (np.array(grid[key], dtype=np.float64) for key in ("loss", "youngs_modulus"))
        ratio = np.atleast_1d(np.array(grid.get("poissons_ratio", []), dtype=np.float64))
        points = _landscape_points(data, loss, modulus, ratio)
        marked = "; ".join(f"{name} at {1e-3 * e:.4g} kPa" for name, (e, _) in points.items())
        blocks.append(
            canvas.figure(
                "landscape",
                partial(figures.landscape, modulus, ratio, loss, points),
                f"Loss over Young's modulus{' and Poisson’s ratio' if loss.ndim > 1 else ''}: {marked}.",  # noqa: RUF001
                "The loss on a grid around what SysID has identified, the other parameters held there. It is empty "
                "where no simulation succeeded.",
            )
        )
    return blocks


def _landscape_points(
    data: RunReport, loss: FloatArray, modulus: FloatArray, ratio: FloatArray
) -> dict[str, tuple[float, float]]:
    """Modulus [Pa] and ratio of what is marked in the landscape."""
    points: dict[str, tuple[float, float]] = {}
    if np.isfinite(loss).any():
        row, *column = np.unravel_index(int(np.nanargmin(loss)), loss.shape)
        points["lowest of the grid"] = (float(modulus[row]), float(ratio[column[0]]) if column else 0.0)
    found = data.identification.get("sysid", {}).get("parameters", {})
    found = {"poissons_ratio": data.start.get("poissons_ratio", 0.0), **found}
    for name, values in {"data sheet": data.start, "identified": found, "true": data.truth}.items():
        if {"youngs_modulus", "poissons_ratio"} <= values.keys():
            points[name] = (values["youngs_modulus"], values["poissons_ratio"])
    return points


def parameter_rows(found: Mapping[str, Any], start: Mapping[str, float], truth: Mapping[str, Any]) -> list[Row]:
    """Return a row a parameter: the data sheet's value, what was identified, the true one if known, if at a bound."""
    deviations = (found.get("uncertainty") or {}).get("deviation", {})
    rows = []
    for parameter, value in found["parameters"].items():
        words, unit, factor = _parameter(parameter)
        deviation = deviations.get(parameter)
        beside = f"± {factor * deviation:.{_decimals(factor * deviation)}f}" if deviation else ""
        cells = [Cell(_digits(start.get(parameter), factor)), Cell(_digits(value, factor, deviation), beside=beside)]
        cells += [Cell(_digits(truth.get(parameter), factor))] if truth else []
        cells.append(Cell("yes" if parameter in found["at_bounds"] else ""))
        rows.append(Row(f"{words} [{unit}]" if unit else words, cells))
    return rows


def _digits(value: float | None, factor: float, deviation: float | None = None) -> str:
    """A value in its unit, with as many decimals as its standard deviation deserves, or four digits."""
    if value is None:
        return NONE
    scaled = factor * value
    if not deviation:
        return f"{scaled:.4g}".replace("-", MINUS)
    text = f"{scaled:.{_decimals(factor * deviation)}f}"
    return text.replace("-", MINUS) if float(text) else text.lstrip("-")


def _decimals(deviation: float) -> int:
    """For two digits of a standard deviation."""
    return max(0, 1 - math.floor(math.log10(deviation)))


def _in_a_sentence(parameter: str) -> str:
    words = _parameter(parameter)[0]
    return words if words.startswith(("Young", "Poisson", "Prony")) else words[0].lower() + words[1:]


def placement_text(name: str, placed: Mapping[str, Any]) -> str:
    """Say how far from where they should be an identification found the markers and the recordings."""
    away = {label: 1e3 * math.dist(offset, (0.0, 0.0, 0.0)) for label, offset in placed["offsets"].items()}
    furthest = max(away, key=lambda label: away[label])
    said = f"{MODELS[name][0]}, with the parameters: "
    said += f"markers sit beside their nominal places, {furthest} the furthest, by {away[furthest]:.1f} mm; "
    shift, turn = (math.hypot(*placed[key]) for key in ("shift", "turn"))
    said += f"the recordings lie {1e3 * shift:.1f} mm and {math.degrees(turn):.1f}° off."
    return said.replace(" mm", f"{NO_BREAK_SPACE}mm")


def uncertainty_text(name: str, found: Mapping[str, Any], ranges: Mapping[str, Any]) -> str:
    """Say which parameters the data of a model's identification cannot tell, or tell apart; empty if that is not known.

    Args:
        name: of the model.
        found: its identification.
        ranges: of the parameters, with what was known of them before.
    """
    known = found.get("uncertainty")
    if not known:
        return ""
    names = list(found["parameters"])
    words = {parameter: _in_a_sentence(parameter) for parameter in names}
    largest = max(abs(weight) for weight in known["poorest"].values())
    along = [words[p] for p, weight in known["poorest"].items() if abs(weight) > 0.4 * largest]
    said = f"{MODELS[name][0]}: the data tell least about {' together with '.join(along)}, "
    share = 100.0 * known["poorest_deviation"]
    said += f"to {share:.2g} % of the range" if share < _WHOLE else _OPEN
    correlation = np.array(known["correlation"], dtype=np.float64)
    tied = [
        f"{words[names[i]]} and {words[names[j]]} ({correlation[i, j]:+.2f})".replace("-", MINUS)
        for j in range(len(names))
        for i in range(j)
        if abs(correlation[i, j]) > _TIED
    ]
    said += f"; they cannot tell apart {', '.join(tied)}, by their correlation." if tied else "."
    for parameter, deviation in known["deviation"].items():
        prior = (ranges.get(parameter) or {}).get("prior")
        if prior is not None and deviation > _NOTHING_NEW * prior["deviation"]:
            unit, factor = _parameter(parameter)[1:]
            expected, spread = _digits(prior["mean"], factor), _digits(prior["deviation"], factor)
            where = f"{expected} ± {spread} {unit}".rstrip()
            said += f" They tell next to nothing of {words[parameter]}: it stays where its prior has it, at {where}."
    return said.replace(" %", f"{NO_BREAK_SPACE}%")


def registration_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Where the markers are on the body at rest."""
    found = data.recordings
    if found is None:
        return None
    alt = f"The body at rest with the registered markers of the trial {found.drawn}, from two sides."
    caption = (
        f"The body at rest with the registered markers of the trial {found.drawn}, which fits worst. A ring "
        "stands where a marker should be."
    )

    def picture(path: Path) -> Drawn:
        from .registration_picture import draw_registration

        draw_registration(path, found, data.fixed)
        return drawn_file(path, alt, caption)

    blocks = canvas.attempt("registration.png", picture)
    return Part("Registration", [*blocks, residual_table(found.residuals)])


def residual_table(residuals: Mapping[str, Any]) -> Table:
    """Return the residuals of the registration [mm] by trial and marker; many markers stand below each other."""
    labels = list(dict.fromkeys(label for each in residuals.values() for label in each["residual_mm"]))
    head, last = "Residual [mm]", "Root mean square"
    note = "Distance of each marker at rest from its nominal position after the rigid motion that fits best."

    def cell(each: Mapping[str, Any], label: str) -> Cell:
        value = each["residual_mm"].get(label)
        return Cell(NONE if value is None else f"{value:.2f}", "left out" if label in each["outliers"] else "")

    rms = {trial: Cell(f"{each['rms_mm']:.2f}") for trial, each in residuals.items()}
    if len(labels) <= _MOST_WIDE:
        rows = [Row(t, [*(cell(each, label) for label in labels), rms[t]]) for t, each in residuals.items()]
        return Table(head, [*labels, last], rows, note)
    rows = [Row(label, [cell(each, label) for each in residuals.values()]) for label in labels]
    return Table(head, list(residuals), [*rows, Row(last, list(rms.values()))], note)


def quality_section(data: RunReport, canvas: Canvas) -> Part | None:
    """How the recordings are."""
    if data.recordings is None:
        return None
    quality = data.recordings.quality
    warnings = [f"{trial}: {said}" for trial, each in quality.items() for said in each["warnings"]]
    longest = next(iter(quality.values()))["longest_gap_filled"]
    note = (
        f"Gaps of up to {longest} frames are filled; longer ones, in frames here, are masked: they count in no loss "
        "and in no error."
    )
    columns = ["Seen", "Gaps", "Longest", "Masked", "Jumps", "Noise [mm]", "Drift [mm]"]
    tables = [
        Table("Marker", columns, quality_rows(each), "", _quality_summary(trial, each), len(quality) == 1)
        for trial, each in quality.items()
    ]
    said = Items(warnings) if warnings else Text("No warnings.")
    return Part("Quality of the recordings", [said, *tables, Text(note, note=True)])


def _quality_summary(trial: str, each: Mapping[str, Any]) -> str:
    release = each["release_frame"]
    released = "" if release is None else f", let go in frame {release:.1f}"
    return f"{trial}: {each['frames']} frames at {each['rate_hz']:g} Hz{released}"


def quality_rows(quality: Mapping[str, Any]) -> list[Row]:
    """Return a row a marker: share seen, gaps, longest, masked, jumps, noise, drift."""
    rows = []
    for marker in quality["markers"]:
        jumps, noise, drift = (marker[key] for key in ("jumps", "noise_mm", "drift_mm"))
        texts = [
            NONE if marker["seen"] is None else f"{100.0 * marker['seen']:.1f} %",
            *(str(marker[key]) for key in ("gaps", "longest_gap_frames", "masked_frames")),
            f"{len(jumps)}" + (f" ({max(jump['mm'] for jump in jumps):.2f} mm)" if jumps else ""),
            "" if noise is None else f"{noise:.4f}",
            "" if drift is None else f"{drift:.3f}",
        ]
        rows.append(Row(marker["label"], [Cell(text) for text in texts]))
    return rows


def training_section(data: RunReport, canvas: Canvas) -> Part | None:
    """How the trainings went, and what was kept of them."""
    from . import figures

    said = {
        "training": "Losses, and the roll-out error on the trials by which the weights are chosen; the dot marks the "
        "lowest.",
        "refinement": "Refinement through the simulator: mean squared distance from the target over windows of a few "
        "steps, in mm². Epoch 0 is the network as the training above left it.",
    }
    blocks: list[Any] = []
    for model, (name, _) in MODELS.items():
        for what, records in (("training", data.training.get(model)), ("refinement", data.refinement.get(model))):
            if records:
                blocks += [Text(name, heading=True)] if what == "training" else []
                alt = f"Losses and validation roll-out error of the {what} of {name}, {len(records)} epochs."
                draw = partial(figures.training_curves, records)
                blocks.append(canvas.figure(f"{what}_{model}", draw, alt, said[what]))
    if not blocks:
        return None
    return Part("Training", [*blocks, *([Text(data.kept_note, "kept")] if data.kept_note else [])])
