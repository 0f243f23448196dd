"""A twin on the trials of a run: computing times on one thread, and errors of predictions beside simpler ones."""

import argparse
import time
from contextlib import suppress
from typing import Any, Final

import numpy as np
import yaml

from warp_resphys.io.errors import ConvergenceError, InputError, listed
from warp_resphys.io.progress import Progress
from warp_resphys.io.settings import parse
from warp_resphys.linalg.threads import threads_for
from warp_resphys.robot.loading import load, trial_names
from warp_resphys.robot.robot import Robot
from warp_resphys.studies.live_twin import TwinSettings, trial_packets
from warp_resphys.twin.twin import Twin

DEFAULTS: Final[dict[str, Any]] = {
    "horizon": 0.1,  # [s]
    "patience": 0.3,  # [s]
    "align": False,
    "refine": {},
    "noise": 2e-4,  # [m]
    "planned": True,
    "engine": "full",
}


def measure_twin(arguments: argparse.Namespace) -> dict[str, Any]:
    """Lets a twin follow trials, packet by packet, as fast as it can.

    Raises:
        InputError: an unknown model, trial or setting.
        DataFileError: there is no finished run.
    """
    own = {key: yaml.safe_load(value) for key, _, value in (word.partition("=") for word in arguments.settings)}
    settings = parse(TwinSettings, {**DEFAULTS, **own})
    robot = load(arguments.run, arguments.model, device=arguments.device)
    known = trial_names(robot)
    names = arguments.trials or known
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--trials names {unknown[0]!r}: {arguments.run} has {listed(known)}.")
    twin = settings.twin(robot)
    with threads_for(1), Progress("twin", len(names), "trials") as progress:
        rows = []
        for name in names:
            twin.reset()
            rows.append(followed(robot, name, twin, settings.planned, arguments.every))
            progress.advance()
    return {f"twin, {settings.engine}, {settings.horizon:g} s ahead": rows}


def followed(robot: Robot, name: str, twin: Twin, planned: bool, every: float) -> dict[str, Any]:
    """Follows a trial.

    Args:
        robot: that the run has learned.
        name: of the trial.
        twin: of the robot, which has seen no packet.
        planned: whether the twin knows the commands to come.
        every: time between two predictions [s].

    Returns:
        Median and 99th percentile of the time of an estimate, and median time of a prediction [ms]; mean errors [mm] at
        the horizon of the twin, of markers that are held, and of the twin's engine without markers; the share of errors
        within intervals of 90 %, the number of predictions, and the best of the three.
    """
    packets = list(trial_packets(robot, name))
    if planned:
        twin.plan((packet.time, packet.inputs) for packet in packets)
    estimates, predictions, following = list[float](), list[float](), 0.0
    for packet in packets:
        began = time.perf_counter()
        twin.take(packet.time, packet.markers, **packet.inputs)
        now = twin.now
        estimates.append(1e3 * (time.perf_counter() - began))
        if now.time >= following:
            began, following = time.perf_counter(), now.time + every
            with suppress(ConvergenceError):  # The twin counts it.
                twin.ahead()
            predictions.append(1e3 * (time.perf_counter() - began))
    row = {"trial": name, "estimate_ms": float(np.median(estimates)), "p99_ms": float(np.percentile(estimates, 99))}
    row["prediction_ms"] = float(np.median(predictions))
    if (off := twin.disagreement) is not None:
        row |= {"twin_mm": off.twin, "held_mm": off.held, "engine_mm": off.simulator, "covered": off.covered}
        row |= {"predictions": off.predictions, "best": off.best}
    return row
