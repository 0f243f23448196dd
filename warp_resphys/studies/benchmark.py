"""Times the simulator: forward and backward steps, the parts of a step, the cold start.

Machines differ, and so does one machine from minute to minute. The cases of a refinement therefore take turns, medians
are reported, and a fixed task of LAPACK, the *yardstick*, takes its turn with them: times over the yardstick's compare.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from ..dynamics.assembly import HessianAssembly
from ..dynamics.nonlinear_solver import SOLVERS
from ..dynamics.simulator import Simulator
from ..experiment.build import build_body, build_simulator, choose_device
from ..experiment.schema import (
    FINITE,
    NATURAL,
    NATURALS,
    NOT_NEGATIVE,
    POSITIVE,
    TRUTH_VALUE,
    WORD,
    Group,
    Kind,
    absent,
    check,
    optional,
)
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.stages import package_versions
from ..linalg.threads import threads_for
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .benchmark_tables import PARTS, benchmark_sheets, machine
from .command import show
from .control_speed import time_commands
from .environment_speed import time_environments
from .runs import Results, made

PAGE = "benchmark.html"
_YARDSTICK_SIZE: Final = 480
_BY_REFINEMENT: Final = Kind(
    lambda value: isinstance(value, Mapping) and bool(value) and all(map(NATURAL.fits, (*value, *value.values()))),
    "whole numbers by refinement, one or more",
)
_LIMITS: Final = Group({"refinements": absent(NATURALS), "batches": absent(NATURALS), "steps": absent(NATURAL)})
_KEYS: Final = Group(
    {
        **dict.fromkeys(SOLVERS, absent(_LIMITS)),
        **dict.fromkeys(("quick", "cold_start"), TRUTH_VALUE),
        "solvers": Kind(lambda value: isinstance(value, list) and bool(value), "a list of solvers"),
        "materials": Kind(lambda value: isinstance(value, list) and bool(value), "a list of materials"),
        "refinements": NATURALS,
        "batches": Group({"cpu": NATURALS, "cuda": NATURALS}),
        **dict.fromkeys(("largest_batch", "steps"), _BY_REFINEMENT),
        **dict.fromkeys(("repeats", "parts_repeats", "max_iterations"), NATURAL),
        **dict.fromkeys(("relative_tolerance", "seconds"), POSITIVE),
        "tip_mass": NOT_NEGATIVE,
        "pressure": FINITE,
        "environments": Group({"run": optional(WORD), "robots": NATURALS}),
        "control": Group({"run": optional(WORD)}),
        "results": optional(WORD),
    }
)
_MATERIAL: Final = Group({"poissons_ratio": FINITE, "youngs_modulus": POSITIVE})
# The coarsest mesh and a single environment, twice.
_QUICK: Final = {"refinements": [1], "batches": {"cpu": [1], "cuda": [1]}, "repeats": 2, "parts_repeats": 10}


@dataclass
class Case:
    """One row of the benchmark: a simulator at the state it starts from, and what was measured of it."""

    solver: str
    material: Mapping[str, float]  # Young's modulus [Pa] and Poisson's ratio
    refinement: int  # of the configured box
    batch: int
    steps: int  # of a roll-out
    simulator: Simulator
    start: State
    inputs: Inputs  # pressures in its chambers, if it has any
    forward: list[float] = field(default_factory=list)  # [s] of each roll-out
    backward: list[float] = field(default_factory=list)  # [s] of each adjoint
    iterations: float = 0.0  # mean a step
    factorisations: float = 0.0  # mean a step

    def measure(self) -> None:
        """One roll-out, and its gradient by the start, the force at every step and Young's modulus."""
        sim, b, n = self.simulator, self.batch, self.simulator.body.n_vertices
        q, v = (t.clone().requires_grad_(True) for t in (self.start.q, self.start.v))
        forces = torch.zeros(self.steps, b, n, 3, device=q.device, dtype=q.dtype, requires_grad=True)
        modulus = sim.tensor(self.material["youngs_modulus"]).reshape(1).requires_grad_(True)
        began = now(q.device)
        inputs = self.inputs.replace(external_force=forces)
        trajectory = sim.rollout(State(q, v), self.steps, inputs, {"youngs_modulus": modulus})
        done = now(q.device)
        loss = trajectory.q[-1].square().sum() + trajectory.v[-1].square().sum()
        turned = now(q.device)
        torch.autograd.grad(loss, (q, v, forces, modulus))
        self.backward.append(now(q.device) - turned)
        self.forward.append(done - began)
        self.iterations = float(np.mean([r.iterations.double().mean().item() for r in trajectory.reports]))
        self.factorisations = float(np.mean([r.factorisations.double().mean().item() for r in trajectory.reports]))

    def row(self) -> dict[str, Any]:
        """The case for the file; times are of one step of the whole batch."""
        return {
            "solver": self.solver,
            **self.material,
            "refinement": self.refinement,
            "unknowns": 3 * (self.simulator.body.n_vertices - len(self.simulator.fixed)),
            "batch": self.batch,
            "steps": self.steps,
            "repeats": len(self.forward),
            "forward_ms": 1e3 * median(self.forward) / self.steps,
            "backward_ms": 1e3 * median(self.backward) / self.steps,
            "fastest_forward_ms": 1e3 * min(self.forward) / self.steps,
            "fastest_backward_ms": 1e3 * min(self.backward) / self.steps,
            "iterations": self.iterations,
            "factorisations": self.factorisations,
        }


def benchmark(config: Mapping[str, Any], folder: Path) -> None:
    """Writes benchmark.json and a page into the run folder and prints its tables; see `run_benchmark`."""
    result = run_benchmark(config)
    write_json(folder / "benchmark.json", result)
    sheets = benchmark_sheets(result)
    show(*(sheet.for_terminal() for sheet in sheets), f"Written: {folder / 'benchmark.json'}")
    date, device = f"{datetime.now():%Y-%m-%d}", result["settings"]["device"].partition(":")[0]
    verdict = f"{machine(result)}: medians over repeats; a yardstick, the same task in NumPy, takes its turn with them."
    parts = [
        *(sheet.for_page() for sheet in sheets),
        made("benchmark", ("benchmark.environments.run", "benchmark.control.run")),
    ]
    results = Results("Benchmark", date, verdict, parts)
    results.write(folder / PAGE, config["benchmark"]["results"], f"{date}-benchmark-{device}")


def run_benchmark(config: Mapping[str, Any]) -> dict[str, Any]:
    """Measures everything that the section ``benchmark`` of a configuration asks for.

    Returns:
        ``steps`` (a row for each `Case`), ``parts`` (milliseconds of the parts of a step), ``cold_start`` (seconds of a
        new process without and with compiled kernels), ``environments`` (see `time_environments`), ``control`` (see
        `time_commands`), ``yardstick_ms``, ``hardware``, ``versions``, ``date`` and ``settings``.

    Raises:
        InputError: a configuration that cannot be simulated or refined.
    """
    settings = dict(config["benchmark"])
    check("benchmark", settings, _KEYS)
    config = {**config, "device": str(choose_device(config["device"]))}  # What auto is here.
    for number, material in enumerate(settings["materials"]):
        check(f"benchmark.materials.{number}", material, _MATERIAL)
    if settings["quick"]:
        settings |= _QUICK
    environments, control = _of_runs(settings, config["device"])  # First, as a run may be none.
    yardstick: list[float] = []
    steps: list[dict[str, Any]] = []
    parts: list[dict[str, Any]] = []
    for refinement in settings["refinements"]:
        cases = _cases(config, settings, refinement)
        _take_turns(cases, settings, yardstick)
        steps += [case.row() for case in cases]
        timed = {case.batch: case for case in reversed(cases)}
        parts += [_time_parts(timed[batch], settings["parts_repeats"]) for batch in sorted(timed)]
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": {**hardware(), "torch threads": torch.get_num_threads()},
        "versions": package_versions(),
        "settings": {**settings, "device": config["device"], "dtype": config["dtype"]},
        "yardstick_ms": 1e3 * median(yardstick),
        "steps": steps,
        "parts": parts,
        "cold_start": cold_start(config) if settings["cold_start"] else None,
        "environments": environments,
        "control": control,
    }


def _of_runs(settings: Mapping[str, Any], device: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The environments and the controllers of runs, where they are named."""
    trained, driven = settings["environments"], settings["control"]["run"]
    environments = (
        []
        if trained["run"] is None
        else time_environments(Path(trained["run"]), trained["robots"], settings["repeats"], device)
    )
    return environments, [] if driven is None else time_commands(Path(driven), settings["repeats"])


def _cases(config: Mapping[str, Any], settings: Mapping[str, Any], refinement: int) -> list[Case]:
    """Every combination of solver, material and batch, at its start and warmed up."""
    body = build_body({**config, "mesh": _refined(config, refinement)})
    kind = "cuda" if str(config["device"]).startswith("cuda") else "cpu"
    cases = []
    for solver in settings["solvers"]:
        limits = settings.get(solver, {})
        if refinement not in limits.get("refinements", [refinement]):
            continue
        steps = limits.get("steps", _at(settings["steps"], refinement))
        batches = limits.get("batches", settings["batches"][kind])
        tolerances = {key: settings[key] for key in ("relative_tolerance", "max_iterations")}
        for material in settings["materials"]:
            changed = {
                **config,
                "simulation": {**config["simulation"], **material},
                "solver": {**config["solver"], "name": solver, **tolerances},
            }
            for batch in (b for b in batches if b <= _at(settings["largest_batch"], refinement)):
                simulator = build_simulator(changed, body=body)
                start, inputs = _start(simulator, settings, batch, steps)
                simulator.rollout(start, 2, Inputs(**{k: v[:2] for k, v in inputs.fields.items()}))
                cases.append(Case(solver, material, refinement, batch, steps, simulator, start, inputs))
    if not cases:
        raise InputError(
            f"benchmark.batches and benchmark.largest_batch leave none of refinement {refinement}: name a smaller one."
        )
    return cases


def _refined(config: Mapping[str, Any], refinement: int) -> dict[str, Any]:
    """The group ``mesh`` of a refined box, or of a body with chambers, which has one refinement."""
    mesh = dict(config["mesh"])
    if "divisions" in mesh:
        mesh["divisions"] = [refinement * int(d) for d in mesh["divisions"]]
    elif config.get("chambers") is None:
        raise InputError(
            "the benchmark refines a box, or drives a body with chambers: choose mesh=beam_hexahedra or "
            "mesh=beam_tetrahedra, or experiment=sopra."
        )
    elif refinement != 1:
        raise InputError("a body with chambers is taken as it is: set benchmark.refinements=[1].")
    return mesh


def _start(simulator: Simulator, settings: Mapping[str, Any], batch: int, steps: int) -> tuple[State, Inputs]:
    """Let go from a weight, or at rest before the pressures of its chambers come, and these pressures."""
    chambers = simulator.counts.get("pressure", 0)
    if not chambers:
        return released(simulator, settings["tip_mass"], batch), Inputs()
    phase = simulator.tensor(np.arange(steps)[:, None, None] / steps)
    shift = simulator.tensor(np.arange(chambers) / chambers + 0.1 * np.arange(batch)[:, None])
    pressures = 0.5 * settings["pressure"] * (1.0 - torch.cos(2.0 * torch.pi * (phase + shift)))
    return simulator.static_equilibrium(Inputs(pressure=pressures[0])).detach(), Inputs(pressure=pressures)


def _at(values: Mapping[Any, int], refinement: int) -> int:
    """The value for a refinement, or for the largest one that is named."""
    named = {int(r): n for r, n in values.items()}
    return int(named.get(refinement, named[max(named)]))


def released(simulator: Simulator, mass: float, batch: int) -> State:
    """Rest under a mass [kg] at the largest x, lighter in each further environment of a batch."""
    x = simulator.rest_positions[:, 0]
    tip = x >= x.max() - 1e-9 * (x.max() - x.min())
    share = tip.to(simulator.dtype) / tip.sum()  # (N,)
    masses = mass * (1.0 - 0.5 * torch.arange(batch, device=x.device, dtype=simulator.dtype) / batch)
    force = masses[:, None, None] * share[:, None] * simulator.tensor(simulator.gravity)
    return simulator.static_equilibrium(Inputs(force)).detach()


def _take_turns(cases: list[Case], settings: Mapping[str, Any], yardstick: list[float]) -> None:
    with Progress(f"refinement {cases[0].refinement}", len(cases) * settings["repeats"], "runs") as progress:
        for _ in range(settings["repeats"]):
            for case in cases:
                if sum(case.forward) + sum(case.backward) <= settings["seconds"]:
                    case.measure()
                progress.advance()
            yardstick.append(measure_yardstick())


def measure_yardstick() -> float:
    """Seconds of a product and a Cholesky factor of 480 x 480 matrices in NumPy on one thread, the median of five."""
    n = _YARDSTICK_SIZE
    random = np.random.default_rng(0).standard_normal((n, n))
    with threadpool_limits(1):
        return _median_seconds(lambda: np.linalg.cholesky(random @ random.T + n * np.eye(n)), 5, torch.device("cpu"))


def _time_parts(case: Case, repeats: int) -> dict[str, Any]:
    """Milliseconds of each part of an iteration, for the whole batch, at the end of the case's last roll-out."""
    sim = case.simulator
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
        times = {f"{name}_ms": 1e3 * _median_seconds(tasks[name], repeats, device) for name in PARTS}
    return {"refinement": case.refinement, "batch": case.batch, "linear_solver": type(linear).__name__, **times}


def _median_seconds(task: Callable[[], object], repeats: int, device: torch.device) -> float:
    seconds = []
    for _ in range(repeats):
        began = now(device)
        task()
        seconds.append(now(device) - began)
    return median(seconds)


def now(device: torch.device) -> float:
    """Seconds, once the device has finished what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


_COLD_START: Final = """
import sys, time
began = time.perf_counter()
from warp_resphys.studies.benchmark import first_step
first_step(began, sys.stdin.read())
"""


def cold_start(config: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Seconds that a new process takes to import, to get its kernels and to step, without a kernel cache and with it.

    Raises:
        RuntimeError: the process failed.
    """
    result = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            run = subprocess.run(
                [sys.executable, "-c", _COLD_START],
                input=json.dumps(config),
                env={**os.environ, "WARP_CACHE_PATH": cache},
                capture_output=True,
                text=True,
                check=False,
            )
            if run.returncode != 0:
                raise RuntimeError(f"the process that measures the cold start failed:\n{run.stderr}")
            result[name] = json.loads(run.stdout.splitlines()[-1])
    return result


def first_step(began: float, config: str) -> None:
    """Prints as JSON what this new process took for its first step of a configuration [s], from before its imports."""
    imported = time.perf_counter()
    simulator = build_simulator(json.loads(config))
    state = simulator.rest_state()
    built = time.perf_counter()
    potential = simulator.workspace(1).potential
    potential.update_tangent()
    kernels = now(potential.device)
    simulator.step(state)
    stepped = now(potential.device)
    names = ("import_s", "build_s", "kernels_s", "first_step_s")
    moments = (began, imported, built, kernels, stepped)
    print(json.dumps(dict(zip(names, np.diff(moments).tolist(), strict=True))))
