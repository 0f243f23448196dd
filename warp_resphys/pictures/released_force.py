r"""A body that a force holds at rest and that is released,
before a camera that exposes its rows one after another.

Until its release the body rests under its weight and the force, and then moves without it
(`learning.replay`). A picture whose row 0 is exposed at the time t shows at row y the body of the
time t + y r, r being the time between two rows. A vertex on the path x(t) is seen at the pixel p
with

    p = pi(x(t + r p_2)),

where pi is the camera. Vertices have the positions of their own times, and points between them are
interpolated, as times are linear in the picture. By implicit differentiation, a derivative d of
pi(x) at a constant time becomes

    d + r v d_2 / (1 - r v_2), with the velocity v = (d pi / dx) dx/dt in the picture.

`tests/pictures/test_released_motion.py` compares rows with closed forms, and derivatives with
differences.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import sample
from ..data.camera import jacobians
from ..data.markers import WHOLE_STATE
from ..io.arrays import IntArray
from ..io.errors import InputError
from ..learning.parameters import MASS_FACTOR, identifiable_parameters
from ..learning.replay import Replay
from ..learning.start import Start
from ..learning.trial_batch import TrialBatch

RELEASE_DELAY: Final = "release_delay"  # s
RELEASE_FORCES: Final = ("release_force_1", "release_force_2", "release_force_3")  # N
OF_RELEASE: Final = (RELEASE_DELAY, *RELEASE_FORCES)

_MARGIN: Final = 4  # steps before and after those that a picture shows
_LEAST: Final = 3  # steps
_MOST_ROUNDS: Final = (
    30  # fixed-point iterations for a row, with an error that shrinks by r v_2 in each
)
_ON_TIME: Final = 1e-9  # s, of their change


@dataclass(frozen=True)
class ReleasedForce:
    """A force that holds a body at rest until it is released.

    Attributes:
        vertices: (V,) that carry it, in equal shares.
        force: (3,) in the axes of the scene, to which the parameters `RELEASE_FORCES` are added
            [N].
        time: of the release on the clock of the pictures, to which the parameter `RELEASE_DELAY` is
            added [s].

    Raises:
        InputError: no vertex carries it, or a force or time that is not finite.
    """

    vertices: IntArray
    force: tuple[float, float, float]
    time: float = 0.0

    def __post_init__(self) -> None:
        """Checks the values."""
        if not len(self.vertices):
            raise InputError("no vertex carries the force that is released: name some.")
        if np.shape(self.force) != (3,) or not np.isfinite([*self.force, self.time]).all():
            raise InputError(
                f"a released force is {self.force} N at {self.time} s: "
                "give three numbers and a time."
            )

    def at(self, values: Mapping[str, float]) -> float:
        """Returns the time of the release with values of parameters [s]."""
        return self.time + values.get(RELEASE_DELAY, 0.0)

    @torch.no_grad()
    def motions(
        self,
        simulator: Simulator,
        values: Sequence[Mapping[str, float]],
        last: float,
        near: torch.Tensor,
    ) -> torch.Tensor:
        """Returns the vertices (E, K + 1, N, 3) at the steps after the release [m],
        for E sets of parameters.

        The first set is simulated. The others should hardly differ from it
        (`learning.replay.Replay.varied_series`).

        Args:
            simulator: of the body.
            values: of parameters by name; those of the camera are ignored.
            last: time that is shown last, on the clock of the pictures [s].
            near: (N, 3) first guess of the body at rest [m].

        Raises:
            ConvergenceError: there is no equilibrium, or a step fails.
            InputError: the material remembers its motion.
        """
        names = identifiable_parameters(simulator)
        # A factor without effect, so that there are as many sets where only the force differs.
        parameters = {MASS_FACTOR: simulator.tensor([1.0] * len(values))}
        for name in values[0]:
            if name in names:
                parameters[name] = simulator.tensor([row[name] for row in values])
        added = [[row.get(name, 0.0) for name in RELEASE_FORCES] for row in values]
        pull = simulator.tensor(np.zeros((len(values), len(near), 3)))
        force = simulator.tensor(self.force) + simulator.tensor(added)
        pull[:, self.vertices] = force[:, None] / len(self.vertices)
        seconds = simulator.tensor([[max(last - self.at(values[0]), 0.0)]])
        trials = TrialBatch(("",), seconds, pull.new_zeros(1, 1, 1, 1), pull.new_zeros(1, 1, 1))
        replay = Replay(simulator, WHOLE_STATE, trials)
        constants = replay.prepare(parameters)[0]
        state = simulator.static_equilibrium(
            Inputs(pull), constants, start=near.to(pull).expand_as(pull)
        )
        if state.memory:
            raise InputError(
                "a material with friction remembers its motion: pictures identify none that moves."
            )
        start = Start(state, pull.new_zeros(1))
        series = (
            replay.varied_series(start, parameters)
            if len(values) > 1
            else replay.series(start, parameters)
        )
        return series.double().cpu()


def at_row_times(
    series: torch.Tensor,
    begin: float,
    row_time: float,
    step: float,
    pixels: Callable[[torch.Tensor], torch.Tensor],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the vertices of motions where a picture shows those of the first,
    and their velocities in that.

    Args:
        series: (S, K + 1, N, 3) vertices at the steps, the first of a motion, others perhaps its
            derivatives.
        begin: time at which row 0 is exposed, after the release [s].
        row_time: r, between two rows [s].
        step: time step [s].
        pixels: maps points (..., 3) to pixels (..., 2).

    Returns:
        (S, N, 3), and velocities (N, 3) [m/s].
    """
    shown = begin + row_time * pixels(series[0])[..., 1].nan_to_num()
    low, high = (
        float(end / step) for end in torch.aminmax(shown.clamp(0.0, step * series.shape[1]))
    )
    first = min(max(math.floor(low) - _MARGIN, 0), series.shape[1] - _LEAST)
    series = series[:, first : max(math.ceil(high) + _MARGIN, first + _LEAST)]
    begin -= first * step
    paths = series[0].transpose(0, 1)
    times = torch.full_like(paths[:, :1, 0], begin)

    def places(times: torch.Tensor) -> torch.Tensor:
        return sample(paths, times.clamp_min(0.0), step)[:, 0]

    for _ in range(_MOST_ROUNDS if row_time else 0):
        before, times = times, begin + row_time * pixels(places(times))[:, 1:].nan_to_num()
        if float((times - before).abs().max()) < _ON_TIME:
            break
    velocities = jacobians(places, times)[0][..., 0]
    others = sample(series.permute(2, 1, 0, 3), times.clamp_min(0.0), step)[:, 0]
    return others.transpose(0, 1), velocities
