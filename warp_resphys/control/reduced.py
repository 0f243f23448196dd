r"""A robot in a few coordinates: where it rests, the slowest vibrations about there, and its network as it is.

In coordinates z = Psi^T M x of r modes,

    z'' + D(u) z' + A(u) (z - z_0(u)) = G(u) (c - c_0(u)),

with u the inputs and c the outputs of the network of the learned force, which sees no more of the body than z and z'
tell (hyper-reduction: no unknown of the full model is left). z_0(u) is where the robot rests under u and the force of
fixed outputs c_0(u), affine in u, which the network has on average. With Phi(u) the vibrations about there,
K phi = omega^2 M phi, and T = Psi^T M Phi,

    A = T (omega^2 - Phi^T dF/dx Phi) T^-1,   D = T (alpha + beta omega^2) T^-1,   G = T Phi^T dF/dc,

F being the learned force of fixed outputs, which turns with the body, and alpha and beta the Rayleigh damping. What is
observed is y = y_0(u) + C(u) dz + H dz dz with dz = z - z_0(u), C being exact for small dz. z_0 and y_0 are cubic
polynomials of the inputs, A, D, G and C quadratic, fitted to equilibria and the vibrations about them (interpolation of
reduced operators: Amsallem and Farhat, AIAA J. 46 (2008) 1803, in coordinates that are common from the beginning), and
H is constant, fitted to motions. The network acts on the state before a step, as in the robot, so that a step is linear
in z; the integrator is the robot's own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..experiment.models import Learned
from ..io.errors import ConvergenceError, InputError
from .input_response import InputResponse
from .polynomials import Monomials, Polynomial
from .reduced_force import ForceAt, ReducedForce

FloatArray = NDArray[np.float64]

STATIC_ORDER: Final = 3
TANGENT_ORDER: Final = 2
USUAL_ORDER: Final = 1
ORDERS: Final[Mapping[str, int]] = {"static": STATIC_ORDER, "observed": STATIC_ORDER, "places": STATIC_ORDER}
_RESTS: Final = 1e-6  # of the coordinates' size, within which an equilibrium is found; networks are in float32
_ITERATIONS: Final = 50
_HALVINGS: Final = 8


@dataclass(frozen=True)
class ReducedState:
    """Where a reduced model is.

    Attributes:
        z: (r,) coordinates.
        v: (r,) their rates [1/s].
        means: (f, n) of the inputs that the learned force is told of.
        commands: (L + 1, n) the last commands, and what the input has risen to, see `InputResponse`.
        previous: (2, r) coordinates and rates a step ago, where the integrator looks back.
    """

    z: FloatArray
    v: FloatArray
    means: FloatArray
    commands: FloatArray
    previous: FloatArray | None = None


@dataclass(frozen=True)
class Response:
    """What a reduced model does over T steps.

    Attributes:
        y: (T, 3 M) observed points after each step [m].
        slopes: (T, 3 M, P) their derivatives by P parameters of the inputs; None if not asked for.
        states: T states.
    """

    y: FloatArray
    slopes: FloatArray | None
    states: list[ReducedState]


class _Steps(NamedTuple):
    """T steps that were made: what their derivatives need."""

    u: Monomials  # of (T, n) acting inputs
    length: list[float]  # of the step, as the integrator has it [s]
    backs: list[bool]  # whether it looked back
    inverse: FloatArray  # (T, r, r)
    states: list[ReducedState]
    force: ForceAt | None


@dataclass(frozen=True)
class ReducedModel:
    """See the module; inputs are in units of `scale`.

    Attributes:
        time_step: h [s].
        integrator: ``implicit_euler`` or ``bdf2``.
        labels: of the M points that are observed.
        name: of the input.
        scale: (n,) of the inputs.
        response: how they follow their commands.
        filters: f time constants of the means [s].
        static: z_0, (r,).
        observed: y_0, (3 M,) [m].
        stiffness: A, (r, r) [1/s^2].
        damping: D, (r, r) [1/s].
        shown: C, (3 M, r) [m].
        curved: H, (r, r, 3 M), symmetric [m].
        force: the learned one; None for a simulator alone.
        told: what was found when it was made: errors and counts.
    """

    time_step: float
    integrator: str
    labels: tuple[str, ...]
    name: str
    scale: FloatArray
    response: InputResponse
    filters: tuple[float, ...]
    static: Polynomial
    observed: Polynomial
    stiffness: Polynomial
    damping: Polynomial
    shown: Polynomial
    curved: FloatArray
    force: ReducedForce | None = None
    told: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuses an integrator that it cannot follow.

        Raises:
            InputError: another one.
        """
        if self.integrator not in ("implicit_euler", "bdf2"):
            raise InputError(
                f"a robot that is stepped by {self.integrator} cannot be reduced: set identify.integrator to "
                "implicit_euler or bdf2."
            )

    @property
    def modes(self) -> int:
        """The number r of coordinates."""
        return len(self.curved)

    @property
    def parts(self) -> int:
        """The number n of inputs."""
        return len(self.scale)

    def rest(self, inputs: FloatArray | None = None) -> ReducedState:
        """In equilibrium with inputs (n,); with none, if left out.

        Raises:
            ConvergenceError: the learned force lets it come to rest nowhere.
        """
        u = np.zeros((1, self.parts)) if inputs is None else (inputs / self.scale)[None]
        z = self.static(u)[0]
        means = np.repeat(u, len(self.filters), axis=0)
        if self.force is not None:
            z = self._balanced(z, u, means)
        return ReducedState(z, np.zeros_like(z), means, self.response.still(u[0]))

    def _balanced(self, z: FloatArray, u: FloatArray, means: FloatArray) -> FloatArray:
        """(r,) where A (z - z_0) is the learned force, by Newton's method with halved steps."""
        assert self.force is not None
        a, base, size = self.stiffness(u)[0], self.static(u)[0], np.abs(self.static.coefficients).max()
        force, still = self.force.at(Monomials(u), self.static), np.zeros_like(z)

        def missing(z: FloatArray) -> tuple[FloatArray, float]:
            """By which force it is not at rest, and how far that would move it."""
            found = a @ (z - base) - force(0, z, still, means)
            return found, float(np.abs(np.linalg.solve(a, found)).max())

        found, left = missing(z)
        for _ in range(_ITERATIONS):
            if left < _RESTS * size:
                return z
            step = np.linalg.solve(a - force.last_slope(0), found)
            for share in 0.5 ** np.arange(_HALVINGS):
                tried = z - share * step
                found, now = missing(tried)
                if now < left:
                    break
            z, left = tried, now
        raise ConvergenceError("the reduced model comes to rest nowhere: its learned force is too large.", z, None)

    def rest_observed(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3 M,) what is observed in equilibrium with inputs (n,) [m], and (3 M, n) its derivatives by them.

        Raises:
            ConvergenceError: see `rest`.
        """
        state, u = self.rest(inputs), Monomials((inputs / self.scale)[None])
        z, a = state.z, self.stiffness(u)[0]
        slope = self.static.slopes(u)[0].T
        by_u = a @ slope - np.einsum("nrs,s->rn", self.stiffness.slopes(u)[0], z - self.static(u)[0])
        if self.force is not None:
            force = self.force.at(u, self.static)
            force(0, z, np.zeros_like(z), state.means)
            by_z, _, more, by_means = (each[0] for each in force.slopes)
            a, by_u = a - by_z, by_u + more + by_means.sum(1)
        seen, direct = (each[0] for each in self._slopes(z[None], u))
        return self._observed(z[None], u)[0], (direct + seen @ np.linalg.solve(a, by_u)) / self.scale

    def observe(self, z: FloatArray, inputs: FloatArray) -> FloatArray:
        """(T, 3 M) what is observed at coordinates (T, r) under inputs (T, n) [m]."""
        return self._observed(z, Monomials(inputs / self.scale))

    def _observed(self, z: FloatArray, u: Monomials) -> FloatArray:
        off = z - self.static(u)
        squares = (off[:, :, None] * off[:, None, :]).reshape(len(z), -1)
        linear = (self.shown(u) @ off[..., None])[..., 0]
        return self.observed(u) + linear + squares @ self.curved.reshape(squares.shape[1], -1)

    def observed_slopes(self, z: FloatArray, inputs: FloatArray) -> FloatArray:
        """(T, 3 M, r) derivatives of `observe` by the coordinates."""
        return self._slopes(z, Monomials(inputs / self.scale))[0]

    def _slopes(self, z: FloatArray, u: Monomials) -> tuple[FloatArray, FloatArray]:
        """(T, 3 M, r) derivatives of `_observed` by z, and (T, 3 M, n) by u."""
        off, r = z - self.static(u), self.modes
        bent = (off @ self.curved.reshape(r, -1)).reshape(len(z), r, -1)
        by_z = self.shown(u) + 2.0 * bent.swapaxes(1, 2)
        turned = (self.shown.slopes(u) @ off[:, None, :, None])[..., 0]  # (T, n, 3 M)
        direct = (self.observed.slopes(u) + turned).swapaxes(1, 2)
        return by_z, direct - by_z @ self.static.slopes(u).swapaxes(1, 2)

    def respond(
        self,
        start: ReducedState,
        inputs: FloatArray,
        basis: FloatArray | None = None,
        bias: FloatArray | None = None,
    ) -> Response:
        """T steps under inputs.

        Args:
            start: the state.
            inputs: (T, n) that are commanded during each step, in their unit.
            basis: (T, n, P) derivatives of the inputs by parameters, by which slopes are wanted.
            bias: (r,) added to where the equilibria are.
        """
        steps = self._march(start, inputs, bias)
        series = np.array([each.z for each in steps.states])
        y = self._observed(series, steps.u)
        if basis is None:
            return Response(y, None, steps.states)
        still = self.response.still(np.zeros(basis.shape[1:]))
        by_parameters = self.response(still, basis / self.scale[:, None])[0]
        by_z, direct = self._slopes(series, steps.u)
        return Response(
            y, by_z @ self._sensitivities(steps, by_parameters, bias) + direct @ by_parameters, steps.states
        )

    def transition(
        self, start: ReducedState, inputs: FloatArray, bias: FloatArray
    ) -> tuple[ReducedState, FloatArray, FloatArray, FloatArray]:
        """The state after a step under inputs (n,), and (2 r, r) its derivatives by z, by v and by the bias."""
        steps = self._march(start, inputs[None], bias)
        by_z, by_v = self._by_state(steps)
        return (
            steps.states[0],
            by_z[0],
            by_v[0],
            self._with_rate(steps, 0, steps.inverse[0] @ self.stiffness(steps.u)[0]),
        )

    def _march(self, start: ReducedState, inputs: FloatArray, bias: FloatArray | None) -> _Steps:
        acting, remembered = self.response(start.commands, inputs / self.scale)
        u = Monomials(acting)
        a, d, rest = self.stiffness(u), self.damping(u), self.static(u) + (0.0 if bias is None else bias)
        force = None if self.force is None else self.force.at(u, self.static)
        h, identity = self.time_step, np.eye(self.modes)
        keep = np.exp(-h / np.asarray(self.filters))[:, None] if self.filters else np.zeros((0, 1))
        z, v, means, before = start.z, start.v, start.means, start.previous
        looks_back = self.integrator == "bdf2"
        backs = [looks_back and (before is not None or k > 0) for k in range(len(acting))]
        length = [2.0 / 3.0 * h if back else h for back in backs]
        short = np.array(length)[:, None, None]
        inverses = np.linalg.inv(identity / short**2 + d / short + a)
        pull = (a @ rest[..., None])[..., 0]
        steps = _Steps(u, length, backs, inverses, [], force)
        for k, now in enumerate(acting):
            step = length[k]
            at, rate = (4.0 * np.stack([z, v]) - before) / 3.0 if backs[k] and before is not None else (z, v)
            means = now + keep * (means - now)
            right = (at + step * rate) / step**2 + d[k] @ at / step + pull[k]
            if force is not None:
                right = right + force(k, z, v, means)
            before = np.stack([z, v]) if looks_back else None
            z = inverses[k] @ right
            v = (z - at) / step
            steps.states.append(ReducedState(z, v, means, remembered[k], before))
        return steps

    def _by_state(self, steps: _Steps) -> tuple[FloatArray, FloatArray]:
        """(T, 2 r, r) derivatives of the state after each step by z and by v before it."""
        identity, step = np.eye(self.modes), np.array(steps.length)[:, None, None]
        gain = np.where(np.array(steps.backs)[:, None, None], 4.0 / 3.0, 1.0)
        by_z, by_v = gain * (identity / step**2 + self.damping(steps.u) / step), gain / step * identity
        if steps.force is not None:
            by_z, by_v = by_z + steps.force.slopes[0], by_v + steps.force.slopes[1]
        by_z, by_v = (steps.inverse @ each for each in (by_z, by_v))
        return (
            np.concatenate([by_z, by_z / step - gain / step * identity], axis=1),
            np.concatenate([by_v, by_v / step], axis=1),
        )

    @staticmethod
    def _with_rate(steps: _Steps, k: int, by: FloatArray) -> FloatArray:
        """Derivatives (2 r, P) of z and of z' after step k, of (r, P) those of z where the state before stays."""
        return np.concatenate([by, by / steps.length[k]])

    def _sensitivities(self, steps: _Steps, by_parameters: FloatArray, bias: FloatArray | None) -> FloatArray:
        """(T, r, P) derivatives of z after each step by the parameters, of those of the inputs (T, n, P)."""
        u, r, h = steps.u, self.modes, self.time_step
        z, v = (np.array([getattr(each, name) for each in steps.states]) for name in ("z", "v"))
        rest = self.static(u) + (0.0 if bias is None else bias)
        by_u = self.stiffness(u) @ self.static.slopes(u).swapaxes(1, 2)
        by_u = by_u - np.einsum("tnrs,ts->trn", self.stiffness.slopes(u), z - rest)
        by_u = by_u - np.einsum("tnrs,ts->trn", self.damping.slopes(u), v)
        keep = np.exp(-h / np.asarray(self.filters)) if self.filters else np.zeros(0)
        by_means = None
        if steps.force is not None:
            more, by_means = steps.force.slopes[2:]
            by_u = by_u + more
        by_z, by_v, damping = *self._by_state(steps), self.damping(u)
        pushed = by_u @ by_parameters  # (T, r, P)
        if by_means is not None and len(keep):
            means = np.zeros((len(keep), *by_parameters.shape[1:]))
            for k, du in enumerate(by_parameters):
                means = du + keep[:, None, None] * (means - du)
                pushed[k] += np.einsum("rfn,fnp->rp", by_means[k], means)
        now, past, found = np.zeros((2 * r, by_parameters.shape[2])), None, []
        own = np.concatenate([by_z, by_v], axis=2)
        for k, (step, back, inverse) in enumerate(zip(steps.length, steps.backs, steps.inverse, strict=True)):
            direct = pushed[k]
            if back and past is not None:
                at, rate = -past[:r] / 3.0, -past[r:] / 3.0
                direct = direct + (at + step * rate) / step**2 + damping[k] @ at / step
            after = own[k] @ now + self._with_rate(steps, k, inverse @ direct)
            if back and past is not None:
                after[r:] += past[:r] / 3.0 / step
            past, now = now, after
            found.append(now[:r])
        return np.array(found)

    def arrays(self) -> dict[str, FloatArray]:
        """Its arrays, for a file."""
        found = {"scale": self.scale, "curved": self.curved}
        if self.force is not None:
            found |= {"told": self.force.told, "told_by": self.force.told_by}
        return found | {name: each.coefficients for name, each in self._polynomials().items()}

    def _polynomials(self) -> dict[str, Polynomial]:
        names = ("static", "observed", "stiffness", "damping", "shown")
        own: dict[str, Polynomial] = {name: getattr(self, name) for name in names}
        return own if self.force is None else {**own, **self.force.polynomials()}

    def plain(self) -> dict[str, Any]:
        """What `restored` needs beside the arrays."""
        keys = ("time_step", "integrator", "labels", "name", "filters", "told")
        orders = {name: each.order for name, each in self._polynomials().items()}
        return {
            **{key: getattr(self, key) for key in keys},
            **{"delay": self.response.delay, "rise": self.response.rise, "orders": orders},
        }

    @classmethod
    def restored(
        cls, arrays: Mapping[str, FloatArray], plain: Mapping[str, Any], learned: Learned | None = None
    ) -> "ReducedModel":
        """From `arrays` and `plain`, and what its robot has learned (`Description.learned`), if it has a force."""
        made = {name: Polynomial(arrays[name], order) for name, order in plain["orders"].items()}
        words: Sequence[str] = plain["labels"]
        force = None
        if "push" in made:
            if learned is None:
                raise InputError("the reduced model has a learned force: give what its robot has learned.")
            force = ReducedForce.restored(learned.network, learned.range_, made, arrays)
        return cls(
            float(plain["time_step"]),
            plain["integrator"],
            tuple(words),
            plain["name"],
            arrays["scale"],
            InputResponse(float(plain["time_step"]), float(plain["delay"]), float(plain["rise"])),
            tuple(plain["filters"]),
            made["static"],
            made["observed"],
            made["stiffness"],
            made["damping"],
            made["shown"],
            arrays["curved"],
            force,
            plain["told"],
        )
