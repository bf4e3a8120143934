"""Keeps the process alive when its log cannot be written: what a full disk does not take is lost."""

from __future__ import annotations

import errno
import io
import sys

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""A reader that has gone (``EPIPE``) still ends a command, as users of ``| head`` expect."""


class LossyText(io.TextIOWrapper):
    """A text stream that loses what cannot be written for want of room."""

    def write(self, text: str) -> int:
        """Write `text`, or lose it; return its length."""
        try:
            return super().write(text)
        except OSError as error:
            if error.errno not in FULL:
                raise
            return len(text)

    def flush(self) -> None:
        """Write what is buffered, or keep a few kilobytes of it until there is room."""
        try:
            super().flush()
        except OSError as error:
            if error.errno not in FULL:
                raise


def survive_full_disk() -> None:
    """Replace ``sys.stderr``, which may be a log file, by a stream that loses what finds no room. Once per process."""
    stderr = sys.stderr
    if type(stderr) is not io.TextIOWrapper or stderr is not sys.__stderr__:  # there is none, or a test captures it
        return
    encoding, errors = stderr.encoding, stderr.errors
    sys.stderr = LossyText(stderr.detach(), encoding=encoding, errors=errors, line_buffering=True)
