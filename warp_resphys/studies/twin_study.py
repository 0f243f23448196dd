"""A twin on the recorded trials of a run: computing times, and errors of its predictions beside simpler ones."""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..io.errors import ConvergenceError, InputError, listed
from ..io.files import write_json
from ..io.progress import Progress
from ..io.settings import Many, Positive, Settings, Word, setting
from ..linalg.threads import threads_for
from ..robot.loading import load, trial_names
from ..robot.robot import Robot
from ..robot.twin.twin import Twin
from .live_twin import TwinSettings, trial_packets
from .tables import Sheet, show


class TwinStudy(Settings):
    """The configuration ``benchmark_twin``, which explains its keys."""

    run: Word
    model: Word
    device: Word
    trials: Many[Word | int]
    every: Positive = setting(unit="s")
    twin: TwinSettings


def twin_study(settings: TwinStudy, folder: Path) -> None:
    """Writes twin.json into the run folder, and prints a table.

    Raises:
        InputError: an unknown model or trial.
        DataFileError: there is no finished run.
    """
    robot = load(Path(settings.run).expanduser(), settings.model, device=settings.device)
    rows, known = list[dict[str, Any]](), trial_names(robot)
    names = [str(name) for name in settings.trials or known]
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"trials names {unknown[0]!r}: {settings.run} has {listed(known)}.")
    made = settings.twin.twins_of(robot)
    with threads_for(1), Progress("twin", len(names), "trials") as progress:
        for name in names:
            twin = made()
            rows.append(followed(robot, name, twin, settings))
            progress.advance()
    write_json(folder / "twin.json", {"run": settings.run, "twin": settings.twin.plain(), "trials": rows})
    show(twin_sheet(rows, twin), f"Written: {folder / 'twin.json'}")


def followed(robot: Robot, name: str, twin: Twin, settings: TwinStudy) -> dict[str, Any]:
    """Lets a twin follow a trial, packet by packet, as fast as it can.

    Args:
        robot: that the run has learned.
        name: of the trial.
        twin: of the robot, which has seen no packet.
        settings: time between two predictions, and whether the twin knows the commands to come.

    Returns:
        ``trial``; ``ms`` and ``ms_99``, median and 99th percentile of the time of an estimate; ``ahead_ms``, median
        time of a prediction; mean errors [mm] at the horizon of the twin (``twin_mm``), of markers that are held
        (``held_mm``), and of the twin's simulator or reduced model without markers (``simulator_mm``), with every
        command at its time; the share ``covered`` by intervals of 90 %, the number of ``predictions``, the ``best`` of
        the three, and ``counts`` of what was wrong.
    """
    packets = list(trial_packets(robot, name))
    if settings.twin.planned:
        twin.plan((packet.time, packet.inputs) for packet in packets)
    seconds, ahead, next_one = list[float](), list[float](), 0.0
    for packet in packets:
        began = time.perf_counter()
        twin.take(packet.time, packet.markers, **packet.inputs)
        now = twin.now
        seconds.append(time.perf_counter() - began)
        if now.time >= next_one:
            began, next_one = time.perf_counter(), now.time + settings.every
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


def twin_sheet(rows: Sequence[dict[str, Any]], twin: Twin) -> Sheet:
    """The table of trials that twins like this one `followed`."""
    engine, robot = twin.estimator.engine, twin.estimator.robot
    columns = (
        "trial {trial} | estimate, ms {ms:.1f} | 99th percentile {ms_99:.1f} | prediction, ms {ahead_ms:.0f} | "
        "twin, mm {twin_mm:.2f} | markers held, mm {held_mm:.2f} | "
        f"{engine} without markers, mm {{simulator_mm:.2f}} | "
        "in intervals of 90 % {covered:.0%} | predictions {predictions} | best {best}"
    )
    scored = [{**row, "best": row["best"].replace("simulator", engine)} for row in rows if row["predictions"]]
    about = robot.description
    title = f"{about.name}, {about.model}: steps of {1e3 * robot.time_step:g} ms, {twin.horizon:g} s ahead"
    return Sheet.of(title, columns, scored)
