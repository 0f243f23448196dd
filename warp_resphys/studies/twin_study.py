"""A twin on the recorded trials of a run: computing times, and errors of its predictions beside simpler ones."""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..io.errors import ConvergenceError
from ..io.files import write_json
from ..io.progress import Progress
from ..io.settings import Many, Positive, Settings, Word, setting
from ..linalg.threads import threads_for
from ..robot.loading import load, trial_names
from ..robot.robot import Robot
from .live_twin import TwinSettings, trial_packets
from .tables import Sheet, show


class TwinStudy(Settings):
    """The configuration ``benchmark_twin``, which explains its keys."""

    run: Word
    model: Word
    device: Word
    trials: Many[Word]
    every: Positive = setting(unit="s")
    twin: TwinSettings


def twin_study(settings: TwinStudy, folder: Path) -> None:
    """Writes twin.json into the run folder, and prints a table.

    Raises:
        InputError: an unknown model or trial.
        DataFileError: there is no finished run.
    """
    robot = load(Path(settings.run).expanduser(), settings.model, device=settings.device)
    rows, names = [], settings.trials or trial_names(robot)
    with threads_for(1), Progress("twin", len(names), "trials") as progress:
        for name in names:
            rows.append(followed(robot, name, settings.twin, settings.every))
            progress.advance()
    write_json(folder / "twin.json", {"run": settings.run, "twin": settings.twin.plain(), "trials": rows})
    show(twin_sheet(rows, robot, settings.twin.horizon), f"Written: {folder / 'twin.json'}")


def followed(robot: Robot, name: str, settings: TwinSettings, every: float) -> dict[str, Any]:
    """Lets a twin follow a trial, packet by packet, as fast as it can.

    Args:
        robot: that the run has learned.
        name: of the trial.
        settings: of the twin.
        every: time between two predictions [s].

    Returns:
        ``trial``; ``ms`` and ``ms_99``, median and 99th percentile of the time of an estimate; ``ahead_ms``, median
        time of a prediction; mean errors [mm] at the horizon of the twin (``twin_mm``), of markers that are held
        (``held_mm``), and of the simulator without markers (``simulator_mm``), with every command at its time; the
        share ``covered`` by intervals of 90 %, the number of ``predictions``, the ``best`` of the three, and
        ``counts`` of what was wrong.
    """
    twin, packets = settings.twin_of(robot), list(trial_packets(robot, name))
    if settings.planned:
        twin.plan((packet.time, packet.inputs) for packet in packets)
    seconds, ahead, next_one = list[float](), list[float](), 0.0
    for packet in packets:
        began = time.perf_counter()
        twin.take(packet.time, packet.markers, **packet.inputs)
        now = twin.now
        seconds.append(time.perf_counter() - began)
        if now.time >= next_one:
            began, next_one = time.perf_counter(), now.time + every
            with suppress(ConvergenceError):  # The twin counts it.
                twin.ahead()
            ahead.append(time.perf_counter() - began)
    off, (half, most) = twin.disagreement, np.percentile(1e3 * np.array(seconds), [50, 99])
    errors = {} if off is None else {"twin_mm": off.twin, "held_mm": off.held, "covered": off.covered}
    return {
        "trial": name,
        "ms": float(half),
        "ms_99": float(most),
        "ahead_ms": 1e3 * float(np.median(ahead)),
        **errors,
        "simulator_mm": None if off is None else off.simulator,
        "best": None if off is None else off.best,
        "predictions": 0 if off is None else off.predictions,
        "counts": twin.counts,
    }


def twin_sheet(rows: Sequence[dict[str, Any]], robot: Robot, horizon: float) -> Sheet:
    """The table of `followed` trials."""
    columns = (
        "trial {trial} | estimate, ms {ms:.1f} | 99th percentile {ms_99:.1f} | prediction, ms {ahead_ms:.0f} | "
        "twin, mm {twin_mm:.2f} | markers held, mm {held_mm:.2f} | simulator without markers, mm {simulator_mm:.2f} | "
        "in intervals of 90 % {covered:.0%} | predictions {predictions} | best {best}"
    )
    scored = [row for row in rows if row["predictions"]]
    about = robot.description
    title = f"{about.name}, {about.model}: steps of {1e3 * robot.time_step:g} ms, {horizon:g} s ahead"
    return Sheet.of(title, columns, scored)
