"""A rival of laws: a learned field of accelerations, from local features, put on other bodies.

    warp-resphys experiment=law_twist shapes=bodies
    python scripts/local_field.py runs/law_twist/default

The field is of the kind of RAFL (Cho and Chen 2026, arXiv:2603.22039), not its published code: a network maps local
features at integration points to an acceleration there, which the mass of the point turns into nodal forces. It
corrects the simulator that SysID identified. It sees the training trials of the run for as long as the law's
identification took: half of it fits the forces that bring the simulator to the recorded states, half of it trains
through the simulator, on windows of ten steps. Weights are those with the smallest error on the validation trials.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn

import warp_resphys as wr
from warp_resphys.experiment.experiment import LAW, Experiment
from warp_resphys.experiment.shapes import ShapeTrial
from warp_resphys.experiment.trials import split_of
from warp_resphys.fem.elements import physical_gradients
from warp_resphys.io.files import read_json, write_json
from warp_resphys.io.settings import parse
from warp_resphys.pipeline import learning_stages
from warp_resphys.settings.run import RunSettings

WINDOW = 10  # steps through the simulator
BATCH = 32
CHECKS = 20  # on the validation trials, over the whole training
WIDTH = 64
CELL = 0.01  # m: size of a cell, which scales slopes of the strain
SIZES = (1.0, 0.1, 10.0)  # of velocity gradients [1/s], velocities [m/s] and accelerations [m/s^2], in features
SEED = 0


class LocalField(nn.Module):
    """A network from 27 local features to an acceleration in the frame of the material."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(SEED)
        last = nn.Linear(WIDTH, 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        hidden = (nn.Linear(27, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU())
        self.network = nn.Sequential(*hidden, last).double()

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Maps features (..., 27) to accelerations (..., 3) [m/s^2]."""
        return SIZES[2] * self.network(features)


class FieldOn:
    """The forces of a field on a body.

    Args:
        field: from features to accelerations.
        mesh: of the body.
        density: of its material [kg/m^3].
    """

    def __init__(self, field: LocalField, mesh: wr.Mesh, density: float) -> None:
        element = mesh.element
        points, weights = element.rule
        values, reference = element.shape(points)
        gradients, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
        places = np.einsum("qk,cki->cqi", values, mesh.vertices[mesh.cells])
        slopes = np.linalg.pinv(places - places.mean(axis=1, keepdims=True))  # (C, 3, Q) of a linear fit in a cell
        self._field, self._count = field, len(mesh.vertices)
        self._cells = torch.as_tensor(mesh.cells)
        self._values, self._gradients = torch.as_tensor(values), torch.as_tensor(gradients)
        self._slopes = torch.as_tensor(slopes)
        self._masses = torch.as_tensor(density * determinants * weights)  # (C, Q) [kg]

    def __call__(self, state: wr.State) -> torch.Tensor:
        """Returns nodal forces (B, N, 3) [N] in a state."""
        return self.forces(*self.features(state))

    def features(self, state: wr.State) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the features (B, C, Q, 27) of the points and the rotations (B, C, Q, 3, 3) of their material."""
        q, v = (x[:, self._cells] for x in (state.q, state.v))
        deformation = torch.einsum("bcki,cqkj->bcqij", q, self._gradients)
        change = torch.einsum("bcki,cqkj->bcqij", v, self._gradients)
        velocity = torch.einsum("bcki,qk->bcqi", v, self._values)
        rotation = nearest_rotation(deformation.detach())
        back = rotation.mT
        strain = back @ deformation - torch.eye(3, dtype=q.dtype)
        slopes = torch.einsum("bcqij,ckq->bcijk", strain, self._slopes)  # of the strain in the cell [1/m]
        uneven = torch.cat([slopes.diagonal(dim1=-2, dim2=-1).sum(-1), torch.einsum("bcjji->bci", slopes)], -1)
        upper = torch.triu_indices(3, 3)
        features = [
            10.0 * strain[..., upper[0], upper[1]],
            (back @ change).flatten(-2) / SIZES[0],
            (back @ velocity[..., None])[..., 0] / SIZES[1],
            -back[..., 2],  # gravity's direction
            10.0 * CELL * uneven[:, :, None].expand(*strain.shape[:3], 6),
        ]
        return torch.cat(features, -1), rotation

    def forces(self, features: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Returns nodal forces (B, N, 3) [N] from `features`."""
        local = self._field(features)
        force = self._masses[..., None] * (rotation @ local[..., None])[..., 0]
        nodal = torch.einsum("bcqi,qk->bcki", force, self._values).flatten(1, 2)
        return nodal.new_zeros(len(nodal), self._count, 3).index_add(1, self._cells.flatten(), nodal)


def nearest_rotation(matrix: torch.Tensor) -> torch.Tensor:
    """Returns the rotations (..., 3, 3) of the polar decomposition, by Newton's iteration (Higham 1986)."""
    for _ in range(6):
        rows = matrix.unbind(-2)
        crossed = torch.stack([torch.linalg.cross(rows[i - 2], rows[i - 1]) for i in range(3)], -2)
        volume = (crossed * matrix).sum((-2, -1))[..., None, None] / 3.0
        matrix = 0.5 * (matrix + crossed / volume)
    return matrix


class Training:
    """The training of a field on the recorded states of a run, through the simulator that SysID identified.

    Args:
        experiment: of the run.
        model: whose simulator is corrected.
    """

    def __init__(self, experiment: Experiment, model: str) -> None:
        split, self._simulator = experiment.settings.split, experiment.model_simulator(model)
        parameters = experiment.parameters(model)
        self._constants = self._simulator.prepare(parameters)
        self.field = LocalField()
        self._on = FieldOn(self.field, experiment.body.mesh, float(self._simulator.constants["density"]))
        self._motions, self._held = (
            self._motion(experiment, model, names) for names in (split.train, split.validation)
        )
        numbers = {name: float(value) for name, value in parameters.items()}
        self._samples = wr.reconstruct(self._simulator, self._motions, parameters=numbers)
        self._mass = self._constants.mass.double()[0, :, None]
        parts = [
            self._on.features(wr.State(*own))
            for own in zip(self._samples.q.split(100), self._samples.v.split(100), strict=True)
        ]
        self._features, self._rotations = (torch.cat(own) for own in zip(*parts, strict=True))

    def _motion(self, experiment: Experiment, model: str, names: Sequence[str]) -> wr.ObservedMotion:
        ((replay, start),) = experiment.replays(self._simulator, names, model)
        return wr.ObservedMotion(replay.trials.observed.transpose(0, 1), start=start.state)

    def run(self, seconds: float) -> None:
        """Trains the field, and keeps the weights with the smallest error on the validation trials."""
        draw, began, steps = np.random.default_rng(SEED), time.monotonic(), 0
        best, kept = self._validation(), self._weights()
        print(f"   0 s: validation {best:.4g} mm", flush=True)
        for loss_of, rate, until in ((self._by_force, 2e-3, 0.5), (self._by_motion, 2e-4, 1.0)):
            self.field.load_state_dict(kept)
            optimiser = torch.optim.Adam(self.field.parameters(), rate)
            checked, over = time.monotonic(), False
            while not over:
                loss = loss_of(draw)
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.field.parameters(), 1.0)
                optimiser.step()
                steps, now = steps + 1, time.monotonic()
                over = now - began >= until * seconds
                if over or now - checked > seconds / CHECKS:
                    error = self._validation()
                    spent = f"{now - began:4.0f} s, step {steps}"
                    print(f"{spent}: loss {loss.item():.3g}, validation {error:.4g} mm", flush=True)
                    if error < best:
                        best, kept = error, self._weights()
                    checked = time.monotonic()
        self.field.load_state_dict(kept)

    def _weights(self) -> dict[str, torch.Tensor]:
        return {name: value.clone() for name, value in self.field.state_dict().items()}

    def _step(self, state: wr.State) -> wr.State:
        return self._simulator.step(state, wr.Inputs(external_force=self._on(state)), self._constants)[0]

    def _by_force(self, draw: np.random.Generator) -> torch.Tensor:
        """Mean square difference from reconstructed accelerations, by mass."""
        rows = torch.as_tensor(draw.choice(len(self._samples.q), BATCH))
        force = self._on.forces(self._features[rows], self._rotations[rows])
        return ((force - self._samples.outputs[0][rows]).square() / (self._mass * self._mass.mean())).mean()

    def _by_motion(self, draw: np.random.Generator) -> torch.Tensor:
        """Mean square distance from the recorded states in a window [mm^2]."""
        observed, lengths = self._motions.observed, self._samples.lengths
        trials = draw.choice(len(lengths), 8)
        first = draw.integers(0, lengths[0] - WINDOW, 8)
        rows = torch.as_tensor(trials * lengths[0] + first)
        state, loss = wr.State(self._samples.q[rows], self._samples.v[rows]), torch.zeros(())
        for step in range(1, WINDOW + 1):
            state = self._step(state)
            loss = loss + (1e3 * (state.q - observed[first + step, trials])).square().mean()
        return loss

    @torch.no_grad()
    def _validation(self) -> float:
        """Mean distance from the validation trials [mm]; infinite if it diverges."""
        assert self._held.start is not None
        state, errors = self._held.start, []
        for now in self._held.observed[1:]:
            state = self._step(state)
            errors.append(1e3 * float((state.q - now).norm(dim=-1).mean()))
        return float(np.nan_to_num(np.mean(errors), nan=np.inf))


def seconds_of(run: Path, *stages: str) -> float:
    """Returns how long stages of a run took [s]."""
    return sum(float(read_json(run / "stages" / f"{stage}.json")["seconds"]) for stage in stages)


def main(run: Path) -> None:
    """Trains a field with the trials and the time of a run's law, and writes its errors on the run's shapes."""
    settings = settings_of(run)
    stages = {stage.name: stage for stage in learning_stages(settings, split_of(settings), ".", "")}
    law, shapes = Experiment(stages["identify_law"].settings, run, "count"), stages["shapes"].settings
    model = "sysid" if settings.identify is not None else "simulation"
    training = Training(law, model)
    training.run(seconds := seconds_of(run, "identify_law"))
    known, rows = Experiment(shapes, run, "count"), {}
    print(f"{'':20} {'moved':>8} {'uncorr.':>8} {'before':>8} {'field':>8} {'law':>8}   mm")
    for name, shape in shapes.shapes.items():
        trial = ShapeTrial(known, shapes, shape)
        density = float(trial.simulator(model)[0].constants["density"])
        on = FieldOn(training.field, trial.body.mesh, density)
        errors = [trial.error("simulation"), trial.error(model), trial.error(model, on), trial.error(LAW)]
        rows[name] = dict(zip(("uncorrected", "before", "field", LAW), errors, strict=True))
        moved = 1e3 * np.linalg.norm(trial.observed - trial.body.mesh.vertices, axis=-1).max()
        print(f"{name:20} {moved:8.2f} " + " ".join("diverged" if e is None else f"{e:8.4f}" for e in errors))
    write_json(run / "local_field.json", {"seconds": seconds, "errors_mm": rows})


def settings_of(run: Path) -> RunSettings:
    """Returns the configuration of a finished run."""
    return parse(RunSettings, read_json(run / "stages" / "report.json")["settings"]["config"])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("name a run with a law and shapes: python scripts/local_field.py runs/law_twist/default")
    main(Path(sys.argv[1]))
