"""Imports without garbage collection."""

import gc

import pytest

from warp_resphys.io.imports import uncollected


@pytest.mark.parametrize("error", [None, ImportError])
def test_nothing_is_collected_meanwhile_and_what_was_made_is_not_searched(error):
    gc.unfreeze()
    with pytest.raises(error) if error else uncollected(), uncollected():
        assert not gc.isenabled()
        made = [[] for _ in range(10)]
        if error:
            raise error
    assert gc.isenabled()
    assert not {id(x) for x in gc.get_objects()} & {id(x) for x in made}
    gc.unfreeze()
