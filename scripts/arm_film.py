"""The film docs/films/pick_and_place.mp4: an arm with a gripper
of two soft fingers picks a ball and places it.

warp-resphys experiment=finger
python scripts/arm_film.py runs/finger/default
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warp_resphys.data.camera import frame_of, side_axes
from warp_resphys.environments.arm_world import ArmWorld
from warp_resphys.environments.making import make_vector
from warp_resphys.environments.policies import ScriptedPlace
from warp_resphys.environments.vector import CARRIER
from warp_resphys.report.layers import (
    MEASURED,
    Layer,
    RenderScene,
    View,
    body_layers,
    obstacle_layers,
)
from warp_resphys.report.render import write_film

FILM = Path(__file__).parents[1] / "docs" / "films" / "pick_and_place.mp4"
SECONDS = 4.5
SIZE = (720, 560)  # pixels
TURN, TILT = np.radians(-55.0), np.radians(22.0)  # of the camera
MARGIN = 0.08  # around the arm, relative to its longer side
GOAL = 0.25  # opacity


def recorded(
    run: str,
) -> tuple[ArmWorld, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Returns the world, vertices (F, N, 3), those of the arm (F, P, 3),
    the goal (3,) [m], and frames a second.
    """
    robots = make_vector("pick_and_place", run, 1, seconds=SECONDS)
    world = robots.world
    policy = ScriptedPlace(robots)
    vertices, arms = [], []
    assert isinstance(world, ArmWorld)
    seen, _ = robots.reset(seed=3)
    for _ in range(robots.actions):
        vertices.append(world.bodies(robots.state)[1][0])
        arms.append(world.rigid(robots.state)[1][0])
        seen, *_ = robots.step(policy(seen))
    return (
        world,
        np.stack(vertices),
        np.stack(arms),
        robots.task.wanted(0, 0)[0],
        robots.metadata["render_fps"],
    )


def scene_of(run: str) -> RenderScene:
    """Returns the film of an episode."""
    world, vertices, arms, goal, rate = recorded(run)
    state = world.rest
    triangles = world.bodies(state)[0]
    carriers, _ = world.rigid(state)
    around = world.obstacles()
    of_ball = (triangles >= world.ball.start).all(axis=1) & (triangles < world.ball.stop).all(
        axis=1
    )
    axes = side_axes(np.array([0.0, 0.0, 1.0]), TURN, TILT)
    points = np.concatenate([*arms[::10], *vertices[::10]])
    focus, half = frame_of(points, axes, MARGIN)
    height = max(float(half[1]), float(half[0]) * SIZE[1] / SIZE[0])
    shown = triangles[of_ball]
    layers = [
        *obstacle_layers(around.points, around.triangles),
        *obstacle_layers(arms, carriers, colour=CARRIER),
        *body_layers(vertices, triangles[~of_ball], height, width=1.5),
        Layer("surface", vertices, shown, MEASURED, light=(0.62, 0.42)),
        Layer(
            "surface",
            vertices[0] + goal - vertices[0, world.ball].mean(axis=0),
            shown,
            MEASURED,
            opacity=GOAL,
        ),
    ]
    texts = [f"{number / rate:.1f} s" for number in range(len(vertices))]
    return RenderScene(
        [View(layers, axes, focus, height)], SIZE, background="white", texts=texts, fps=rate
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("name the run: python scripts/arm_film.py RUN [OUTPUT.mp4]")
    write_film(Path(sys.argv[2]) if len(sys.argv) > 2 else FILM, scene_of(sys.argv[1]))
