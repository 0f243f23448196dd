"""Recordings: read, registered to the body, and imported as trials."""
