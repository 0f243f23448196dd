"""Adam against the one of torch."""

import pytest
import torch

from warp_resphys.learning.adam import Adam


@pytest.mark.parametrize("weight_decay", [0.0, 0.01])
def test_the_weights_are_those_of_torch(device, weight_decay):
    """Also after a part of the steps, from a saved state; a frozen weight stays."""
    torch.manual_seed(0)
    shapes = ((7, 33), (33,), (), (1, 5))
    start = [torch.randn(shape, device=device) for shape in shapes]
    own, theirs = ([torch.nn.Parameter(values.clone()) for values in start] for _ in range(2))
    frozen = torch.nn.Parameter(torch.ones(3, device=device), requires_grad=False)
    ours = Adam([frozen, *own], weight_decay)
    reference = torch.optim.Adam(theirs, weight_decay=weight_decay, fused=True)
    for step in range(20):
        rate = 1e-2 / (1 + step)
        gradients = [torch.randn(shape, device=device) for shape in shapes]
        for weight, gradient in zip(theirs, gradients, strict=True):
            weight.grad = gradient.clone()
        reference.param_groups[0]["lr"] = rate
        reference.step()
        if step == 10:
            saved = ours.state_dict()
            ours = Adam([frozen, *own], weight_decay)
            ours.load_state_dict(saved)
        ours.step(gradients, rate)
        assert all(map(torch.equal, own, theirs))
    assert not torch.equal(own[0], start[0])
    assert bool((frozen == 1.0).all())
    state, expected = ours.state_dict()["state"], reference.state_dict()["state"]
    assert state.keys() == expected.keys()
    assert all(torch.equal(state[i][key], expected[i][key]) for i in expected for key in expected[i])
