"""Output into a pipe whose reader leaves early, as `head` does."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

NOBODY_READS = 141  # 128 + SIGPIPE: the exit code then


@contextmanager
def ends_where_nobody_reads() -> Iterator[None]:
    """Ends the process without a word when its output breaks for want of a reader."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        unread = [stream.fileno() for stream in (sys.stdout, sys.stderr) if _is_unread(stream)]
        if not unread:
            raise
        for descriptor in unread:
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)  # Python flushes once more at its end.
        raise SystemExit(NOBODY_READS) from None


def _is_unread(stream: TextIO) -> bool:
    """Whether the stream is a pipe that nobody has open to read any more."""
    poll = select.poll()
    poll.register(stream, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
