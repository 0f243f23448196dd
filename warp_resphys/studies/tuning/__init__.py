"""The search for settings: its space, the workers that share it, and the study that they keep together."""
