"""Output to a pipe that its reader closes early, as `head` does."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

NOBODY_READS = 141  # the exit code, 128 + SIGPIPE


@contextmanager
def ends_where_nobody_reads() -> Iterator[None]:
    """Ends the process silently when the reader of its output has closed the pipe."""
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
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)  # Python flushes again at exit.
        raise SystemExit(NOBODY_READS) from None


def _is_unread(stream: TextIO) -> bool:
    """Whether the stream is a pipe without a reader; False on Windows, which cannot tell."""
    if not hasattr(select, "poll"):
        return False
    poll = select.poll()
    poll.register(stream, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
