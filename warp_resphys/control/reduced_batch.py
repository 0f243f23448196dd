"""Many reduced models of one kind at once: what `ReducedModel.respond` does for one over time, for B in one step."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .polynomials import Monomials
from .reduced import ReducedModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ReducedBatch:
    """Where B reduced models are.

    Attributes:
        z: (B, r) coordinates.
        v: (B, r) their rates [1/s].
        means: f of (B, n), of the inputs.
        commands: (L + 1, B, n), see `InputResponse`.
        previous: (2, B, r) coordinates and rates a step ago, where the integrator looks back.
        acting: (B, n) inputs of the last step, as shares.
        first: (B,) whether a model has made no step yet, so that its integrator cannot look back.
    """

    z: FloatArray
    v: FloatArray
    means: tuple[FloatArray, ...]
    commands: FloatArray
    previous: FloatArray
    acting: FloatArray
    first: NDArray[np.bool_]

    def where(self, chosen: NDArray[np.bool_], other: "ReducedBatch") -> "ReducedBatch":
        """These models where chosen (B,), those of another batch elsewhere."""
        rows = chosen[:, None]

        def pick(mine: FloatArray, theirs: FloatArray) -> FloatArray:
            return np.where(rows, mine, theirs)

        return ReducedBatch(
            pick(self.z, other.z),
            pick(self.v, other.v),
            tuple(pick(mine, theirs) for mine, theirs in zip(self.means, other.means, strict=True)),
            pick(self.commands, other.commands),
            pick(self.previous, other.previous),
            pick(self.acting, other.acting),
            np.where(chosen, self.first, other.first),
        )


def begin(model: ReducedModel, count: int, inputs: FloatArray) -> ReducedBatch:
    """B models in equilibrium with inputs (n,)."""
    state = model.rest(inputs)
    z, v, commands = (np.repeat(each[..., None, :], count, axis=-2) for each in (state.z, state.v, state.commands))
    means = tuple(np.tile(each, (count, 1)) for each in state.means)
    acting = np.tile(inputs / model.scale, (count, 1))
    return ReducedBatch(z, v, means, commands, np.stack([z, v]), acting, np.ones(count, dtype=np.bool_))


def advance(model: ReducedModel, batch: ReducedBatch, inputs: FloatArray) -> ReducedBatch:
    """One step of B models under commanded inputs (B, n)."""
    acting, kept = model.response(batch.commands, (inputs / model.scale)[None])
    u, h, z, v = Monomials(acting[0]), model.time_step, batch.z, batch.v
    back = ~batch.first if model.integrator == "bdf2" else np.zeros_like(batch.first)
    looks, step = back[:, None], np.where(back, 2.0 / 3.0 * h, h)[:, None]
    at = np.where(looks, (4.0 * z - batch.previous[0]) / 3.0, z)
    rate = np.where(looks, (4.0 * v - batch.previous[1]) / 3.0, v)
    means = tuple(
        acting[0] + np.exp(-h / time) * (mean - acting[0])
        for mean, time in zip(batch.means, model.filters, strict=True)
    )
    a, d = model.stiffness(u), model.damping(u)
    right = (at + step * rate) / step**2 + (d @ at[..., None])[..., 0] / step
    right = right + (a @ model.static(u)[..., None])[..., 0]
    if model.force is not None:
        right = right + model.force.pull(u, model.static, z, v, means)
    left = np.eye(model.modes) / step[..., None] ** 2 + d / step[..., None] + a
    new = np.linalg.solve(left, right[..., None])[..., 0]
    now = np.zeros_like(batch.first)
    return ReducedBatch(new, (new - at) / step, means, kept[0], np.stack([z, v]), acting[0], now)


def observed(model: ReducedModel, batch: ReducedBatch) -> FloatArray:
    """(B, M, 3) what is observed [m]."""
    return model.observe(batch.z, batch.acting * model.scale).reshape(len(batch.z), -1, 3)
