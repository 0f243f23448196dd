"""Runs, bodies and commands that several tests share."""
