"""Standard output and standard error that outlast their reader.

A command does its work to the end though nobody reads: its pipe may be closed (`| head`), its terminal may be
gone, or it may have been started without one (`>&-`).
"""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import Any

_READER_GONE = frozenset({errno.EPIPE, errno.EIO, errno.EBADF})


class _Outlet(io.FileIO):
    """A file descriptor that discards output once its reader is gone, or after its first error."""

    _lost = False

    def write(self, data: Any, /) -> int:
        """Write bytes; return how many are done with. Raises OSError once, such as for a full disk."""
        try:
            if not self._lost:
                return super().write(data)
        except OSError as error:
            self._lost = True
            if error.errno not in _READER_GONE:
                raise
        return memoryview(data).nbytes


def outlast_readers() -> None:
    """Replace the process's two output streams; streams that a caller put there are left alone."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            # The number is free: a file that is opened next would get it, and the output of others.
            while (held := os.open(os.devnull, os.O_WRONLY)) < number:
                pass
            if held != number:
                os.close(held)
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - lasts as the process
        elif stream is getattr(sys, f"__{name}__") and isinstance(stream, io.TextIOWrapper):
            outlet = io.BufferedWriter(_Outlet(number, "w", closefd=False))
            by_line = name == "stderr" or stream.line_buffering
            made = io.TextIOWrapper(
                outlet, encoding=stream.encoding, errors="backslashreplace", line_buffering=by_line
            )
            stream.flush()
            setattr(sys, name, made)
