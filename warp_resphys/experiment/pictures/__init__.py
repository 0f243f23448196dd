"""Identification of a material from pictures: the stages and a simulated camera."""
