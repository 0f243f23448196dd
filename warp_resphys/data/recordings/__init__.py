"""Measured markers: file readers, occlusions, jumps,
detection of the release, and quality of a recording.
"""
