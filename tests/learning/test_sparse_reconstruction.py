"""Residual forces from sparse markers, against the published method and against brute force on a tiny beam."""

import numpy as np
import pytest
import scipy.optimize
import torch

from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices
from warp_resphys.data.markers import KINDS, MarkerMap, bind_markers
from warp_resphys.dynamics.modes import vibration_modes
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.learning.reconstruction import make_reconstructor
from warp_resphys.stepping.inputs import Inputs

MESH = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
TIP = select_vertices(MESH, x=0.06)
INTEGRATORS = ("implicit_euler", "bdf2", "midpoint")
TIGHT = {"tolerance": 1e-12, "max_iterations": 40}


def simulator(youngs_modulus=215e3, poissons_ratio=0.45, kind=Simulator, **settings):
    return kind(BODY, Corotated(youngs_modulus, poissons_ratio), **{"relative_tolerance": 1e-11, **settings})


def observation(steps=1, weights=(0.1,), **settings):
    """Positions (T + 1, B, 12, 3) of the beam let go from weights at its tip, and its first state."""
    real = simulator(264e3, 0.499, **settings)
    force = torch.zeros(len(weights), 12, 3, dtype=torch.float64)
    force[:, TIP, 2] = -9.80709 * torch.tensor(weights, dtype=torch.float64)[:, None] / len(TIP)
    with torch.no_grad():
        start = real.static_equilibrium(Inputs(force))
        return real.rollout(start, steps).q, start


def markers_at(*rows):
    return MarkerMap.at_vertices(torch.tensor(rows))


def make_sparse_reconstructor(sim, markers, *settings, **options):
    return make_reconstructor(sim, *settings, observation=markers, **options)


def gauss_newton(sim, markers, *settings, **options):
    return make_reconstructor(sim, "gauss_newton", *settings, observation=markers, **options)


def levenberg_marquardt(sim, markers, *settings, **options):
    return make_reconstructor(sim, "levenberg_marquardt", *settings, observation=markers, **options)


def reconstruct(solver, start, observed):
    state, results = start, []
    for target in observed[1:]:
        results.append(solver.step(state, solver.observation(target)))
        state = results[-1].state
    return torch.stack([r.state.q for r in results]), torch.stack([r.force for r in results])


class TestMarkerMap:
    def test_it_weighs_vertices_and_its_transpose_is_its_transpose(self):
        random = torch.Generator().manual_seed(0)
        markers = MarkerMap(torch.tensor([[[0, 1], [5, 5]], [[2, 3], [7, 0]]]), torch.rand(2, 2, 2, generator=random))
        q = torch.rand(2, 8, 3, generator=random)
        at = markers(q)
        torch.testing.assert_close(at[0, 0], markers.weights[0, 0, 0] * q[0, 0] + markers.weights[0, 0, 1] * q[0, 1])
        torch.testing.assert_close(at[0, 1], markers.weights[0, 1].sum() * q[0, 5])
        product = (markers.transposed_jacobian(q[:1]).mT @ q.reshape(2, 24, 1)).reshape(2, 2, 3)
        torch.testing.assert_close(product, at)

    @pytest.mark.parametrize("shape", [(2, 3), (1, 0, 1)])
    def test_bad_shapes(self, shape):
        with pytest.raises(InputError, match="both must be"):
            MarkerMap(torch.zeros(shape, dtype=torch.int64), torch.ones(shape))


class TestGaussNewton:
    @pytest.mark.parametrize(("integrator", "regularisation"), [("bdf2", 1e-4), ("implicit_euler", 1e-6)])
    def test_the_published_method_finds_the_same_minimum(self, integrator, regularisation):
        observed, start = observation(2, integrator=integrator)
        sim, markers = simulator(integrator=integrator), markers_at([5, 10])
        ours = make_sparse_reconstructor(sim, markers, "gauss_newton", regularisation, **TIGHT)
        published = make_sparse_reconstructor(sim, markers, "lbfgsb", regularisation, 1e-15, 3000)
        q, force = reconstruct(ours, start, observed)
        q_other, force_other = reconstruct(published, start, observed)

        def objective(q, force):
            misfit = markers(q) - markers(observed[1])
            return float(misfit.square().sum() + regularisation * force.square().sum())

        assert objective(q[0], force[0]) <= objective(q_other[0], force_other[0]) * (1 + 1e-9)
        np.testing.assert_allclose(force, force_other, rtol=0, atol=2e-3 * float(force.abs().max()))
        np.testing.assert_allclose(q, q_other, rtol=0, atol=1e-7)

    @pytest.mark.parametrize("modes", [2, 12])
    def test_minimum_in_a_basis_against_brute_force(self, modes):
        """With 2 columns against 6 coordinates, and with 12: both ways to the same Jacobian."""
        observed, start = observation()
        sim, markers, regularisation = simulator(), markers_at([6, 11]), 1e-6
        basis = vibration_modes(sim, modes)

        def residuals(coefficients):
            force = basis @ torch.as_tensor(coefficients)
            new, _ = sim.step(start, Inputs(force.view(1, 12, 3)))
            misfit = (markers(new.q) - markers(observed[1])).ravel()
            return np.concatenate([misfit, np.sqrt(regularisation) * force])

        best = scipy.optimize.least_squares(residuals, np.zeros(modes), "3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        result = gauss_newton(sim, markers, regularisation, **TIGHT, modes=modes).step(start, markers(observed[1]))
        expected = (basis @ torch.as_tensor(best.x)).view(1, 12, 3)
        np.testing.assert_allclose(result.force, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))

    @pytest.mark.parametrize(("integrator", "modes"), [("bdf2", 6), ("midpoint", None)])
    def test_forces_reproduce_it_in_open_loop(self, integrator, modes):
        observed, start = observation(6, (0.05, 0.2), integrator=integrator)
        sim = simulator(integrator=integrator)
        solver = gauss_newton(sim, markers_at([5, 8, 11], [9, 6, 4]), 1e-7, **TIGHT, modes=modes)
        q, force = reconstruct(solver, start, observed)
        assert not force[:, :, BODY.fixed_vertices].any()
        with torch.no_grad():
            replayed = sim.rollout(start, 6, Inputs(force)).q[1:]
            uncorrected = sim.rollout(start, 6).q[1:]
        np.testing.assert_allclose(replayed, q, rtol=0, atol=1e-9)
        assert float((q - observed[1:]).norm()) < 0.3 * float((uncorrected - observed[1:]).norm())

    @pytest.mark.parametrize(("kind", "integrator"), [*zip(KINDS, INTEGRATORS, strict=False)])
    def test_markers_on_stems_against_the_published_method(self, kind, integrator):
        """Stems that turn make the map nonlinear: both ways to the minimum need its derivative where the body is."""
        stems = [[0.06, 0.012, 0.045], [0.03, -0.015, 0.013], [0.075, 0.02, 0.01]]
        markers = bind_markers(MESH, stems, "abc", kind=kind, vertices=TIP, patch=0.06)
        observed, start = observation(1, (0.5,), integrator=integrator)
        targets, sim = markers(observed[1]), simulator(integrator=integrator)
        ours = make_sparse_reconstructor(sim, markers, "gauss_newton", 1e-6, **TIGHT).step(start, targets)
        published = make_sparse_reconstructor(sim, markers, "lbfgsb", 1e-6, 1e-15, 3000).step(start, targets)
        force, force_other = ours.force, published.force
        np.testing.assert_allclose(force, force_other, rtol=0, atol=2e-3 * float(force.abs().max()))
        np.testing.assert_allclose(ours.state.q, published.state.q, rtol=0, atol=1e-7)
        with torch.no_grad():
            replayed, _ = sim.step(start, Inputs(force))
        np.testing.assert_allclose(replayed.q, ours.state.q, rtol=0, atol=1e-9)

    def test_failed_convergence_is_an_error(self):
        observed, start = observation()
        solver = gauss_newton(simulator(), markers_at([8]), 1e-6, tolerance=1e-12, max_iterations=1)
        with pytest.raises(ConvergenceError, match=r"reconstruction\.regularisation"):
            solver.step(start, solver.observation(observed[1]))


class TestLevenbergMarquardt:
    @pytest.mark.parametrize(("integrator", "modes"), [("bdf2", None), ("midpoint", 4)])
    def test_gauss_newton_finds_the_same_minimum(self, integrator, modes):
        """With stems that turn, and with a marker that one of the environments did not see."""
        observed, start = observation(3, (0.1, 0.5), integrator=integrator)
        stems = [[0.06, 0.012, 0.045], [0.075, 0.02, 0.01]]
        sim, markers = simulator(integrator=integrator), bind_markers(MESH, stems, "ab", kind="rigid", vertices=TIP)
        states, first = [start, start], None
        for target in observed[1:]:
            seen = markers(target)
            seen[1, 0] = torch.nan
            damped, plain = (
                solver(sim, markers, 1e-6, **TIGHT, modes=modes).step(state, seen, first_guess=first)
                for solver, state in zip((levenberg_marquardt, gauss_newton), states, strict=True)
            )
            scale = float(plain.force.abs().max())
            np.testing.assert_allclose(damped.force, plain.force, rtol=0, atol=1e-6 * scale)
            np.testing.assert_allclose(damped.state.q, plain.state.q, rtol=0, atol=1e-9)
            states, first = [damped.state, plain.state], damped.force
        assert (damped.state.previous is None) == (plain.state.previous is None)

    def test_it_follows_a_jerk_to_a_minimum(self):
        """Where full steps overshoot: no small change of the force makes the objective smaller."""
        _, start = observation(1, (0.1, 0.1))
        sim, markers = simulator(), markers_at([6, 11], [6, 11])
        target = markers(start.q) + torch.tensor([[[-0.03, 0.0, 0.05]], [[0.0, 0.0, 1e-3]]], dtype=torch.float64)
        result = levenberg_marquardt(sim, markers, 1e-5, 1e-10, 200).step(start, target)
        force = result.force.clone().requires_grad_(True)
        new, _ = sim.step(start, Inputs(force))
        objective = (markers(new.q) - target).square().sum() + 1e-5 * force.square().sum()
        (gradient,) = torch.autograd.grad(objective, force)
        np.testing.assert_allclose(new.q.detach(), result.state.q, rtol=0, atol=1e-9)
        free = [i for i in range(12) if i not in BODY.fixed_vertices]
        assert float(gradient[:, free].abs().max()) < 1e-4 * 2e-5 * float(result.force.abs().max())


class TestModes:
    def test_the_slowest_two_bend_and_all_of_them_span_every_force(self):
        sim = simulator()
        slowest = vibration_modes(sim, 2).view(12, 3, 2)
        assert float(slowest[:, 0].norm()) < float(slowest[:, 1:].norm())
        assert bool((slowest[TIP].sum((0, 1)).abs() > 0.5).all())
        everything = vibration_modes(sim, 24)
        assert np.linalg.matrix_rank(everything.numpy()) == 24


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"regularisation": 0.0}, "reconstruction.regularisation"),
        ({"method": "lbfgsb", "modes": 3}, "reconstruction.method"),
        ({"modes": 25}, "25 vibration modes were asked for, but the body has 1 to 24."),
        ({"markers": markers_at([-1])}, "a marker is on a vertex that the body does not have"),
    ],
)
def test_bad_settings(settings, sentence):
    good = {"markers": markers_at([8]), "method": "gauss_newton", "regularisation": 1e-6, **TIGHT}
    with pytest.raises(InputError) as error:
        make_sparse_reconstructor(simulator(), **{**good, **settings})
    assert sentence in str(error.value)
