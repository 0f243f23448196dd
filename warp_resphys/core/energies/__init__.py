"""Energies of a body: materials, actuators, contact and surroundings."""
