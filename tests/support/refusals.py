"""Refusals of wrong input."""

import pytest


def refuses(error, said, call, /, *arguments, **options):
    """Checks that a call raises an error of a class, in a single line that a pattern matches."""
    with pytest.raises(error, match=said) as told:
        call(*arguments, **options)
    assert "\n" not in str(told.value)
