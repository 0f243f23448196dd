"""Times the simulator: forward and backward steps, the parts of a step, the cold start, environments, controllers.

The cases of a refinement and the yardstick of `timing` take turns.
"""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from pydantic import Field

from ..dynamics.assembly import HessianAssembly
from ..dynamics.nonlinear_solver import SolverName
from ..dynamics.simulator import Simulator
from ..experiment.build import build_body, build_simulator, choose_device, finer
from ..fem.body import Body
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import Many, Natural, NotNegative, Positive, Settings, Some, Word, parse, setting
from ..io.stages import package_versions
from ..linalg.threads import threads_for
from ..settings.body import MaterialSettings, SimulationSettings
from ..settings.mesh import HexahedralBox, MeshSettings, TetrahedralBox
from ..settings.obstacles import ContactSettings, ObstacleSettings
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .benchmark_history import record, write_record
from .run_speed import command_sheet, environment_sheet, time_commands, time_environments
from .runs import Results, made
from .tables import Sheet, show
from .timing import TimedRollout, median_seconds, now, run_in_new_process, yardstick_seconds

PAGE = "benchmark.html"
PARTS: Final = ("local_step", "tangent", "assembly", "factor", "solve")
ByRefinement = Annotated[dict[Natural, Natural], Field(min_length=1)]


_MODULI: Final = ("youngs_modulus", "c10", "bulk_1")  # by the first of which gradients are taken
_FASTEST: Final = "quasi_newton"  # solver with which laws are timed, in the smallest batch, and contact


class ElasticConstants(Settings):
    """Elastic constants of a case, in place of the configured ones."""

    poissons_ratio: float
    youngs_modulus: Positive = setting(unit="Pa")


class Batches(Settings):
    """Batch sizes by kind of device."""

    cpu: Some[Natural]
    cuda: Some[Natural]

    def on(self, device: str) -> Sequence[int]:
        """Returns the batch sizes for a device."""
        return self.cuda if device.startswith("cuda") else self.cpu


class SolverLimits(Settings):
    """Refinements, batch sizes and steps of one solver, in place of those of all solvers."""

    refinements: Some[Natural] | None = None
    batches: Some[Natural] | None = None
    steps: Natural | None = None


class ContactRows(Settings):
    """Obstacles of a body that is timed in contact beside the same one without."""

    obstacles: dict[str, ObstacleSettings]
    contact: ContactSettings
    batches: Batches


class TimedRun(Settings):
    """A run whose environments or controllers are timed."""

    run: Word | None
    robots: Many[Natural] = ()


class BenchmarkSettings(Settings):
    """The group ``benchmark``; ``conf/benchmark.yaml`` explains its keys."""

    quick: bool
    solvers: Some[SolverName]
    materials: Some[ElasticConstants]
    laws: Many[MaterialSettings] = ()
    contact: ContactRows | None = None
    refinements: Some[Natural]
    batches: Batches
    largest_batch: ByRefinement
    steps: ByRefinement
    projective_dynamics: SolverLimits = SolverLimits()
    quasi_newton: SolverLimits = SolverLimits()
    newton: SolverLimits = SolverLimits()
    relative_tolerance: Positive
    max_iterations: Natural
    tip_mass: NotNegative = setting(unit="kg")
    pressure: float = setting(unit="Pa")
    repeats: Natural
    seconds: Positive
    parts_repeats: Natural
    cold_start: bool
    environments: TimedRun
    control: TimedRun
    results: Word | None
    record: Word | None = None

    def batches_of(self, solver: str, refinement: int, device: str) -> list[int]:
        """Batch sizes with which a solver is timed."""
        limits: SolverLimits = getattr(self, solver)
        if refinement not in (limits.refinements or [refinement]):
            return []
        return self.fitting(limits.batches or self.batches.on(device), refinement)

    def fitting(self, batches: Sequence[int], refinement: int) -> list[int]:
        """Batch sizes that fit a GPU at a refinement."""
        return [batch for batch in batches if batch <= _at(self.largest_batch, refinement)]

    def steps_of(self, solver: str, refinement: int) -> int:
        """Number of steps of a roll-out with a solver."""
        limits: SolverLimits = getattr(self, solver)
        return limits.steps or _at(self.steps, refinement)


class BenchmarkRun(SimulationSettings):
    """The configuration ``benchmark``: the simulator that is timed, and how."""

    benchmark: BenchmarkSettings


# The coarsest mesh and a single environment, twice.
_ONE: Final = Batches(cpu=(1,), cuda=(1,))
_QUICK: Final = {"refinements": (1,), "batches": _ONE, "repeats": 2, "parts_repeats": 10}


@dataclass
class BenchmarkCase:
    """One row of the benchmark."""

    solver: str
    material: MaterialSettings
    refinement: int  # of the configured box
    batch: int
    timed: TimedRollout
    touches: bool = False  # whether the body has the obstacles of `ContactRows`

    def measure(self) -> None:
        """Times a roll-out, and its gradient with respect to start, force at every step and a modulus."""
        timed, constants = self.timed, self.material.constants
        name = next(name for name in _MODULI if name in constants)
        modulus = timed.simulator.tensor(constants[name]).reshape(1)
        forces = timed.start.q.new_zeros(timed.steps, *timed.start.q.shape).requires_grad_(True)
        timed.inputs = timed.inputs.replace(external_force=forces)
        timed.measure({name: modulus.requires_grad_(True)})

    def row(self) -> dict[str, Any]:
        """The case as a row of benchmark.json; times are those of one step of the whole batch."""
        plain, forward, backward = self.timed.a_step(median)
        _, least_forward, least_backward = self.timed.a_step(min)
        return {
            "solver": self.solver,
            "model": self.material.model,
            "poissons_ratio": self.material.constants.get("poissons_ratio"),
            "refinement": self.refinement,
            "unknowns": self.timed.unknowns,
            "batch": self.batch,
            "contact": self.touches,
            "steps": self.timed.steps,
            "repeats": len(self.timed.forward),
            "plain_ms": 1e3 * plain,
            "forward_ms": 1e3 * forward,
            "backward_ms": 1e3 * backward,
            "fastest_forward_ms": 1e3 * least_forward,
            "fastest_backward_ms": 1e3 * least_backward,
            "iterations": self.timed.iterations,
            "factorisations": self.timed.factorisations,
        }


def benchmark(settings: BenchmarkRun, folder: Path) -> None:
    """Writes benchmark.json and a page into the run folder, and prints the tables of `run_benchmark`."""
    result = run_benchmark(settings)
    write_json(folder / "benchmark.json", result)
    sheets = benchmark_sheets(result)
    show(*sheets, f"Written: {folder / 'benchmark.json'}")
    date, device = f"{datetime.now():%Y-%m-%d}", result["settings"]["device"].partition(":")[0]
    verdict = f"{machine(result)}: medians over repeats; a yardstick, the same task in NumPy, takes its turn with them."
    made_by = made("benchmark", ("benchmark.environments.run", "benchmark.control.run"))
    results = Results("Benchmark", date, verdict, [*(sheet.for_page() for sheet in sheets), made_by])
    results.write(folder / PAGE, settings.benchmark.results, f"{date}-benchmark-{device}")
    if settings.benchmark.record is not None:
        kept = record(result, machine(result), HydraConfig.get().overrides.task)
        print(f"Record: {write_record(Path(settings.benchmark.record), kept)}")


def run_benchmark(settings: BenchmarkRun) -> dict[str, Any]:
    """Measures everything that the group ``benchmark`` of a configuration asks for.

    Returns:
        ``steps`` (a row for each `BenchmarkCase`), ``parts`` (milliseconds of the parts of a step), ``cold_start``
        (seconds of a new process without and with compiled kernels), ``environments`` and ``control`` (rows of
        `run_speed`), ``yardstick_ms``, ``hardware``, ``versions``, ``date`` and ``settings``.

    Raises:
        InputError: a configuration that cannot be simulated or refined.
    """
    timed = settings.benchmark
    if timed.quick:
        contact = timed.contact and timed.contact.changed(batches=_ONE)
        timed = timed.changed(**_QUICK, contact=contact)
    settings = settings.changed(device=str(choose_device(settings.device)), benchmark=timed)
    # Runs come first: a folder without a run is an error that should not follow minutes of measurements.
    trained, driven, repeats = timed.environments, timed.control.run, timed.repeats
    environments = time_environments(Path(trained.run), trained.robots, repeats, settings.device) if trained.run else []
    control = time_commands(Path(driven), repeats) if driven else []
    yardstick: list[float] = []
    steps: list[dict[str, Any]] = []
    parts: list[dict[str, Any]] = []
    for refinement in timed.refinements:
        cases = benchmark_cases(settings, refinement)
        _take_turns(cases, timed, yardstick)
        steps += [case.row() for case in cases]
        by_batch = {case.batch: case for case in reversed(cases)}
        parts += [_time_parts(by_batch[batch], timed.parts_repeats) for batch in sorted(by_batch)]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": {**hardware(), "torch threads": torch.get_num_threads()},
        "versions": package_versions(),
        "settings": {**timed.plain(), "device": settings.device, "dtype": settings.dtype},
        "yardstick_ms": 1e3 * median(yardstick),
        "steps": steps,
        "parts": parts,
        "cold_start": cold_start(settings) if timed.cold_start else None,
        "environments": environments,
        "control": control,
    }


def benchmark_cases(settings: BenchmarkRun, refinement: int) -> list[BenchmarkCase]:
    """Every combination of solver, material and batch size at a refinement, each warmed up; and those in contact."""
    timed, shape = settings.benchmark, settings.changed(mesh=_refined(settings, refinement))
    body, cases = build_body(shape), []
    configured = settings.simulation
    materials = [configured.changed(**own.plain()) for own in timed.materials]
    for name in timed.solvers:
        for number, material in enumerate((*materials, *(timed.laws if name == _FASTEST else ()))):
            batches = timed.batches_of(name, refinement, settings.device)
            for batch in batches[: None if number < len(materials) else 1]:
                cases.append(_case(settings, name, material, refinement, batch, body))
    if not cases:
        raise InputError(
            f"benchmark.batches and benchmark.largest_batch leave none of refinement {refinement}: name a smaller one."
        )
    rows = timed.contact
    if rows is not None and _FASTEST in timed.solvers and settings.chambers is None:
        touching = build_body(shape.changed(obstacles=rows.obstacles, contact=rows.contact))
        for batch in timed.fitting(rows.batches.on(settings.device), refinement):
            cases.append(_case(settings, _FASTEST, materials[0], refinement, batch, touching, touches=True))
    return cases


def _case(
    settings: BenchmarkRun,
    solver: SolverName,
    material: MaterialSettings,
    refinement: int,
    batch: int,
    body: Body,
    touches: bool = False,
) -> BenchmarkCase:
    """A case after two steps, which compile its kernels."""
    timed = settings.benchmark
    tolerances = {"relative_tolerance": timed.relative_tolerance, "max_iterations": timed.max_iterations}
    solved, steps = settings.solver.changed(name=solver, **tolerances), timed.steps_of(solver, refinement)
    simulator = build_simulator(settings.changed(solver=solved), material, body)
    start, inputs = _start(simulator, timed, batch, steps, touches)
    simulator.rollout(start, 2, Inputs(**{key: value[:2] for key, value in inputs.fields.items()}))
    return BenchmarkCase(solver, material, refinement, batch, TimedRollout(simulator, start, steps, inputs), touches)


def _refined(settings: BenchmarkRun, refinement: int) -> MeshSettings:
    """The mesh of a refined box, or of a body with chambers, which has refinement 1 alone."""
    if isinstance(settings.mesh, HexahedralBox | TetrahedralBox):
        return finer(settings.mesh, refinement)
    if settings.chambers is None:
        raise InputError(
            "the benchmark refines a box, or drives a body with chambers: choose mesh=beam_hexahedra or "
            "mesh=beam_tetrahedra, or experiment=sopra."
        )
    if refinement != 1:
        raise InputError("a body with chambers is taken as it is: set benchmark.refinements=[1].")
    return settings.mesh


def _start(
    simulator: Simulator, settings: BenchmarkSettings, batch: int, steps: int, touches: bool
) -> tuple[State, Inputs]:
    """Start and inputs of a roll-out: released from a weight or, with chambers, at rest before pressures rise.

    A body that touches obstacles is lifted by the weight and falls.
    """
    chambers = simulator.counts.get("pressure", 0)
    if not chambers:
        return released(simulator, -settings.tip_mass if touches else settings.tip_mass, batch), Inputs()
    phase = simulator.tensor(np.arange(steps)[:, None, None] / steps)
    shift = simulator.tensor(np.arange(chambers) / chambers + 0.1 * np.arange(batch)[:, None])
    pressures = 0.5 * settings.pressure * (1.0 - torch.cos(2.0 * torch.pi * (phase + shift)))
    return simulator.static_equilibrium(Inputs(pressure=pressures[0])).detach(), Inputs(pressure=pressures)


def _at(values: Mapping[int, int], refinement: int) -> int:
    """The value of a refinement; of one that is not listed, that of the largest."""
    return values.get(refinement, values[max(values)])


def released(simulator: Simulator, mass: float, batch: int) -> State:
    """Equilibrium under a mass [kg] on the face of the largest x, lighter in each further environment of a batch.

    A negative mass lifts it.
    """
    x = simulator.rest_positions[:, 0]
    tip = x >= x.max() - 1e-9 * (x.max() - x.min())
    share = tip.to(simulator.dtype) / tip.sum()  # (N,)
    masses = mass * (1.0 - 0.5 * torch.arange(batch, device=x.device, dtype=simulator.dtype) / batch)
    force = masses[:, None, None] * share[:, None] * simulator.tensor(simulator.gravity)
    return simulator.static_equilibrium(Inputs(force)).detach()


def _take_turns(cases: list[BenchmarkCase], settings: BenchmarkSettings, yardstick: list[float]) -> None:
    with Progress(f"refinement {cases[0].refinement}", len(cases) * settings.repeats, "runs") as progress:
        for _ in range(settings.repeats):
            for case in cases:
                if sum(sum(own) for own in case.timed.durations) <= settings.seconds:
                    case.measure()
                progress.advance()
            yardstick.append(yardstick_seconds())


def _time_parts(case: BenchmarkCase, repeats: int) -> dict[str, Any]:
    """Milliseconds of the parts of a solver iteration, for the whole batch, in the last state of a case."""
    sim = case.timed.simulator
    workspace = sim.workspace(case.batch)
    potential, pattern = workspace.gather(), workspace.pattern
    device = potential.device
    linear = workspace.linear_solver(sim.settings.linear_solver, sim.dtype)
    assemble = HessianAssembly(potential, linear, pattern)
    potential.update_tangent()
    values = assemble().to(sim.dtype, copy=True)
    factor = linear.factor(values.clone())
    right = torch.ones(case.batch, linear.n, 1, device=device, dtype=sim.dtype)
    tasks: dict[str, Callable[[], object]] = {
        "local_step": potential.evaluate,
        "tangent": potential.update_tangent,
        "assembly": assemble,
        "factor": lambda: linear.factor(values.clone()),
        "solve": lambda: factor.solve(right),
    }
    with threads_for(linear.n):  # as in a step
        times = {f"{name}_ms": 1e3 * median_seconds(tasks[name], repeats, device) for name in PARTS}
    return {"refinement": case.refinement, "batch": case.batch, "linear_solver": type(linear).__name__, **times}


def cold_start(settings: SimulationSettings) -> dict[str, dict[str, float]]:
    """Seconds in which a new process imports, loads its kernels and steps, without (cold) and with a kernel cache.

    Raises:
        RuntimeError: the process failed.
    """
    result, values = {}, SimulationSettings.of(settings).plain()
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            imported, times = run_in_new_process(first_step, values, environment={"WARP_CACHE_PATH": cache})
            result[name] = {"import_s": imported, **times}
    return result


def first_step(values: dict[str, Any]) -> dict[str, float]:
    """Seconds of the first step of this process, with `SimulationSettings` as plain data."""
    began = time.perf_counter()
    settings = parse(SimulationSettings, values)
    simulator = build_simulator(settings, settings.simulation)
    state = simulator.rest_state()
    built = time.perf_counter()
    potential = simulator.workspace(1).potential
    potential.update_tangent()
    kernels = now(potential.device)
    simulator.step(state)
    stepped = now(potential.device)
    return {"build_s": built - began, "kernels_s": kernels - built, "first_step_s": stepped - kernels}


def machine(result: Mapping[str, Any]) -> str:
    """The name of the GPU or processor that was measured."""
    kind = "GPU" if str(result["settings"]["device"]).startswith("cuda") else "processor"
    return str(result["hardware"][kind])


def benchmark_sheets(result: Mapping[str, Any]) -> list[Sheet]:
    """The tables of a result of `run_benchmark`."""
    yardstick, cold = result["yardstick_ms"], result["cold_start"]
    steps = [
        {
            **row,
            "relative": row["forward_ms"] / yardstick,
            "steps_s": 1e3 * row["batch"] / row["plain_ms"],
            "material": row["poissons_ratio"] or row["model"],
            "touches": "yes" if row["contact"] else "",
        }
        for row in result["steps"]
    ]
    columns = (
        "solver {solver} | nu {material} | contact {touches} | unknowns {unknowns} | batch {batch} | "
        "plain {plain_ms:.2f} | forward {forward_ms:.2f} | backward {backward_ms:.2f} | / yardstick {relative:.2f} | "
        "steps/s {steps_s:.0f} | iterations {iterations:.1f} | "
        "factors {factorisations:.2f}"
    )
    title = (
        f"Milliseconds a step of the whole batch (plain: without gradients), {machine(result)} "
        f"(yardstick {yardstick:.2f} ms)"
    )
    part_columns = [f"{part.replace('_', ' ')} {{{part}_ms:.3f}}" for part in PARTS]
    sheets = [
        Sheet.of(title, columns, steps),
        Sheet.of(
            "Milliseconds of the parts",
            " | ".join(["refinement {refinement}", "batch {batch}", *part_columns]),
            result["parts"],
        ),
    ]
    if cold is not None:
        names = [f"{name.removesuffix('_s').replace('_', ' ')} {{{name}:.2f}}" for name in cold["cold"]]
        rows = [{"cache": kind, **times} for kind, times in cold.items()]
        sheets.append(Sheet.of("Seconds of a new process", " | ".join(["kernel cache {cache}", *names]), rows))
    if result["environments"]:
        sheets.append(environment_sheet(result["environments"]))
    if result["control"]:
        sheets.append(command_sheet(result["control"]))
    return sheets
