"""The offending key of an error message, for tests of refused settings."""

import re

_KEY = re.compile(r"[a-z_]\w*(?:\.\w+)+")  # dotted, as in data.weights_g.test
_SUBJECT = re.compile(r"\w+(?= is )")


def offending(sentence: str) -> str:
    """Returns the key that a message names, or the whole message if it names none."""
    match = _KEY.search(sentence) or _SUBJECT.search(sentence)
    return match[0] if match else sentence
