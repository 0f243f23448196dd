"""A step of robots on an arm of six joints, over a step of the same robots
whose base moves in the same way.
"""

import argparse
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from warp_resphys.coupling.mount import Mount, MountedState
from warp_resphys.coupling.mounting_body import mujoco_package
from warp_resphys.experiment.build import build_mesh, choose_device
from warp_resphys.io.settings import parse
from warp_resphys.overrides import composed
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import SimulatorSettings
from warp_resphys.settings.run import RunSettings

from .measuring import now, take_turns

STEPS: Final = 40
_LINKS: Final = (
    (0.1, "0 0 1"),
    (0.25, "0 1 0"),
    (0.2, "0 1 0"),
    (0.1, "1 0 0"),
    (0.08, "0 1 0"),
    (0.05, "1 0 0"),
)
_HOLD: Final = np.array([0.0, -0.6, 1.0, 0.0, 0.5, 0.0])  # angles of the joints [rad]
_SWING: Final = 0.3  # of all joints [rad]
_LAST_MASS: Final = 0.1  # of the mounting body [kg]


def arm(time_step: float) -> str:
    """Returns the MJCF of an arm of six joints, whose last body is the flange."""
    bodies, ends = "", ""
    place = "0 0 .1"
    for number, (length, axis) in enumerate(_LINKS):
        name, mass = ("flange", _LAST_MASS) if number == 5 else (f"link_{number}", 10.0 * length)
        bodies += (
            f'<body name="{name}" pos="{place}"><joint name="joint_{number}" axis="{axis}" '
            f'damping="2"/><geom type="capsule" fromto="0 0 0 {length} 0 0" size=".03" '
            f'mass="{mass}" contype="0" conaffinity="0"/>'
        )
        ends, place = f"{ends}</body>", f"{length} 0 0"
    motors = "".join(f'<position joint="joint_{number}" kp="300"/>' for number in range(6))
    option = f'<option timestep="{time_step}" gravity="0 0 -9.80709" integrator="implicitfast"/>'
    world = f"<worldbody>{bodies}{ends}</worldbody>"
    return f"<mujoco>{option}{world}<actuator>{motors}</actuator></mujoco>"


def measure_mounts(arguments: argparse.Namespace) -> dict[str, Any]:
    """Moves the arm, by turns with the robot alone on the same motion of its base.

    Returns:
        Of every batch and number of substeps of MuJoCo, medians of a step of all robots on their
        arms and alone [ms], their ratio, and the time of `Mount.begin`; and the time of the
        yardstick.

    Raises:
        InputError: an unknown setting, or MuJoCo is not installed.
    """
    overrides = [
        "time_step=0.005",
        "integrator=implicit_euler",
        f"device={choose_device(arguments.device)}",
    ]
    settings = parse(RunSettings, composed("config", [*overrides, *arguments.settings]))
    description = Description(
        "beam",
        "simulation",
        SimulatorSettings.of(settings),
        settings.simulation,
        build_mesh(settings.mesh),
    )
    robot = Robot(description, choose_device(arguments.device))
    rows = list[dict[str, Any]]()
    yardsticks = []
    for batch in arguments.batches:
        for substeps in arguments.substeps:
            cases, timed = _cases(robot, batch, substeps)
            (both, alone), yardstick = take_turns(
                f"{batch} arms, {substeps} substeps", cases, arguments.repeats
            )
            about = {
                "arms": batch,
                "substeps": substeps,
                "vertices": robot.simulator.body.n_vertices,
            }
            times = {
                "coupled_ms": both["ms"],
                "alone_ms": alone["ms"],
                "ratio": both["ms"] / alone["ms"],
            }
            rows.append({**about, **times, "begin_ms": timed})
            yardsticks.append(yardstick)
    return {"a step of all robots on arms": rows, "yardstick_ms": float(np.median(yardsticks))}


def _cases(
    robot: Robot, batch: int, substeps: int
) -> tuple[list[Callable[[], dict[str, float]]], float]:
    """Returns tasks with and without the arm, and the time of `Mount.begin` [ms]."""
    mujoco = mujoco_package()
    mount = Mount(robot, mujoco.MjModel.from_xml_string(arm(robot.time_step / substeps)), "flange")
    device = robot.simulator.rest_positions.device
    starts = [mujoco.MjData(mount.model) for _ in range(batch)]
    for number, start in enumerate(starts):
        start.qpos[:] = _HOLD + 0.01 * number
        start.ctrl[:] = start.qpos
    mount.begin(starts)
    began = now(device)
    first = mount.begin(starts)
    timed = 1e3 * (now(device) - began)
    controls = [
        np.stack([start.qpos for start in starts]) + _SWING * np.sin(0.03 * number) ** 2
        for number in range(STEPS)
    ]

    def coupled(keep: list[MountedState] | None = None) -> dict[str, float]:
        state, began = first, now(device)
        for ctrl in controls:
            state = mount.step(state, ctrl)
            if keep is not None:
                keep.append(state)
        return {"ms": 1e3 * (now(device) - began) / STEPS}

    reached: list[MountedState] = []
    coupled(reached)

    def alone() -> dict[str, float]:
        state, began = first.robot, now(device)
        for one in reached:
            state = robot.step(state, base=one.pose)
        return {"ms": 1e3 * (now(device) - began) / STEPS}

    return [coupled, alone], timed
