"""Actuators that change inputs by given functions."""

from copy import deepcopy

import torch

from warp_resphys.data.input_network import InputNetwork

CENTRES = 300


def network_of(change, highest, parts, filters=()):
    """A network that nearly adds change(x), (S, C) of (S, C (1 + F)) inputs
    and means between zero and the highest.
    """
    shape = (2000, parts * (1 + len(filters)))
    values = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values[::2] = values[::2].round()  # corners of the range
    values *= highest
    network = InputNetwork.of_training(values, filters, CENTRES).requires_grad_(False)
    columns = functions_of(network, values)
    normal = columns.T @ columns + 1e-6 * torch.eye(columns.shape[1])
    network.weights.copy_(torch.linalg.solve(normal, columns.T @ change(values)))
    return network


def functions_of(network, values):
    """(S, N) what weights of one of the basis functions add."""
    network = deepcopy(network)
    network.weights = torch.nn.Parameter(
        torch.eye(len(network.weights)).double(), requires_grad=False
    )
    return network(values)
