"""The report of a run: figures, a picture of the deformed body, and one self-contained page."""
