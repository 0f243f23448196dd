"""Measured data: recordings, their registration on a body, markers, and the inputs that drive it.

Entry points: `recordings.recording_files.read_recording`, `registration.register_markers`,
`markers.bind_markers`.
"""
