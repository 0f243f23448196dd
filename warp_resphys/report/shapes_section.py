"""The section on other bodies of the identified material."""

import math
from collections.abc import Mapping
from typing import Any, Final

from .data import MODELS, RunReport
from .notes import in_a_row
from .page import NONE, Canvas, Cell, PageTable, Part, Row, Text, number_text
from .verdict import unbroken

_MATERIALS: Final = ("sysid", "law")  # Models whose material can be put on another body, the better one last.
_TITLE: Final = "Other bodies of the same material"
_BEYOND: Final = 0.01  # Share of cells and states above which a law is said to be outside of its stretches.


def shapes_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return the errors on other bodies, and where the law is outside of the stretches that it was learned at."""
    shapes: Mapping[str, Any] = data.metrics.get("shapes", {})
    if not shapes:
        return None
    note = (
        "Mean distance of the vertices from a target of the same shape, whose motion begins in the same state; below "
        "it, the share of the uncorrected simulation's error that is removed. A learned force belongs to its mesh, and "
        "cannot be put on another one."
    )
    beyond = [f"{n} ({100.0 * r['outside']:.0f} %)" for n, r in shapes.items() if r.get("outside", 0.0) > _BEYOND]
    outside = "Outside of the stretches that the law was learned at, with the share of cells and times: "
    texts = [outside + f"{in_a_row(beyond)}."] if beyond else []
    first = [Text(unbroken(shapes_text(shapes)))]
    return Part(_TITLE, [*first, shapes_table(shapes, note), *(Text(unbroken(text)) for text in texts)])


def shapes_table(shapes: Mapping[str, Any], note: str = "") -> PageTable:
    """Return the errors by body and model."""
    models = _models(shapes)
    rows = []
    for name, result in shapes.items():
        shares = _removed(result)
        cells = [
            Cell(number_text(result["errors_mm"][model]), f"removes {share_text(shares[model])}")
            if model in shares
            else Cell(number_text(result["errors_mm"].get(model)) if model in result["errors_mm"] else NONE)
            for model in models
        ]
        small = f"{result['vertices']} vertices, moves by {result['moved_mm']:.3g} mm"
        rows.append(Row(name, cells, small=small))
    return PageTable("Error on other bodies [mm]", [MODELS[model][0] for model in models], rows, note)


def _models(shapes: Mapping[str, Any]) -> list[str]:
    return [model for model in MODELS if any(model in result["errors_mm"] for result in shapes.values())]


def _removed(result: Mapping[str, Any]) -> dict[str, float]:
    """Share of the uncorrected simulation's error that the others remove, where they did not diverge."""
    errors = result["errors_mm"]
    base = errors["simulation"]
    return {m: 1.0 - errors[m] / base for m in _MATERIALS if base and errors.get(m) is not None}


def share_text(share: float) -> str:
    """Return a share as a percentage, with digits for what is left of it."""
    digits = max(0, -math.floor(math.log10(1.0 - share)) - 1) if 0.9 < share < 1.0 else 0
    return f"{100.0 * share:.{digits}f} %".replace("-", "\N{MINUS SIGN}")


def shapes_text(shapes: Mapping[str, Any]) -> str:
    """Return a sentence on what the identified material is worth on other bodies.

    Args:
        shapes: From metrics.json, by body.
    """
    count, parts = len(shapes), []
    models = [model for model in _MATERIALS if model in _models(shapes)]
    for model in models:
        shares = [share for result in shapes.values() if (share := _removed(result).get(model)) is not None]
        ends = [*dict.fromkeys(share_text(end) for end in (min(shares), max(shares)))] if shares else ["nothing"]
        lost = f" ({count - len(shares)} diverged)" if len(shares) < count else ""
        parts.append(f"{_named(model)} removes {' to '.join(ends).replace(' % to', ' to')}{lost}")
    text = f"On {count} other bod{'y' if count == 1 else 'ies'} of the same material, {in_a_row(parts)} of the error"
    text += " of the uncorrected simulation"
    if models == [*_MATERIALS]:
        worse = [name for name, result in shapes.items() if not _is_better(result["errors_mm"])]
        text += f"; the law is {f'not better than SysID on {in_a_row(worse)}' if worse else 'better on all of them'}"
    return f"{text}."


def _named(model: str) -> str:
    return "the law" if model == "law" else MODELS[model][0]


def _is_better(errors: Mapping[str, float | None]) -> bool:
    law, sysid = errors.get("law"), errors.get("sysid")
    return law is not None and (sysid is None or law < sysid)
