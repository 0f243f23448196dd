"""Recordings that are decoded once."""

import hashlib

import pytest

from warp_resphys.data.recordings import recording_files as arrays


@pytest.fixture(scope="session")
def decoded_recordings():
    """Arrays by the content of their files."""
    return {}


@pytest.fixture(scope="module", autouse=True)
def _recordings_are_decoded_once(decoded_recordings):
    """Files of the same content, each of which takes a process of its own."""
    decode = arrays.decode

    def decoded(library, path, *names):
        key = library, hashlib.sha256(path.read_bytes()).digest(), names
        if key not in decoded_recordings:
            decoded_recordings[key] = decode(library, path, *names)
        return {name: array.copy() for name, array in decoded_recordings[key].items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "decode", decoded)
        yield
