"""A gripper of two fingers: a learned force, trained on one finger in free air, in a grasp."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..control.sampling import driven_input
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import NotNegative, Positive, Settings, Some, Word, setting
from ..robot.gripper import THING, GripperSettings, Thing, finger_inputs, gripper, laboratory_robot
from ..robot.loading import load
from ..robot.robot import Robot
from .tables import Sheet, show


class GraspStudy(Settings):
    """The configuration ``benchmark_grasp``, which explains its keys."""

    run: Word
    models: Some[Word]
    things: Some[Thing]
    gripper: GripperSettings
    tension: Positive = setting(unit="N")
    closing: Positive = setting(unit="s")
    rise: NotNegative = setting(unit="m")
    lifting: Positive = setting(unit="s")
    shaking: Positive = setting(unit="s")
    shake: NotNegative = setting(unit="m")
    shakes: Positive = setting(unit="Hz")

    def steps(self, time_step: float) -> int:
        """Number of steps of a grasp."""
        return round((self.closing + self.lifting + self.shaking) / time_step)

    def base(self, time: float) -> NDArray[np.float64]:
        """Displacement (3,) of the bases at a time [s], which rise, and then swing along y [m]."""
        way = min(max((time - self.closing) / self.lifting, 0.0), 1.0)
        after = max(time - self.closing - self.lifting, 0.0)
        swing = self.shake * math.sin(2.0 * math.pi * self.shakes * after) * min(self.shakes * after, 1.0)
        return np.array([0.0, swing, self.rise * (0.5 - 0.5 * math.cos(math.pi * way))])


@dataclass(frozen=True)
class Grasp:
    """A grasp by two fingers.

    Attributes:
        markers: (T, 2 M, 3) markers of both fingers at the steps of the models [m].
        height: (T,) rise of the middle of the thing [m]; None without one.
        left: whether the learned force was evaluated outside its training range.
    """

    markers: NDArray[np.float64]
    height: NDArray[np.float64] | None = None
    left: bool = False

    @classmethod
    @torch.no_grad()
    def of(cls, study: GraspStudy, robot: Robot, thing: Thing | None, driven: str, time_step: float) -> "Grasp":
        """Closes two copies of a finger by one of its inputs, and raises them."""
        scene = gripper(robot, study.gripper, thing)
        state, seen, heights = scene.begin(), list[NDArray[np.float64]](), list[float]()
        substeps = round(time_step / robot.time_step)
        for step in range(study.steps(time_step)):
            pull = study.tension * min((step + 1) * time_step / study.closing, 1.0)
            for part in range(substeps):
                moved = study.base((step + (part + 1) / substeps) * time_step)
                state = scene.step(state, finger_inputs(driven, [pull], moved))
            seen.append(torch.cat(list(scene.observe(state).values()), 1)[0].double().numpy())
            if thing is not None:
                heights.append(float(state.body.q[0, scene.scene.vertex_slice(THING), 2].mean()))
        left = any(bool(own.left.any()) for own in state.robots.values())
        start = float(scene.scene.bodies[THING].vertices[:, 2].mean()) if thing is not None else 0.0
        return cls(np.stack(seen), np.array(heights) - start if thing is not None else None, left)


def grasp_study(study: GraspStudy, folder: Path) -> None:
    """Prints errors of the fingers' markers in free air and in grasps, and writes grasp_study.json.

    Raises:
        InputError: a run whose robot has more than one input, or other wrong settings.
        DataFileError: the run is missing, unfinished or has no laboratory.
    """
    real, robots = laboratory_robot(study.run), {name: load(study.run, name) for name in study.models}
    first = next(iter(robots.values()))
    driven, h = driven_input(first), first.time_step
    if len(driven.parts) != 1:
        raise InputError(f"{study.run} has the inputs {', '.join(driven.parts)}: a finger of a gripper has one.")
    base = np.array([study.base((step + 1) * h) for step in range(study.steps(h))])
    rows, free = list[dict[str, Any]](), Grasp(np.zeros((0, 0, 3)))
    with Progress("grasps", (len(study.things) + 1) * (1 + len(robots)), "grasps") as progress:
        for thing in (None, *study.things):
            truth = Grasp.of(study, real, thing, driven.name, h)
            progress.advance()
            if thing is None:
                free = truth
                others = {"no tension": Grasp(truth.markers[:1] + base[:, None])}
            else:
                others = {"laboratory in free air": free}
            for name, robot in robots.items():
                others[name] = Grasp.of(study, robot, thing, driven.name, h)
                progress.advance()
            shaken = round((study.closing + study.lifting) / h)
            rows += [_row(thing, name, truth, grasp, shaken) for name, grasp in others.items()]
            write_json(folder / "grasp_study.json", {"hardware": hardware(), "study": study.plain(), "rows": rows})
    columns = (
        "between the fingers {thing} | model {model} | error [mm] {error_mm:.2f} | while shaken [mm] {shaken_mm:.2f} | "
        "lifted [mm] {lifted} | in the laboratory [mm] {real} | left its training {left}"
    )
    show(Sheet.of("Two fingers, beside those of the laboratory", columns, rows))


def _row(thing: Thing | None, model: str, truth: Grasp, grasp: Grasp, shaken: int) -> dict[str, Any]:
    error = 1e3 * np.linalg.norm(grasp.markers - truth.markers, axis=2).mean(axis=1)
    lifted, real = (None if own.height is None else f"{1e3 * own.height[-1]:.1f}" for own in (grasp, truth))
    return {
        "thing": thing or "nothing",
        "model": model,
        "error_mm": float(error[:shaken].mean()),
        "shaken_mm": float(error[shaken:].mean()),
        "lifted": lifted or "",
        "real": real or "",
        "left": "yes" if grasp.left else "",
    }
