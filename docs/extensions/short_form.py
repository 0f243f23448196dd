"""Tutorials in their short form, for a book that is only checked:
fewer steps or cases, and coarser meshes.

A line of a tutorial that ends in `# short: THIS -> THAT` has THAT in place of THIS in the short
form.
"""

import re

_LINE = re.compile(r"^(.*\S) +# short: (.*) -> (.*)$", re.MULTILINE)


def _shortened(match: re.Match[str]) -> str:
    line, this, that = match.groups()
    if line.count(this) != 1:
        raise ValueError(
            f"{this!r}, to be replaced once, is {line.count(this)} times in the line {line!r}"
        )
    return line.replace(this, that)


def in_form(text: str, short: bool) -> str:
    """Returns a tutorial in its short or its whole form."""
    return _LINE.sub(_shortened if short else r"\1", text)
