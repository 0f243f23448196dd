"""Residual forces against dense NumPy mechanics of the same tiny beam, written from the energies' definitions."""

import numpy as np
import pytest
import scipy.optimize
import torch

from warp_resphys import Body, Corotated, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.learning.reconstruction import make_reconstructor
from warp_resphys.learning.rollout import Rollout, closed_loop
from warp_resphys.stepping.inputs import Inputs

INTEGRATORS = ("implicit_euler", "bdf2", "midpoint")
H = 0.01
GRAVITY = np.array([0.0, 0.0, -9.80709])
MESH = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
FREE = np.setdiff1d(np.arange(12), BODY.fixed_vertices)
TIP = select_vertices(MESH, x=0.06)
MODEL = Corotated(215e3, 0.45)
SETTINGS = {"tolerance": 1e-12, "max_iterations": 50}


class DenseBeam:
    """Forces of the corotated + volume energy on the mesh above: 2x2x2 points for shape, one a cell for volume."""

    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])

    def __init__(self, youngs_modulus, poissons_ratio):
        self.mu = youngs_modulus / (2 * (1 + poissons_ratio))
        self.lame_lambda = 2 * self.mu * poissons_ratio / (1 - 2 * poissons_ratio)
        edges = np.ptp(MESH.vertices[MESH.cells[0]], axis=0)
        self.volume = edges.prod()
        gauss = [0.5 + s / np.sqrt(12) * (2 * self.corners[a] - 1) for a in range(8) for s in (1.0,)]
        self.points = [(self.gradients(x, edges), self.volume / 8) for x in gauss]
        self.centre = self.gradients(np.full(3, 0.5), edges)
        self.mass = 1070.0 * np.bincount(MESH.cells.ravel(), minlength=12) * self.volume / 8
        self.weight = self.mass[:, None] * GRAVITY

    def gradients(self, x, edges):
        factors = np.where(self.corners == 1, x, 1 - x)  # (8, 3)
        signs = 2 * self.corners - 1
        slopes = [np.prod(np.delete(factors, i, axis=1), axis=1) * signs[:, i] for i in range(3)]
        return np.stack(slopes, axis=1) / edges

    def internal_force(self, x):
        """(12, 3) derivative of the energy, with the sign of a force that acts on the vertices."""
        force = np.zeros((12, 3))
        for cell in MESH.cells:
            q = x[cell]
            for gradients, volume in self.points:
                f = q.T @ gradients
                force[cell] -= 2 * self.mu * volume * gradients @ (f - rotation(f)).T
            f = q.T @ self.centre
            force[cell] -= self.lame_lambda * self.volume * self.centre @ (f - unimodular(f)).T
        return force

    def residual(self, x, state):
        """Force that an implicit Euler step to x lacks, zero at the fixed vertices."""
        q, v = state.q[0].numpy(), state.v[0].numpy()
        g = self.mass[:, None] * (x - q - H * v) / H**2 - self.internal_force(x) - self.weight
        g[BODY.fixed_vertices] = 0.0
        return g

    def jacobian(self, x, state):
        """(24, 24) derivative of the residual of the free vertices by central differences."""
        columns = []
        for i in FREE:
            for k in range(3):
                step = np.zeros((12, 3))
                step[i, k] = 1e-6
                change = self.residual(x + step, state) - self.residual(x - step, state)
                columns.append(change[FREE].ravel() / 2e-6)
        return np.stack(columns, axis=1)


def rotation(f):
    u, _, vt = np.linalg.svd(f)
    return u @ vt


def unimodular(f):
    """Nearest matrix of determinant one: Newton on the singular values and a multiplier."""
    u, s, vt = np.linalg.svd(f)
    z = np.array([*s, 0.0])
    for _ in range(20):
        d, k = z[:3], z[3]
        c = d.prod() / d  # derivative of the product
        second = d.prod() / np.outer(d, d) * (1 - np.eye(3))
        matrix = np.block([[np.eye(3) + k * second, c[:, None]], [c[None], np.zeros((1, 1))]])
        z = z - np.linalg.solve(matrix, np.array([*(d - s + k * c), d.prod() - 1]))
    return u * z[:3] @ vt


def simulator(material=MODEL, **settings):
    return Simulator(BODY, material, time_step=H, **{"relative_tolerance": 1e-10, **settings})


def observation(steps=1, weights=(0.1,), damping=0.0, **settings):
    """Positions (T + 1, B, 12, 3) of the beam let go from weights at its tip, and its first state."""
    real = simulator(Corotated(264e3, 0.499, stiffness_damping=damping), **settings)
    force = torch.zeros(len(weights), 12, 3, dtype=torch.float64)
    force[:, TIP, 2] = -9.80709 * torch.tensor(weights, dtype=torch.float64)[:, None] / len(TIP)
    start = real.static_equilibrium(Inputs(force))
    return real.rollout(start, steps).q, start


def reconstruct(method, sim, start, observed, regularisation, **settings):
    """All steps; states and forces stacked."""
    solver = make_reconstructor(sim, method, regularisation, **{**SETTINGS, **settings})
    state, results = start, []
    for target in observed[1:]:
        results.append(solver.step(state, target))
        state = results[-1].state
    return torch.stack([r.state.q for r in results]), torch.stack([r.force for r in results])


def objective(q, force, observed, regularisation):
    return ((q - observed) ** 2).sum() + regularisation * (force**2).sum()


class TestGaussNewton:
    def test_without_regularisation_it_hits_the_observation_with_the_force_of_the_equation_of_motion(self, device):
        observed, start = observation()
        sim = simulator(device=device)
        on_device = State(start.q.to(device), start.v.to(device))
        result = make_reconstructor(sim, "gauss_newton", 0.0, **SETTINGS).step(on_device, observed[1].to(device))
        expected = DenseBeam(215e3, 0.45).residual(observed[1, 0].numpy(), start)
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(result.state.q.cpu(), observed[1], rtol=0, atol=1e-16)
        np.testing.assert_allclose(result.state.v.cpu(), (observed[1] - observed[0]) / H, rtol=0, atol=1e-12)
        np.testing.assert_allclose(result.force[0].cpu(), expected, rtol=0, atol=1e-10 * np.abs(expected).max())

    @pytest.mark.parametrize("regularisation", [1e-6, 1e-2])
    def test_dense_solve(self, regularisation):
        observed, start = observation()
        q, force = reconstruct("gauss_newton", simulator(), start, observed, regularisation)
        dense = DenseBeam(215e3, 0.45)
        target = observed[1, 0].numpy()

        def residuals(values):
            x = target.copy()
            x[FREE] = values.reshape(-1, 3)
            weighted = np.sqrt(regularisation) * dense.residual(x, start)[FREE].ravel()
            return np.concatenate([values - target[FREE].ravel(), weighted])

        best = scipy.optimize.least_squares(
            residuals, target[FREE].ravel(), "3-point", x_scale=1e-3, xtol=1e-14, ftol=1e-15, gtol=1e-15
        )
        expected = target.copy()
        expected[FREE] = best.x.reshape(-1, 3)
        missed = np.abs(expected - target).max()
        np.testing.assert_allclose(q[0, 0], expected, rtol=0, atol=1e-4 * missed)
        missing = dense.residual(expected, start)
        np.testing.assert_allclose(force[0, 0], missing, rtol=0, atol=1e-4 * np.abs(missing).max())

    def test_stationary_where_the_hessian_is_indefinite(self):
        _, start = observation()
        observed = start.q * torch.tensor([0.6, 1.0, 1.0], dtype=torch.float64)
        regularisation = 1e-4
        q, force = reconstruct("gauss_newton", simulator(), start, torch.stack([start.q, observed]), regularisation)
        dense = DenseBeam(215e3, 0.45)
        at_target = dense.jacobian(observed[0].numpy(), start)
        assert np.linalg.eigvalsh(at_target).min() < -1.0 / np.sqrt(regularisation)
        slope = dense.jacobian(q[0, 0].numpy(), start) @ force[0, 0, FREE].numpy().ravel()
        missed = (q[0] - observed)[0, FREE].numpy().ravel()
        np.testing.assert_allclose(missed, -regularisation * slope, rtol=0, atol=1e-5 * np.abs(missed).max())

    def test_too_few_iterations(self):
        observed, start = observation()
        solver = make_reconstructor(simulator(), "gauss_newton", 1e-4, tolerance=1e-12, max_iterations=1)
        with pytest.raises(ConvergenceError, match=r"moved by .* raise reconstruction\.max_iterations"):
            solver.step(start, observed[1])


class TestMethodsAgree:
    @pytest.mark.parametrize(("integrator", "stiffness_damping"), [*zip(INTEGRATORS, (2e-3, 0.0, 2e-3), strict=True)])
    def test_minimum(self, integrator, stiffness_damping):
        regularisation = 1e-4
        observed, start = observation(2, integrator=integrator)
        sim = simulator(Corotated(215e3, 0.45, stiffness_damping=stiffness_damping), integrator=integrator)
        q, force = reconstruct("gauss_newton", sim, start, observed, regularisation)
        other = {"tolerance": 1e-15, "max_iterations": 2000}
        q_other, force_other = reconstruct("lbfgsb", sim, start, observed, regularisation, **other)
        for t in range(2):
            value = objective(q[t], force[t], observed[t + 1], regularisation)
            value_other = objective(q_other[t], force_other[t], observed[t + 1], regularisation)
            assert float(value / value_other) == pytest.approx(1.0, abs=1e-5 if t else 1e-8)
        np.testing.assert_allclose(force, force_other, rtol=0, atol=2e-3 * float(force.abs().max()))
        np.testing.assert_allclose(q, q_other, rtol=0, atol=2e-3 * float((q - observed[1:]).abs().max()))


class TestTrajectory:
    @pytest.mark.parametrize(("method", "integrator"), [("gauss_newton", "bdf2"), ("lbfgsb", "midpoint")])
    def test_forces_reproduce_it_in_open_loop(self, method, integrator):
        observed, start = observation(6, (0.05, 0.2), integrator=integrator)
        sim = simulator(integrator=integrator)
        q, force = reconstruct(method, sim, start, observed, 1e-5, max_iterations=500)
        replayed = sim.rollout(start, 6, Inputs(force)).q[1:]
        uncorrected = sim.rollout(start, 6).q[1:]
        np.testing.assert_allclose(replayed, q, rtol=0, atol=1e-9)
        assert float((q - observed[1:]).abs().max()) < 0.2 * float((uncorrected - observed[1:]).abs().max())

    @pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
    def test_errors_of_the_steps_do_not_add_up(self, integrator):
        damping = 1e-3 if integrator == "midpoint" else 0.0  # undamped, it rings
        observed, start = observation(40, damping=damping, integrator=integrator)
        sim = simulator(Corotated(215e3, 0.45, stiffness_damping=damping), integrator=integrator)
        q, _ = reconstruct("gauss_newton", sim, start, observed, 1e-9)
        missed = (q - observed[1:]).abs().amax((1, 2, 3))
        assert float(missed[20:].max()) < float(missed[:20].max())


class TestClosedLoop:
    def test_a_diverged_motion_is_marked_and_does_not_affect_others(self):
        _, start = observation(1, (0.05, 0.2, 0.1))
        few = SolverSettings(on_failure="count", max_iterations=15)
        counting = Simulator(BODY, MODEL, H, solver=few)

        def predict(state, step):
            force = torch.zeros_like(state.q)
            if step == 1:
                force[0] = torch.nan
            if step == 2:
                force[1] = 100.0 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
            return force

        positions = closed_loop(Rollout(counting, predict), start, 5)
        lost = torch.isnan(positions).all(3).all(2)
        assert lost.tolist() == [
            [False, False, True, True, True, True],
            [False, False, False, True, True, True],
            [False] * 6,
        ]
        alone = simulator().rollout(State(start.q[2:], start.v[2:]), 5).q
        np.testing.assert_allclose(positions[2], alone[:, 0], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"method": "adam"}, "reconstruction.method"),
        ({"regularisation": -1e-9}, "reconstruction.regularisation"),
        ({"regularisation": float("nan")}, "reconstruction.regularisation"),
        ({"tolerance": 0.0}, "reconstruction.tolerance"),
        ({"max_iterations": 0}, "reconstruction.max_iterations"),
    ],
)
def test_bad_settings(settings, sentence):
    good = {"method": "gauss_newton", "regularisation": 1e-9, "tolerance": 1e-10, "max_iterations": 20}
    with pytest.raises(InputError) as error:
        make_reconstructor(simulator(), **{**good, **settings})
    assert sentence in str(error.value)
