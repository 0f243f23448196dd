"""Measured markers: reading files of several programs, occlusions, jumps, the release, and how good a recording is."""
