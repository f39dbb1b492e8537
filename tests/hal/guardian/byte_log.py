"""A bus that logs written bytes; a guardian opens it as `tests.hal.guardian.byte_log:open_bus`.

The module has few imports, because the guardian must stay small. If the file FILE.broken exists, transfers
fail as with a device that does not respond.
"""

from __future__ import annotations

import errno
import os
import time


class ByteLog:
    """A bus that appends (monotonic ns, address, register, value) of each write to a file."""

    def __init__(self, path: str) -> None:
        self._path = path

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        if os.path.exists(self._path + ".broken"):
            raise OSError(errno.EREMOTEIO, "no acknowledge")
        with open(self._path, "a", encoding="ascii") as log:
            log.write(f"{time.monotonic_ns()} {address} {register} {value}\n")

    def close(self) -> None:
        """Do nothing, because no file stays open."""


def open_bus(where: str) -> ByteLog:
    return ByteLog(where)
