"""Tutorials in their short form, for a book that is only checked: fewer steps or cases.

A line of a tutorial that ends in `# short: CODE` is CODE in the short form, and what stands before in the whole one.
"""

import re

_LINE = re.compile(r"^( *)(.*\S) +# short: (.*)$", re.MULTILINE)


def in_form(text: str, short: bool) -> str:
    """Returns a tutorial in its short or its whole form."""
    return _LINE.sub(r"\1\3" if short else r"\1\2", text)
