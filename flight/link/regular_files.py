"""Bounded reading of regular files.

Opening a FIFO at the path of a file would block, and reading a sparse file would exhaust the memory.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_regular(path: Path, most: int) -> bytes | None:
    """Return the content of a file of at most `most` bytes, None if the file does not exist.

    Type and size are checked before reading. Raises OSError for a longer file and for a path that is not a
    regular file.
    """
    try:
        file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        found = os.fstat(file)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "is no regular file", str(path))
        if found.st_size > most:
            raise OSError(errno.EFBIG, f"{found.st_size} bytes are too many", str(path))
        data = b""
        while chunk := os.read(file, most + 1 - len(data)):
            data += chunk
        return data
    finally:
        os.close(file)
