"""A soft block on obstacles, distances of points from them, and surfaces that cross."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import brentq

from warp_resphys import (
    Body,
    Contact,
    Corotated,
    HalfSpace,
    Simulator,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.energies.contact.contact_points import vertex_areas
from warp_resphys.core.energies.contact.pairs import PairList, Surface
from warp_resphys.core.energies.contact.touching_bodies import Capsule, Cylinder, Obstacle, Sphere
from warp_resphys.core.energies.launcher import Launcher

G = 9.81
KAPPA, D = 2e4, 1e-3  # Pa, m
SIDE = 0.02  # m
BLOCK = box_hexahedra((SIDE,) * 3, (2, 2, 2))
SOFT = Corotated(youngs_modulus=264e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=2e-3)
WEIGHT = SOFT.density * SIDE**3 * G  # N


def on_obstacles(
    obstacles,
    mu=0.0,
    material=SOFT,
    mesh=BLOCK,
    fixed=(),
    slip_speed=1e-3,
    distance=D,
    kappa=KAPPA,
    **options,
):
    """A simulator of a body with obstacles."""
    obstacles = obstacles if isinstance(obstacles, dict) else {"obstacle": obstacles}
    contact = Contact(
        obstacles, stiffness=kappa, friction=mu, distance=distance, slip_speed=slip_speed
    )
    options = {"time_step": 5e-3, "gravity": (0.0, 0.0, -G), **options}
    return Simulator(Body(mesh, fixed=fixed, energies=[contact]), material, **options)


def pressure(s):
    """Pressure of the barrier over kappa at the distance s D, for s <= 1."""
    return 2.0 * (s - 1.0) * np.log(s) + (s - 1.0) ** 2 / s


def resting_floor(weight: float) -> HalfSpace:
    """A floor so far below the block that the vertices of its lower face carry its weight [N]."""
    share = weight / (KAPPA * vertex_areas(BLOCK)[select_vertices(BLOCK, z=0.0)].sum())
    s = brentq(lambda s: float(pressure(s)) - share, 1e-6, 1.0 - 1e-9)
    return HalfSpace(position=(0.0, 0.0, -D * s))


def distances(obstacle: Obstacle, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distances (...) of positions (..., 3) from an obstacle, by projection on its shape."""
    y = (x - np.asarray(obstacle.position)) @ obstacle.turn
    half = np.array(obstacle.size)
    if isinstance(obstacle, HalfSpace):
        return y[..., 2]
    if isinstance(obstacle, Sphere | Capsule):
        half = np.array([0.0, 0.0, half[2]])
        return np.linalg.norm(y - np.clip(y, -half, half), axis=-1) - obstacle.radius
    if isinstance(obstacle, Cylinder):
        y = np.stack([np.hypot(y[..., 0], y[..., 1]), y[..., 2]], -1)
        half = np.array([obstacle.radius, half[2]])
    outside = np.linalg.norm(y - np.clip(y, -half, half), axis=-1)
    return np.where(outside > 0.0, outside, (np.abs(y) - half).max(-1))


def crossings_and_gap(mesh, path: torch.Tensor, reach: float) -> tuple[int, float]:
    """Number of positions (T, N, 3) [m] at which surfaces cross,
    and their least distance [m] within reach.
    """
    pairs = PairList(Launcher(1, path.device), Surface.of(mesh), reach)
    crossed, gap = 0, math.inf
    for q in path[:, None].double():
        crossed += int(pairs.crossings(q)[0]) > 0
        pairs.find(q, torch.zeros_like(q))
        gap = min(gap, float(pairs.distances(q).min())) if pairs.count else gap
    return crossed, gap


def solves(path) -> tuple[int, int]:
    """Number of failed solves of a roll-out, and the most iterations of one."""
    failed = sum(int((~report.converged).sum()) for report in path.reports)
    return failed, max(int(report.iterations.max()) for report in path.reports)
