"""Residual forces of a tiny beam, of all its vertices or of markers:
replayed, by both methods, by brute force.
"""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Inputs, Simulator, State, box_hexahedra, select_vertices
from warp_resphys.core.dynamics.linearisation import Linearisation
from warp_resphys.data.markers import KINDS, WHOLE_STATE, MarkerMap, bind_markers
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.learning.residuals.reconstruction import follow, make_reconstructor
from warp_resphys.settings.learning import ReconstructionSettings

INTEGRATORS = ("implicit_euler", "bdf2", "midpoint")
MESH = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
FREE = np.setdiff1d(np.arange(12), BODY.fixed_vertices)
TIP = select_vertices(MESH, x=0.06)
TIGHT = {"tolerance": 1e-12, "max_iterations": 50}
PUBLISHED = {"tolerance": 1e-15, "max_iterations": 3000}
STEMS = [[0.06, 0.012, 0.045], [0.03, -0.015, 0.013], [0.075, 0.02, 0.01]]


def reconstructor(sim, method, regularisation, tolerance, max_iterations, observation=WHOLE_STATE):
    """The method with these settings."""
    settings = {"method": method, "regularisation": regularisation, "tolerance": tolerance}
    return make_reconstructor(
        sim, ReconstructionSettings(**settings, max_iterations=max_iterations), observation
    )


def simulator(stiffness_damping=0.0, **settings):
    material = Corotated(215e3, 0.45, stiffness_damping=stiffness_damping)
    return Simulator(BODY, material, **{"relative_tolerance": 1e-11, **settings})


def observation(steps=1, weights=(0.1,), damping=0.0, **settings):
    """Positions (T + 1, B, 12, 3) of the beam let go
    from weights at its tip, and its first state.
    """
    material = Corotated(264e3, 0.499, stiffness_damping=damping)
    real = Simulator(BODY, material, relative_tolerance=1e-11, **settings)
    force = torch.zeros(len(weights), 12, 3, dtype=torch.float64)
    force[:, TIP, 2] = -9.80709 * torch.tensor(weights, dtype=torch.float64)[:, None] / len(TIP)
    start = real.static_equilibrium(Inputs(force))
    return real.rollout(start, steps).q, start


def markers_at(*rows):
    return MarkerMap.at_vertices(torch.tensor(rows))


OBSERVED = {
    "whole": WHOLE_STATE,
    "vertices": markers_at([5, 10]),
    "pairs": markers_at([5, 8, 11], [9, 6, 4]),
}
OBSERVED |= {
    kind: bind_markers(MESH, STEMS, [*"abc"], kind=kind, vertices=TIP, patch=0.06) for kind in KINDS
}


def reconstruct(solver, start, observed):
    """All steps; states and forces stacked."""
    results = list(follow(solver, start, [solver.observation(target) for target in observed[1:]]))
    return torch.stack([r.state.q for r in results]), torch.stack([r.force for r in results])


class TestMarkerMap:
    def test_it_weighs_vertices_and_its_transpose_is_its_transpose(self):
        random = torch.Generator().manual_seed(0)
        markers = MarkerMap(
            torch.tensor([[[0, 1], [5, 5]], [[2, 3], [7, 0]]]),
            torch.rand(2, 2, 2, generator=random),
        )
        q = torch.rand(2, 8, 3, generator=random)
        at = markers(q)
        torch.testing.assert_close(
            at[0, 0], markers.weights[0, 0, 0] * q[0, 0] + markers.weights[0, 0, 1] * q[0, 1]
        )
        torch.testing.assert_close(at[0, 1], markers.weights[0, 1].sum() * q[0, 5])
        product = (markers.transposed_jacobian(q[:1]).mT @ q.reshape(2, 24, 1)).reshape(2, 2, 3)
        torch.testing.assert_close(product, at)

    @pytest.mark.parametrize("shape", [(2, 3), (1, 0, 1)])
    def test_bad_shapes(self, shape):
        with pytest.raises(InputError, match="both must be"):
            MarkerMap(torch.zeros(shape, dtype=torch.int64), torch.ones(shape))


class TestGaussNewton:
    def test_without_regularisation_it_hits_the_observation_with_the_force_of_motion(self, device):
        observed, start = observation()
        sim = simulator(device=device)
        on_device = State(start.q.to(device), start.v.to(device))
        result = reconstructor(sim, "gauss_newton", 0.0, **TIGHT).step(
            on_device, observed[1].to(device)
        )
        np.testing.assert_allclose(result.state.q.cpu(), observed[1], rtol=0, atol=1e-16)
        speed = (observed[1] - observed[0]) / sim.time_step
        np.testing.assert_allclose(result.state.v.cpu(), speed, rtol=0, atol=1e-12)
        assert float(result.force.abs().max()) > 0.01
        assert not result.force[:, BODY.fixed_vertices].any()
        replayed = sim.step(on_device, Inputs(result.force))
        np.testing.assert_allclose(replayed.q.cpu(), observed[1], rtol=0, atol=1e-12)

    @pytest.mark.parametrize(("regularisation", "most"), [(1e-8, 5), (1e-3, 14)])
    def test_the_last_step_takes_no_new_factor(self, regularisation, most, monkeypatch):
        """It is within the tolerance of the minimum that exact steps reach,
        also where forces are large there.
        """
        made, shifted = [], Linearisation.shifted
        monkeypatch.setattr(
            Linearisation, "shifted", lambda self, scale: (made.append(1), shifted(self, scale))[1]
        )
        observed, start = observation(5)
        found, counts = {}, []
        for tolerance in (1e-10, 1e-14):
            method = reconstructor(simulator(), "gauss_newton", regularisation, tolerance, 20)
            found[tolerance], _ = reconstruct(method, start, observed)
            counts.append(len(made))
        assert counts[0] <= most
        np.testing.assert_allclose(found[1e-10], found[1e-14], rtol=0, atol=1e-10)
        assert float((found[1e-10] - observed[1:]).abs().max()) > 1e-9

    def test_stationary_where_the_hessian_is_indefinite(self):
        _, start = observation()
        observed = start.q * torch.tensor([0.6, 1.0, 1.0], dtype=torch.float64)
        regularisation = 1e-4
        solver = reconstructor(simulator(), "gauss_newton", regularisation, **TIGHT)
        q, force = reconstruct(solver, start, torch.stack([start.q, observed]))
        steps = torch.zeros(24, 12, 3, dtype=torch.float64)
        steps[:, FREE] = 1e-6 * torch.eye(24, dtype=torch.float64).view(24, 8, 3)

        def missing(x):
            """Forces (B, 24) on the free vertices that bring the body to positions (B, 12, 3)."""
            exact = reconstructor(simulator(), "gauss_newton", 0.0, **TIGHT)
            state = State(*(field.expand(len(x), -1, -1) for field in (start.q, start.v)))
            return exact.step(state, x).force[:, FREE].flatten(1)

        def jacobian(x):
            return (missing(x + steps) - missing(x - steps)).T / 2e-6

        assert float(torch.linalg.eigvalsh(jacobian(observed)).min()) < -1.0 / np.sqrt(
            regularisation
        )
        slope = jacobian(q[0]) @ force[0, 0, FREE].flatten()
        missed = (q[0] - observed)[0, FREE].flatten()
        np.testing.assert_allclose(
            missed, -regularisation * slope, rtol=0, atol=1e-5 * float(missed.abs().max())
        )

    @pytest.mark.parametrize(
        ("name", "remedy"), [("whole", "max_iterations"), ("vertices", "regularisation")]
    )
    def test_too_few_iterations(self, name, remedy):
        observed, start = observation()
        settings = {"tolerance": 1e-12, "max_iterations": 1, "observation": OBSERVED[name]}
        solver = reconstructor(simulator(), "gauss_newton", 1e-4, **settings)
        with pytest.raises(
            ConvergenceError, match=rf"moved by .* raise .*reconstruction\.{remedy}"
        ):
            solver.step(start, solver.observation(observed[1]))

    @pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
    def test_errors_of_the_steps_do_not_add_up(self, integrator):
        damping = 1e-3 if integrator == "midpoint" else 0.0  # undamped, it rings
        observed, start = observation(40, damping=damping, integrator=integrator)
        solver = reconstructor(
            simulator(damping, integrator=integrator), "gauss_newton", 1e-9, **TIGHT
        )
        q, _ = reconstruct(solver, start, observed)
        missed = (q - observed[1:]).abs().amax((1, 2, 3))
        assert float(missed[20:].max()) < float(missed[:20].max())


@pytest.mark.parametrize(
    ("name", "integrator", "regularisation", "damping"),
    [
        *(
            ("whole", integrator, 1e-4, damping)
            for integrator, damping in zip(INTEGRATORS, (2e-3, 0, 2e-3), strict=True)
        ),
        *(("vertices", "bdf2", 1e-4, 0.0), ("vertices", "implicit_euler", 1e-6, 0.0)),
        *(
            (kind, integrator, 1e-6, 0.0)
            for kind, integrator in zip(KINDS, INTEGRATORS, strict=False)
        ),
    ],
)
def test_the_published_method_finds_the_same_minimum(name, integrator, regularisation, damping):
    """Stems that turn make the map nonlinear: both ways
    to the minimum need its derivative where the body is.
    """
    markers, sim = OBSERVED[name], simulator(damping, integrator=integrator)
    observed, start = observation(
        1 if name in KINDS else 2, (0.5 if name in KINDS else 0.1,), integrator=integrator
    )
    (q, force), (q_other, force_other) = (
        reconstruct(reconstructor(sim, *settings, observation=markers, **bounds), start, observed)
        for *settings, bounds in (
            ("gauss_newton", regularisation, TIGHT),
            ("lbfgsb", regularisation, PUBLISHED),
        )
    )

    def objective(t, q, force):
        missed = markers(q[t]) - markers(observed[t + 1])
        return float(missed.square().sum() + regularisation * force[t].square().sum())

    for t in range(len(q)):
        assert objective(t, q, force) <= objective(t, q_other, force_other) * (
            1.0 + (1e-5 if t else 1e-9)
        )
    np.testing.assert_allclose(force, force_other, rtol=0, atol=2e-3 * float(force.abs().max()))
    missed = float((q - observed[1:]).abs().max())
    np.testing.assert_allclose(q, q_other, rtol=0, atol=2e-3 * missed if name == "whole" else 1e-7)


@pytest.mark.parametrize(
    ("method", "integrator", "name"),
    [
        *(("gauss_newton", "bdf2", "whole"), ("lbfgsb", "midpoint", "whole")),
        *(("gauss_newton", "bdf2", "pairs"), ("gauss_newton", "midpoint", "pairs")),
    ],
)
def test_forces_reproduce_the_motion_in_open_loop(method, integrator, name):
    observed, start = observation(6, (0.05, 0.2), integrator=integrator)
    sim, markers = simulator(integrator=integrator), OBSERVED[name]
    regularisation, share = (1e-5, 0.2) if name == "whole" else (1e-7, 0.3)
    settings = {"tolerance": 1e-12, "max_iterations": 500, "observation": markers}
    q, force = reconstruct(reconstructor(sim, method, regularisation, **settings), start, observed)
    assert not force[:, :, BODY.fixed_vertices].any()
    replayed = sim.rollout(start, 6, Inputs(force)).q[1:]
    uncorrected = sim.rollout(start, 6).q[1:]
    np.testing.assert_allclose(replayed, q, rtol=0, atol=1e-9)
    assert float((q - observed[1:]).norm()) < share * float((uncorrected - observed[1:]).norm())


class TestLevenbergMarquardt:
    @pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
    def test_gauss_newton_finds_the_same_minimum(self, integrator):
        """With stems that turn, and with a marker that one of the environments did not see."""
        observed, start = observation(3, (0.1, 0.5), integrator=integrator)
        sim = simulator(integrator=integrator)
        markers = bind_markers(MESH, STEMS[::2], ["a", "b"], kind="rigid", vertices=TIP)
        states, first = [start, start], None
        for target in observed[1:]:
            seen = markers(target)
            seen[1, 0] = torch.nan
            damped, plain = (
                reconstructor(sim, method, 1e-6, **TIGHT, observation=markers).step(
                    state, seen, first_guess=first
                )
                for method, state in zip(
                    ("levenberg_marquardt", "gauss_newton"), states, strict=True
                )
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
        target = markers(start.q) + torch.tensor(
            [[[-0.03, 0.0, 0.05]], [[0.0, 0.0, 1e-3]]], dtype=torch.float64
        )
        solver = reconstructor(sim, "levenberg_marquardt", 1e-5, 1e-10, 200, observation=markers)
        result = solver.step(start, target)
        force = result.force.clone().requires_grad_(True)
        new = sim.step(start, Inputs(force))
        objective = (markers(new.q) - target).square().sum() + 1e-5 * force.square().sum()
        (gradient,) = torch.autograd.grad(objective, force)
        np.testing.assert_allclose(new.q.detach(), result.state.q, rtol=0, atol=1e-9)
        assert float(gradient[:, FREE].abs().max()) < 1e-4 * 2e-5 * float(result.force.abs().max())


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"method": "adam"}, "ReconstructionSettings.method is 'adam'"),
        (
            {"regularisation": -1e-9, "observation": WHOLE_STATE},
            "ReconstructionSettings.regularisation",
        ),
        ({"regularisation": 0.0}, "reconstruction.regularisation"),
        ({"tolerance": 0.0}, "ReconstructionSettings.tolerance"),
        ({"max_iterations": 0}, "ReconstructionSettings.max_iterations"),
        ({"observation": markers_at([-1])}, "a marker is on a vertex that the body does not have"),
    ],
)
def test_bad_settings(settings, sentence):
    good = {
        "observation": markers_at([8]),
        "method": "gauss_newton",
        "regularisation": 1e-6,
        **TIGHT,
    }
    with pytest.raises(InputError) as error:
        reconstructor(simulator(), **{**good, **settings})
    assert sentence in str(error.value)
