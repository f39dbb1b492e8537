"""Locks a bus for one flight: an advisory lock on its file, which the kernel releases when the process dies.

The guardian and `deploy/coils-off` take no lock: they may switch the coils off at any time.
"""

from __future__ import annotations

import errno
import fcntl


def hold(descriptor: int) -> None:
    """Lock an open file until it is closed. Raises OSError (EUSERS) when another process holds the lock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EUSERS, "another flight drives the coils on this bus") from error
