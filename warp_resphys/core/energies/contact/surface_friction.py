"""Geometry of pairs of a surface that are near, and their friction, on tensors and for kernels."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import warp as wp

from ....kernels.contact import nearest_points
from ....kernels.contact import surface_pairs as kernels
from ..launcher import Launcher, struct_of, warp_view
from .barrier import barrier_pressure, friction_over_slide
from .pairs import PairList

_FEATURES = int(nearest_points.EDGE_FEATURES)


class NearPairs(NamedTuple):
    """Geometry of pairs within reach."""

    environment: torch.Tensor  # (A,)
    nodes: torch.Tensor  # (A, 4)
    weights: torch.Tensor  # (A, 9, 4) of nearest points by feature (`nearest_points.nearest`)
    r: torch.Tensor  # (A, 9, 3) from the nearest point of the second part to that of the first [m]
    d: torch.Tensor  # (A, 9) its length [m]
    part: torch.Tensor  # (A, 9) coefficients of the features
    factor: torch.Tensor  # (A,) area, with the factor for almost parallel edges [m^2]

    @classmethod
    def of(
        cls, launcher: Launcher, pairs: PairList, chosen: torch.Tensor, x: torch.Tensor
    ) -> "NearPairs":
        """Returns the geometry of chosen pairs of a list at positions (B, N, 3), differentiable."""
        indices = chosen.to(torch.int32)
        w, t, s = (x.new_zeros(len(chosen), _FEATURES, 4) for _ in range(3))
        part = x.new_zeros(len(chosen), _FEATURES)
        features = struct_of(nearest_points.Features, coefficient=part, w=w, t=t, s=s)
        inputs = [
            warp_view(indices, wp.int32),
            pairs.pairs,
            wp.float64(pairs.reach),
            warp_view(x, wp.vec3d),
        ]
        launcher.run(nearest_points.pair_features, (len(chosen), _FEATURES), inputs, [features])
        environment, nodes = pairs.environment[chosen], pairs.nodes[chosen]
        ends = x[environment[:, None], nodes]
        # Weights that do not change here, but whose derivatives are those of the nearest points.
        r = w @ ends
        e, f = t @ ends, s @ ends
        ee = (e * e).sum(-1) + (t == 0.0).all(-1).double()
        ff, ef = (f * f).sum(-1) + (s == 0.0).all(-1).double(), (e * f).sum(-1)
        whole = torch.maximum(ee * ff - ef * ef, 1e-12 * ee * ff)
        er, fr = (e * r).sum(-1), (f * r).sum(-1)
        first, second = (fr * ef - er * ff) / whole, (er * ef - fr * ee) / whole
        w = w + first[..., None] * t + second[..., None] * s
        r = w @ ends
        cross = (
            torch.linalg.cross(ends[:, 1] - ends[:, 0], ends[:, 3] - ends[:, 2]).square().sum(-1)
        )
        share = (cross / pairs.parallel[chosen]).clamp_max(1.0)
        factor = (
            torch.where(pairs.kind[chosen] == 0, 1.0, (2.0 - share) * share) * pairs.area[chosen]
        )
        return cls(environment, nodes, w, r, r.norm(dim=-1), part, factor)


class Sliding(NamedTuple):
    """Friction of pairs at the start of a step, differentiable."""

    environment: torch.Tensor  # (G,)
    nodes: torch.Tensor  # (G, 4)
    weights: torch.Tensor  # (G, 4) of the nearest points
    normal: torch.Tensor  # (G, 3)
    load: torch.Tensor  # (G,) normal force [N]
    regions: torch.Tensor  # (G,) number of the coefficient

    @classmethod
    def of(
        cls, near: NearPairs, reach: float, stiffness: torch.Tensor, regions: torch.Tensor
    ) -> "Sliding | None":
        """Returns the friction of pairs with these normal forces, or None without any that press.

        Args:
            near: pairs at the start of the step.
            reach: distance D at which contact begins [m].
            stiffness: (B, 1) kappa [Pa].
            regions: (A,) number of the coefficient of each pair.
        """
        n, pressure = near.r / near.d[..., None], near.part * barrier_pressure(near.d, reach)
        normal = n[:, 0]
        load = (
            near.factor
            * stiffness[near.environment, 0]
            * ((pressure[..., None] * n).sum(1) * normal).sum(-1)
        )
        kept = load > 0.0
        out = (near.environment, near.nodes, near.weights[:, 0], normal, load, regions)
        return cls(*(value[kept] for value in out)) if bool(kept.any()) else None

    def slide(self, x: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """Returns the relative ways (G, 3) of both parts of pairs
        in their tangential planes [m] (see `force`).
        """
        row = self.environment[:, None]
        way = (self.weights[:, :, None] * (x[row, self.nodes] - reference[row, self.nodes])).sum(1)
        return way - (way * self.normal).sum(-1, keepdim=True) * self.normal

    def force(
        self, x: torch.Tensor, reference: torch.Tensor, friction: torch.Tensor, slip: torch.Tensor
    ) -> torch.Tensor:
        """Returns the forces (G, 3) on the first parts of pairs [N].

        Args:
            x: (B, N, 3) positions [m].
            reference: (B, N, 3) positions without slide [m].
            friction: (B, F) coefficients.
            slip: (B, 1) slide at which friction is fully developed [m].
        """
        u = self.slide(x, reference)
        _, factor = friction_over_slide(u, slip[self.environment, 0])
        return -(friction[self.environment, self.regions] * self.load * factor)[:, None] * u


@dataclass(frozen=True)
class Grips:
    """Friction of pairs in a step.

    Attributes:
        environment: (G,) environments.
        nodes: (G, 4) vertices.
        struct: arrays for the kernels.
        outputs: arrays of gradients and energies.
        incidence: for ``kernels.contact.surface_pairs.gather``.
    """

    environment: torch.Tensor
    nodes: torch.Tensor
    struct: Any
    outputs: list[Any]
    incidence: list[Any]

    @property
    def count(self) -> int:
        """Number of pairs G."""
        return len(self.environment)

    @classmethod
    def of(cls, pairs: PairList, sliding: Sliding) -> "Grips":
        """Returns friction of pairs (G, ...) (`kernels.contact.surface_pairs.FrictionPairs`)."""
        environment, nodes = sliding.environment, sliding.nodes
        kept = {
            name: (value if value.is_floating_point() else value.to(torch.int32)).contiguous()
            for name, value in sliding._asdict().items()
        }
        struct = struct_of(kernels.FrictionPairs, **kept)
        sums = sliding.load.new_zeros(len(nodes), 4, 3), torch.zeros_like(sliding.load)
        incidence = pairs.incidence(environment, nodes)
        outputs = [warp_view(sums[0], nearest_points.Corners), warp_view(sums[1], wp.float64)]
        return cls(environment, nodes, struct, outputs, [warp_view(x, wp.int32) for x in incidence])
