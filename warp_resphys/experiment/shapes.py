"""Stage: puts the identified material on other bodies,
and compares them with targets of the same shapes.

The target of a shape has the material of the run's target, its passive muscles (fibres in the
material), its time step and its integrator. It is held or inflated, released, and its state at the
release is that of the models, as in the simulated trials of a run (`experiment.simulate`).
"""

from dataclasses import replace
from functools import partial

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.energies.catalogue import modes_of
from ..core.fem.integration_points import principal_stretches, share_outside
from ..core.mesh.place import Place
from ..core.mesh.selection import vertices_at
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..io.errors import ConvergenceError, InputError
from ..io.parts import Checkpoint
from ..io.progress import Progress
from ..io.resuming import StageContext
from ..io.safe_files import read_json, write_json
from ..learning.metrics import marker_errors, summarise
from ..report.data import ShapeErrors
from ..settings.body import BodySettings, SimulatorSettings
from ..settings.played import ShapeSettings
from ..settings.stage_keys import StageSettings
from .actuators import driven_parts, driving_quantity
from .build import build_body, build_simulator
from .experiment import LAW, Experiment
from .files import LAW_FILE, SHAPES
from .simulate import loads, substeps_of, target_settings, twist, vertices_in


def try_shapes(context: StageContext) -> None:
    """Writes shapes.json: for every shape the errors of the models [mm], and how far it moves.

    An interrupted run keeps the finished shapes.

    Raises:
        ConvergenceError: the target of a shape fails.
        InputError: inputs do not fit a shape.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    path, results = context.run_dir / f"{context.name}_parts.safetensors", {}
    kept = Checkpoint(path, context.fingerprint)
    with Progress(context.name, len(settings.shapes), "bodies") as progress:
        for name, shape in settings.shapes.items():
            try:
                results[name] = kept.once(name, partial(_compared, experiment, settings, shape))
            except InputError as error:
                raise InputError(f"shapes.{name}: {error}") from error
            except ConvergenceError as error:
                raise ConvergenceError(
                    f"shapes.{name}, its target: {error}", error.positions, error.report
                ) from error
            progress.advance(1, body=name)
    write_json(context.run_dir / SHAPES, results)
    path.unlink(missing_ok=True)


def check_shape(shape: ShapeSettings) -> None:
    """Checks that a shape can be built, held and observed.

    Raises:
        InputError: inputs do not fit, or a held place that is fixed.
        MeshError: a mesh that cannot be simulated, has no vertex at a place, or is another body
            than the target.
    """
    body, target = build_body(BodySettings.of(shape)), build_body(shape.target_body)
    vertices_in(target.mesh, body.mesh)
    if shape.held is None:
        quantity, count = driving_quantity(shape), len(shape.inputs or ())
        if quantity is None:
            raise InputError(
                "inputs are given, but it has neither chambers nor tendons nor commanded "
                "muscles: leave them out."
            )
        if count != driven_parts(shape):
            raise InputError(
                f"inputs has {count} values for {driven_parts(shape)} parts: give one for each."
            )
    elif shape.held.at is not None:
        face = vertices_at(target.mesh, shape.held.at)
        if np.isin(face, target.fixed_vertices).all():
            raise InputError(
                "held.at selects fixed vertices only: hang the weight on vertices that can move."
            )


def _compared(experiment: Experiment, settings: StageSettings, shape: ShapeSettings) -> ShapeErrors:
    """Result of a shape, which its target holds or inflates, and releases."""
    target, mesh = _target(settings, shape), build_body(BodySettings.of(shape)).mesh
    seen = vertices_in(target.body.mesh, mesh).to(target.rest_positions)
    models = (
        "simulation",
        *(("sysid",) if settings.identify else ()),
        *((LAW,) if experiment.has_law else ()),
    )
    with torch.no_grad():
        held = _held(target, shape)
        substeps = substeps_of(settings.time_step, settings.target, "target")
        observed = (
            seen(target.rollout(held, settings.data.steps * substeps).q[::substeps, 0])
            .cpu()
            .numpy()
        )
        start, errors = State(seen(held.q), seen(held.v)), dict[str, float | None]()
        for model in models:
            kind = experiment.sources(model)[0]
            body = {key: getattr(shape, key) for key in BodySettings.model_fields}
            made_of = experiment.settings_of(kind).model_copy(update=body)
            simulator = build_simulator(made_of, experiment.material_of(kind), on_failure="count")
            known = simulator.materials[""].parameters
            values = {name: x for name, x in experiment.parameters(model).items() if name in known}
            substeps = round(settings.time_step / simulator.time_step)
            q = simulator.rollout(start, settings.data.steps * substeps, None, values).q
            q = q[::substeps, 0]
            errors[model] = summarise([marker_errors(q.cpu().numpy(), observed)])["mean"]
    moved = 1e3 * float(np.linalg.norm(observed - mesh.vertices, axis=-1).max())
    result: ShapeErrors = {"vertices": len(mesh.vertices), "moved_mm": moved, "errors_mm": errors}
    if experiment.has_law and "stretches" in (law := read_json(experiment.folder / LAW_FILE)):
        result["outside"] = share_outside(
            principal_stretches(mesh, observed), law["stretches"], modes_of(law)
        )
    return result


def _target(settings: StageSettings, shape: ShapeSettings) -> Simulator:
    """Returns the simulator of the target of a shape."""
    target, body = settings.target, shape.target_body
    keys = {key: getattr(body, key) for key in BodySettings.model_fields} | {
        "physics": target.physics
    }
    if shape.muscles is None and target.muscles is not None and target.muscles.commanded is None:
        keys["muscles"] = target.muscles
    made_of = target_settings(SimulatorSettings.of(settings), target).model_copy(update=keys)
    return build_simulator(made_of, target.material)


def _held(simulator: Simulator, shape: ShapeSettings) -> State:
    """Returns the state before the release."""
    if shape.held is not None:
        if shape.held.twist_deg:
            return replace(simulator.rest_state(), q=twist(simulator, shape.held))
        return simulator.static_equilibrium(
            Inputs(loads(simulator, [shape.held], Place(), "held.at"))
        )
    quantity = driving_quantity(shape)
    assert quantity is not None
    return simulator.static_equilibrium(
        Inputs(**{quantity.name: simulator.tensor([list(shape.inputs or ())])})
    )
