"""A twin on the trials of a run: computing times on one thread,
and errors of predictions beside simpler ones.
"""

import argparse
import time
from contextlib import suppress
from typing import Any

import numpy as np

from warp_resphys.core.linalg.threads import threads_for
from warp_resphys.io.errors import ConvergenceError, InputError, listed
from warp_resphys.io.progress import Progress
from warp_resphys.io.settings import parse
from warp_resphys.overrides import composed
from warp_resphys.robot.loading import load, trial_names
from warp_resphys.studies.live_twin import TwinSettings, trial_packets


def measure_twin(arguments: argparse.Namespace) -> dict[str, Any]:
    """Lets a twin follow trials, packet by packet, as fast as it can.

    Returns:
        Of every trial, median and 99th percentile of the time of an estimate, and median time of a
        prediction [ms]; mean errors [mm] at the horizon of the twin, of markers that are held, and
        of the twin's engine without markers; the share of errors within intervals of 90 %, the
        number of predictions, and the best of the three.

    Raises:
        InputError: an unknown model, trial or setting.
        DataFileError: there is no finished run.
    """
    overrides = [f"twin.{word}" for word in ("horizon=0.1", *arguments.settings)]
    settings = parse(TwinSettings, composed("view", ["run=''", *overrides])["twin"])
    robot = load(arguments.run, arguments.model, device=arguments.device)
    rows = list[dict[str, Any]]()
    known = trial_names(robot)
    names = arguments.trials or known
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--trials names {unknown[0]!r}: {arguments.run} has {listed(known)}.")
    twin = settings.twin(robot)
    with threads_for(1), Progress("twin", len(names), "trials") as progress:
        for name in names:
            twin.reset()
            packets, following = list(trial_packets(robot, name)), 0.0
            if settings.planned:
                twin.plan((packet.time, packet.inputs) for packet in packets)
            estimates, predictions = list[float](), list[float]()
            for packet in packets:
                began = time.perf_counter()
                twin.take(packet.time, packet.markers, **packet.inputs)
                now = twin.now
                estimates.append(1e3 * (time.perf_counter() - began))
                if now.time >= following:
                    began, following = time.perf_counter(), now.time + arguments.every
                    with suppress(ConvergenceError):  # The twin counts it.
                        twin.ahead()
                    predictions.append(1e3 * (time.perf_counter() - began))
            row = {
                "trial": name,
                "estimate_ms": np.median(estimates),
                "p99_ms": np.percentile(estimates, 99),
            }
            rows.append({**row, "prediction_ms": np.median(predictions)})
            off = twin.disagreement
            if off is not None:
                rows[-1] |= {"twin_mm": off.twin, "held_mm": off.held, "engine_mm": off.simulator}
                rows[-1] |= {
                    "covered": off.covered,
                    "predictions": off.predictions,
                    "best": off.best,
                }
            progress.advance()
    return {f"twin, {settings.engine}, {settings.horizon:g} s ahead": rows}
