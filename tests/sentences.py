"""What tests of refused settings ask of a sentence: the offending key, not its words."""

import re

_KEY = re.compile(r"[a-z_]\w*(?:\.\w+)+")  # dotted, as in data.weights_g.test
_SUBJECT = re.compile(r"\w+(?= is )")


def offending(sentence: str) -> str:
    """Returns the key that a sentence names; the sentence itself where it names none."""
    found = _KEY.search(sentence) or _SUBJECT.search(sentence)
    return found[0] if found else sentence
