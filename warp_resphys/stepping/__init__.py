"""The state of a batch, what acts on it, and time integration: what energies and the simulator share."""
