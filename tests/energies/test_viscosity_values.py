"""Values of a viscous step against the differential equation of the branches."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from warp_resphys.energies.viscosity import Viscosity, relaxation
from warp_resphys.stepping.integrators import ImplicitEuler
from warp_resphys.stepping.state import State

SECONDS, TIMES, RATIOS = 0.02, np.array([[0.004, 0.3]]), np.array([[0.5, 0.2]])
GENERATOR = torch.Generator().manual_seed(0)
BEFORE, AFTER = (torch.rand(1, 3, 3, generator=GENERATOR, dtype=torch.float64) for _ in range(2))
CARRIED = torch.rand(1, 2, 1, 3, 3, generator=GENERATOR, dtype=torch.float64)


def strain(x):
    """A strain at one point that is linear in the positions of three vertices."""
    return (0.5 * (x + x.mT))[:, None]


def viscosity(damping=0.0):
    return Viscosity(torch.tensor([damping]), damping > 0.0, torch.as_tensor(RATIOS), torch.as_tensor(TIMES))


def test_branches_relax_as_their_equation():
    """dH/dt = dE/dt - H / tau, for a constant rate of strain."""
    rate = ((strain(AFTER) - strain(BEFORE)) / SECONDS)[:, None].numpy()
    tau = TIMES[..., None, None, None]

    def slopes(_, h):
        return (rate - h.reshape(CARRIED.shape) / tau).ravel()

    end = solve_ivp(slopes, (0.0, SECONDS), CARRIED.numpy().ravel(), rtol=1e-10, atol=1e-12).y[:, -1]
    relaxed = viscosity().relax(strain, BEFORE, CARRIED, AFTER, SECONDS)
    np.testing.assert_allclose(relaxed.numpy().ravel(), end, rtol=1e-7)
    decay, gamma = relaxation(torch.tensor([[1e9]]).double(), SECONDS)  # A branch that does not relax is a spring.
    assert (decay.item(), gamma.item()) == pytest.approx((1.0, 1.0), rel=1e-9)


@pytest.mark.parametrize("damping", [0.0, 0.003])
def test_the_stress_of_a_step_is_that_of_the_strains_at_its_end(damping):
    """c E - W is sum_k g_k H_k at the end of the step, and beta times the rate of strain."""
    state = State(BEFORE, torch.zeros_like(BEFORE))
    own = viscosity(damping)
    values, offset, dilation = own.step_values(strain, BEFORE, CARRIED, ImplicitEuler().stage(state, SECONDS), SECONDS)
    ends = own.relax(strain, BEFORE, CARRIED, AFTER, SECONDS)
    rate = (strain(AFTER) - strain(BEFORE)) / SECONDS
    expected = torch.einsum("bk,bkpij->bpij", own.ratio, ends) + damping * rate
    torch.testing.assert_close(values[0, 0] * strain(AFTER) - offset, expected)
    trace = rate.diagonal(dim1=-2, dim2=-1).sum(-1)
    volume = values[0, 1] * strain(AFTER).diagonal(dim1=-2, dim2=-1).sum(-1) - dilation
    torch.testing.assert_close(volume, damping * trace)
