"""The public names as an editor completes them; `support/public_types.py` has their types."""

import warp_resphys


def test_completion_lists_the_public_names_alone():
    assert sorted(dir(warp_resphys)) == sorted(
        [*warp_resphys.__all__, "energies", "learning", "mesh", "pictures", "__version__"]
    )
