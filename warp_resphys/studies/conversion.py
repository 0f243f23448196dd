"""The command `convert`: recordings of any format as HDF5 files."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from ..data.recordings.bag import is_bag
from ..data.recordings.reading import READERS, read_recording, write_recording
from ..io.errors import DataFileError, InputError, listed
from ..io.settings import Many, Settings, Word
from .recording_quality import RecordingFile


class Conversion(Settings):
    """The configuration ``convert``, which explains its keys."""

    files: Many[Word]
    to: Word
    recording: RecordingFile


def convert(settings: Conversion, folder: Path) -> None:
    """Writes the recordings, and prints a line for each.

    Raises:
        ResphysError: nothing was named, a recording cannot be read, or two have the same name.
    """
    del folder
    files = [*_recordings(settings.files)]
    if not files:
        raise InputError("nothing to convert: name recordings, as in warp-resphys convert FILE.")
    places = {path: Path(settings.to).expanduser() / f"{path.stem}.h5" for path in files}
    if len({*places.values()}) < len(files):
        twice = [str(path) for path in files if [*places.values()].count(places[path]) > 1][:2]
        raise InputError(f"{' and '.join(twice)} would both be {places[Path(twice[0])]}: convert them to two folders.")
    for path, place in places.items():
        if place.exists() and place.samefile(path):
            raise InputError(f"{path} would be replaced by itself: choose another folder, as in to=converted.")
        recording = read_recording(path, *settings.recording.arguments())
        write_recording(place, recording)
        frames, channels = len(recording.positions), recording.actuation
        inputs = "" if channels is None else f", inputs {channels.shape[1]}"
        print(
            f"{path} -> {place}: {frames} frames at {recording.rate:g} Hz, markers {listed(recording.labels)}{inputs}, "
            f"seen {recording.seen.mean():.1%}"
        )


def _recordings(files: Sequence[str]) -> Iterator[Path]:
    """Yields recordings, and those in folders that are no bags."""
    for path in (Path(name).expanduser() for name in files):
        if not path.is_dir() or is_bag(path):
            yield path
            continue
        inside = sorted(own for own in path.iterdir() if own.suffix.lower() in READERS or is_bag(own))
        if not inside:
            raise DataFileError(f"{path} has no recordings that can be read: name a folder with recordings.")
        yield from inside
