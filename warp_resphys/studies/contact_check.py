"""Contact beside theory, and the time of a step in contact; a page of results.

==================  ==================================================================================================
incline             a block sticks up to arctan mu, where it creeps with v_s (1 - sqrt(1 - tan a / mu)), and is
                    accelerated by g (sin a - mu cos a) beyond
stopping            a sliding block comes to rest after v^2 / (2 mu g)
sphere, cylinder    are pressed into a bonded layer with the forces of theory (`indentation`)
throws, plates      no vertex of a surface penetrates, and every solve converges
energy              implicit Euler gains none
bodies              on one another (`surface_check`)
cases               of Erleben, a mat, rollers, a funnel, a clip and a tentacle, whose surfaces never cross; a house of
                    cards stands and falls by its friction (`contact_cases`)
==================  ==================================================================================================
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import brentq

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..dynamics.trajectory import Trajectory
from ..energies.contact import Contact, vertex_areas
from ..energies.materials import Corotated
from ..energies.obstacles import Box, Capsule, Cylinder, HalfSpace, Obstacle, Sphere
from ..experiment.build import choose_device
from ..fem.body import Body
from ..io.progress import Progress
from ..io.settings import Count, Natural, Positive, Settings, Some, Word, setting
from ..mesh.mesh import Mesh, box_hexahedra, select_vertices
from ..stepping.inputs import Inputs
from ..stepping.state import State
from . import contact_cases, surface_check
from .beam import beam_mesh, clamped
from .device_check import Check, run_checks
from .indentation import DEPTHS, cylinder_errors, measured, pressure, sphere_error
from .runs import Results, made
from .tables import Sheet, show
from .timing import TimedRollout

PAGE: Final = "contact.html"
G: Final = 9.81
KAPPA, D = 2e4, 1e-3  # Pa, m
SLIP: Final = 1e-3  # v_s [m/s]
SIDE: Final = 0.02  # m
BLOCK: Final = box_hexahedra((SIDE,) * 3, (2, 2, 2))
SOFT: Final = Corotated(youngs_modulus=264e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=2e-3)
WEIGHT: Final = 1070.0 * SIDE**3 * G  # N
SHAPES: Final[Mapping[str, Obstacle]] = {
    "half-space": HalfSpace(axis=(0.3, -0.2, 0.9)),
    "sphere": Sphere(radius=0.02),
    "capsule": Capsule(radius=0.012, length=0.03, axis=(0.3, -0.2, 0.9)),
    "box": Box(edges=(0.02, 0.03, 0.04), axis=(0.3, -0.2, 0.9)),
    "cylinder": Cylinder(radius=0.015, length=0.03, axis=(0.3, -0.2, 0.9)),
}
INTEGRATORS: Final = ("implicit_euler", "bdf2")
_STOPPING: Final = (4e-3, 2e-3, 1e-3)  # time steps [s]
_THROWN: Final = tuple(itertools.product((1e-3, 1e-4), (torch.float64, torch.float32)))  # D [m] and dtype


class ContactStudy(Settings):
    """The configuration ``verify_contact``, which explains its keys."""

    device: Word
    quick: bool
    frictions: Some[Positive]
    degrees: Annotated[int, Field(ge=2)]
    throws: Natural
    speed: Positive = setting(unit="m/s")
    seed: Count
    cells: Some[Positive] = setting(unit="m")
    cylinder_cells: Some[Positive] = setting(unit="m")
    body_throws: Natural
    stones: Annotated[int, Field(ge=5)]
    batches: Some[Natural]
    repeats: Natural
    results: Word | None

    @property
    def chosen(self) -> "ContactStudy":
        """The settings, or their quick form."""
        small = {"frictions": self.frictions[:1], "degrees": 2, "throws": 20, "cells": self.cells[:1]}
        small |= {"cylinder_cells": self.cylinder_cells[:1], "body_throws": 4, "stones": 5}
        return self.changed(**small, batches=self.batches[:1], repeats=1) if self.quick else self


def contact_check(settings: ContactStudy, folder: Path) -> None:
    """Prints the checks and the times, and writes a page; exits with 1 where a check failed.

    Raises:
        InputError: an unknown device.
    """
    wp.config.log_level = wp.LOG_WARNING
    device, study = choose_device(settings.device), settings.chosen
    work = {
        "Inclined plane": incline_checks,
        "Stopping distance": stopping_checks,
        "A sphere on a block": hertz_checks,
        "A cylinder on a block": line_checks,
        "Thrown blocks": throw_checks,
        "Closing plates": plate_checks,
        "Energy": energy_checks,
    }
    sections = [run_checks(title, partial(checks, study, device)) for title, checks in work.items()]
    between = {
        "A body on a slope": partial(surface_check.slope_checks, study.quick, device),
        "Bodies thrown at one another": partial(surface_check.throw_checks, study.body_throws, study.seed, device),
        "Momentum of bodies": partial(surface_check.momentum_checks, device),
        "An arch": partial(surface_check.arch_checks, study.stones, device),
        "A house of cards": partial(contact_cases.card_checks, study.quick, device),
        "Surfaces that must not cross": partial(contact_cases.case_checks, study.quick, device),
    }
    sections += [run_checks(title, checks) for title, checks in between.items()]
    times = time_sheet(study, device)
    show(times)
    count = sum(len(section.checks) for section in sections)
    failed = sum(not check.passed for section in sections for check in section.checks)
    outcome = f"{failed} of {count} checks failed." if failed else f"{count} checks: all passed."
    date = f"{datetime.now():%Y-%m-%d}"
    sheets = [*(section.sheet(section.title) for section in sections), times]
    parts = [*(sheet.for_page() for sheet in sheets), made("verify contact")]
    Results("Contact", date, outcome, parts).write(folder / PAGE, settings.results, f"{date}-contact")
    if failed:
        raise SystemExit(1)


def on_obstacle(
    obstacle: Obstacle,
    friction: float = 0.0,
    mesh: Mesh = BLOCK,
    material: Any = SOFT,
    fixed: Any = (),
    distance: float = D,
    **options: Any,
) -> Simulator:
    """A simulator of a body with an obstacle."""
    contact = Contact({"obstacle": obstacle}, KAPPA, friction, distance, SLIP)
    options = {"gravity": (0.0, 0.0, -G), "time_step": 5e-3, **options}
    return Simulator(Body(mesh, fixed=fixed, energies=[contact]), material, **options)


def resting_floor(weight: float) -> HalfSpace:
    """A floor so far below the block that the vertices of its lower face carry its weight [N]."""
    share = weight / (KAPPA * vertex_areas(BLOCK)[select_vertices(BLOCK, z=0.0)].sum())
    s = brentq(lambda s: float(pressure(s)) - share, 1e-6, 1.0 - 1e-9)
    return HalfSpace(position=(0.0, 0.0, -D * s))


def total_energy(simulator: Simulator, trajectory: Trajectory) -> NDArray[np.float64]:
    """Kinetic and potential energy (T + 1,) of the first environment [J], with that of the barrier, without damping."""
    mass, gravity = simulator.prepare().mass[0], simulator.tensor(simulator.gravity)
    values = []
    for q, v in zip(trajectory.q, trajectory.v, strict=True):
        simulator.linearise(State(q, torch.zeros_like(q))).residual(q)
        own = mass * (0.5 * v[0].square().sum(-1) - q[0] @ gravity)
        values.append(float(simulator.workspace(1).potential.energy + own.sum()))
    return np.array(values)


def _percent(name: str, errors: NDArray[np.float64], bound: float) -> Check:
    largest = float(np.abs(errors).max(initial=0.0))
    return Check(name, f"{100.0 * largest:.2g} %", f"within {100.0 * bound:g} %", largest <= bound)


def incline_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """Whether blocks slide at whole degrees around the angle of friction, acceleration and creep, and PolyFEM's slope.

    A block slides where it is faster than v_s after a second. At tan a = mu, it is not accelerated beyond v_s: there it
    sticks if it gains no speed. Accelerations are those of half a degree and more beyond.
    """
    around = range(1 - study.degrees, 1 + study.degrees)
    cases = [(mu, math.floor(math.degrees(math.atan(mu))) + more) for mu in study.frictions for more in around]
    mu, degrees = np.array([case for case in cases if case[1] > 0]).T
    a, beyond = np.radians(degrees), degrees - np.degrees(np.arctan(mu))
    share, acceleration = np.tan(a) / mu, G * (np.sin(a) - mu * np.cos(a))
    for name in INTEGRATORS:
        half, v, seconds = _slide(mu, a, name, device)
        wrong = np.abs(beyond)[(v > SLIP) != (share > 1.0)].max(initial=0.0)
        title = f"{name}, {len(mu)} inclines: angle to arctan mu where it is wrong"
        yield Check(title, f"at most {wrong:.2f} degrees", "within 1 degree", wrong < 1.0)
        slides, sticks = beyond > 0.5, share < 1.0
        error = (v - half)[slides] / seconds / acceleration[slides] - 1.0
        yield _percent(f"{name}, {slides.sum()} that slide: acceleration", error, 2e-4)
        error = v[sticks] / (SLIP * (1.0 - np.sqrt(1.0 - share[sticks]))) - 1.0
        yield _percent(f"{name}, {sticks.sum()} that stick: speed of creep", error, 0.02)
        half, v, _ = _slide(np.array([0.49, 0.5]), np.full(2, math.atan(0.5)), name, device)
        gains = (v - half) / SLIP
        title = f"{name}, tan a = 0.5, mu 0.49 and 0.50: speed gained in the second half second / v_s"
        yield Check(title, f"{gains[0]:.1f} and {gains[1]:.4f}", "> 1 and < 0.01", gains[1] < 0.01 and gains[0] > 1.0)


def _slide(
    mu: NDArray[np.float64], angles: NDArray[np.float64], integrator: str, device: torch.device
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Speeds (B,) of blocks on an incline [m/s] half a second and a second after they are let go, and that half [s]."""
    floor = resting_floor(math.cos(float(angles.mean())) * WEIGHT)
    s = on_obstacle(floor, integrator=integrator, device=device)
    given = {"gravity": s.tensor(G * np.stack([np.sin(angles), 0.0 * angles, -np.cos(angles)], 1))}
    with torch.no_grad():
        held = s.rollout(s.rest_state(len(mu)), 100, None, {**given, "contact_friction": 4.0}).final
        given["contact_friction"] = s.tensor(mu[:, None])
        start, half = State(held.q, torch.zeros_like(held.q)), round(0.5 / s.time_step)
        v = s.rollout(start, 2 * half, None, given).v[..., 0].mean(2).cpu().numpy()
    return v[half], v[-1], half * s.time_step


def stopping_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """The way of a block that slides at 1 m/s, from where it rests."""
    mu, steps = np.array([0.2, 0.5]), _STOPPING[:2] if study.quick else _STOPPING
    expected = 0.5 / (mu * G)
    for integrator in INTEGRATORS:
        errors = []
        for h in steps:
            s = on_obstacle(resting_floor(WEIGHT), integrator=integrator, time_step=h, device=device)
            given = {"contact_friction": s.tensor(mu[:, None])}
            with torch.no_grad():
                start = s.rollout(s.rest_state(2), round(0.2 / h), None, given).final.q
                speed = s.tensor([1.0, 0.0, 0.0]).expand_as(start).clone()
                end = s.rollout(State(start, speed), round(1.1 / (mu.min() * G) / h), None, given).q[-1]
            way = (end - start)[..., 0].mean(1).cpu().numpy()
            errors.append(way / expected - 1.0)
        for k, m in enumerate(mu):
            ways = ", ".join(f"{100.0 * error[k]:.2f}" for error in errors)
            order = min(math.log2(abs(a[k] / b[k])) for a, b in itertools.pairwise(errors))
            first = integrator == "implicit_euler"  # BDF2 is within the error that a smaller step does not change
            result, asked = f"{ways} %", f"within {1e3 * steps[-1]:g} % at last"
            good = abs(errors[-1][k]) <= 10.0 * steps[-1] and (order > 0.9 or not first)
            if first:
                result, asked = f"{result}, order {order:.2f}", f"{asked}, order > 0.9"
            title = f"{integrator}, mu {m:g}, steps of {', '.join(f'{1e3 * h:g}' for h in steps)} ms"
            yield Check(title, result, asked, good)


def hertz_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """Force on a sphere of 20 mm that is pressed 0.5 mm into a block, by the size of the cells below it."""
    errors = [100.0 * sphere_error(cell, device) for cell in study.cells]
    bound = 10.0 if study.quick else 2.0
    title = f"force, cells of {', '.join(f'{1e3 * cell:g}' for cell in study.cells)} mm"
    result = f"{', '.join(f'{error:.1f}' for error in errors)} %"
    yield Check(title, result, f"within {bound:g} % at last", abs(errors[-1]) <= bound)


def line_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """Force on a cylinder of 200 mm at several depths up to 0.05 mm in a layer of 10 mm, by the size of the cells."""
    cells = study.cylinder_cells
    errors = [100.0 * cylinder_errors(cell, device) for cell in cells]
    means = [float(np.sqrt(np.mean(error**2))) for error in errors]
    last, bound = float(np.abs(errors[-1]).max()), 10.0 if study.quick else 2.0
    title = f"force at {len(DEPTHS)} depths, cells of {', '.join(f'{1e3 * cell:g}' for cell in cells)} mm"
    result = f"{', '.join(f'{mean:.2f}' for mean in means)} % (root mean square), {last:.2f} % at most at last"
    asked, good = f"within {bound:g} % at last", last <= bound
    if len(cells) > 1:
        order = float(np.polyfit(np.log(cells), np.log(means), 1)[0])
        result, asked, good = f"{result}, order {order:.1f}", f"{asked}, order > 1.5", good and order > 1.5
    yield Check(title, result, asked, good)


def throw_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """Blocks that are thrown at every shape, in random directions and with a spin; gaps are those of their vertices."""
    random = np.random.default_rng(study.seed)
    batch = max(study.throws // (len(SHAPES) * len(_THROWN)), 1)
    with Progress("throws", len(SHAPES) * len(_THROWN) * batch, "throws") as progress:
        for name, obstacle in SHAPES.items():
            for distance, dtype in _THROWN:
                hits, least, failed, iterations = _throw(obstacle, distance, dtype, batch, study.speed, random, device)
                title = f"{name}, D {1e3 * distance:g} mm, {str(dtype).removeprefix('torch.')}: {batch} throws"
                result = f"{hits} hits, gap {1e6 * least:.2g} um, {failed} failed, {iterations:.0f} iterations at most"
                yield Check(title, result, "gap > 0, 0 failed", least > 0.0 and not failed)
                progress.advance(batch)


def _throw(
    obstacle: Obstacle,
    distance: float,
    dtype: torch.dtype,
    batch: int,
    speed: float,
    random: np.random.Generator,
    device: torch.device,
) -> tuple[int, float, int, float]:
    """Returns the number of hits, the smallest gap [m], the number of failed solves, and the most iterations."""
    solver = SolverSettings(relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count")
    mesh = Mesh(BLOCK.vertices + [0.0, 0.0, 0.1], BLOCK.cells)
    s = on_obstacle(obstacle, 0.4, mesh, distance=distance, solver=solver, time_step=2e-3, dtype=dtype, device=device)
    ways = random.normal(size=(batch, 1, 3))
    ways *= np.where(ways @ obstacle.turn[:, 2:] < 0.0, -1.0, 1.0)  # from above a half-space
    ways += 0.7 * np.linalg.norm(ways, axis=-1, keepdims=True) * obstacle.turn[:, 2] * isinstance(obstacle, HalfSpace)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    spins, speeds = 20.0 * random.normal(size=(batch, 1, 3)), speed * random.uniform(0.1, 1.0, (batch, 1, 1))
    x = mesh.vertices - mesh.vertices.mean(0)
    with torch.no_grad():
        state = State(s.tensor(x + 0.06 * ways), s.tensor(np.cross(spins, x) - speeds * ways))
        trajectory = s.rollout(state, 40)
    outer = torch.as_tensor(np.flatnonzero(vertex_areas(BLOCK)), device=device)
    least = measured(obstacle, trajectory.q[:, :, outer].double().flatten(0, 1))[0].amin(1).view(-1, batch)
    failed = sum(int((~report.converged).sum()) for report in trajectory.reports)
    most = max(float(report.iterations.max()) for report in trajectory.reports)
    return int((least.amin(0) < distance).sum()), float(least.min()), failed, most


def plate_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """A plate that closes on a block by 2 mm a step."""
    solver = SolverSettings(on_failure="count")
    for distance, h in itertools.product((1e-3, 3e-4), (1e-2, 1e-3)):
        plate = HalfSpace(position=(0.0, 0.0, SIDE + 0.5 * distance), axis=(0.0, 0.0, -1.0), moves=True)
        fixed = select_vertices(BLOCK, z=0.0)
        s = on_obstacle(plate, 0.5, fixed=fixed, distance=distance, time_step=h, solver=solver, device=device)
        way = -2e-3 * torch.arange(4, device=device, dtype=s.dtype)[:, None, None]
        with torch.no_grad():
            trajectory = s.rollout(s.rest_state(), 4, Inputs(obstacle_move_z=way))
        least = float((plate.position[2] + way[:, 0, 0] - trajectory.q[1:, 0, :, 2].amax(1)).min())
        failed = sum(int((~report.converged).sum()) for report in trajectory.reports)
        most = max(int(report.iterations.max()) for report in trajectory.reports)
        name = f"2 mm a step of {1e3 * h:g} ms, D {1e3 * distance:g} mm"
        result = f"gap {1e6 * least:.2g} um, {failed} failed, {most} iterations at most"
        yield Check(name, result, "gap > 0, 0 failed", least > 0.0 and not failed)


def energy_checks(study: ContactStudy, device: torch.device) -> Iterator[Check]:
    """Largest gain of energy in a step of a block that spins, falls and rebounds, without damping."""
    floor, material = HalfSpace(position=(0.0, 0.0, -0.004)), replace(SOFT, stiffness_damping=0.0)
    for mu, h in itertools.product((0.0, 0.3), (1e-3, 2e-4)):
        s = on_obstacle(floor, mu, material=material, time_step=h, relative_tolerance=1e-11, device=device)
        start = s.rest_state()
        spin = torch.linalg.cross(s.tensor([5.0, 20.0, 3.0]).expand_as(start.q), start.q)
        with torch.no_grad():
            trajectory = s.rollout(State(start.q, spin + s.tensor([0.4, 0.0, -1.5])), round(0.04 / h))
        energy = total_energy(s, trajectory)
        gain = float(np.diff(energy).max() / energy[0])
        name = f"implicit Euler, {1e3 * h:g} ms, mu {mu:g}: largest gain in a step"
        yield Check(name, f"{gain:.1e} of the energy", "< 1e-9", gain < 1e-9)


def time_sheet(study: ContactStudy, device: torch.device) -> Sheet:
    """Times of the steps of a beam that falls onto a floor, beside those of the same beam without."""
    mesh = beam_mesh("hexahedron8", (0.1, 0.03, 0.03), (10, 3, 3))
    floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, -4e-3))}, 1e4, 0.3)
    rubber = Corotated(youngs_modulus=264e3, poissons_ratio=0.499, density=1070.0)
    bodies = {"free": clamped(mesh), "in contact": clamped(mesh, energies=[floor])}
    cases = {
        (batch, name): TimedRollout(simulator, simulator.rest_state(batch), 10 if study.quick else 60)
        for batch in study.batches
        for name, simulator in ((name, Simulator(body, rubber, device=device)) for name, body in bodies.items())
    }
    with Progress("times", (1 + study.repeats) * len(cases), "roll-outs") as progress:
        for turn in range(1 + study.repeats):
            for case in cases.values():
                case.measure()
                if not turn:  # warm
                    for durations in case.durations:
                        durations.clear()
                progress.advance()
    rows = []
    for (batch, name), case in cases.items():
        times = np.array(case.a_step(median))
        ratios = times / np.array(cases[batch, "free"].a_step(median))
        row = {"batch": batch, "beam": name, "iterations": case.iterations}
        rows.append(row | {f"t{k}": 1e3 * t for k, t in enumerate(times)} | {f"r{k}": r for k, r in enumerate(ratios)})
    columns = "batch {batch} | beam {beam} | plain {t0:.2f} | forward {t1:.2f} | backward {t2:.2f} | "
    columns += (
        "plain / free {r0:.2f} | forward / free {r1:.2f} | backward / free {r2:.2f} | iterations {iterations:.1f}"
    )
    return Sheet.of("Milliseconds a step of the whole batch, medians", columns, rows)
