"""What systemd is told over its notification socket (sd_notify(3)): ready, alive, stopping.

Without a service manager - no NOTIFY_SOCKET in the environment - every word is dropped, and so is one that
cannot be delivered: telling must never hold up or end a flight.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Mapping


class ServiceManager:
    """The service manager that started this process, if one did."""

    def __init__(self, environment: Mapping[str, str], process_id: int) -> None:
        """Take the environment's word; the watchdog is for `process_id` only when WATCHDOG_PID says so."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._line: socket.socket | None = None
        if self._address:
            self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._line.setblocking(False)
        meant = environment.get("WATCHDOG_PID", str(process_id)) == str(process_id)
        period = environment.get("WATCHDOG_USEC", "")
        self.watchdog_ns = int(period) * 1000 if meant and period.isdecimal() else 0
        """Within what time the watchdog must be fed; 0 where there is none."""

    def ready(self, status: str) -> None:
        """Say that the start is over."""
        self._tell(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """Say how it goes, in one line for people."""
        self._tell(f"STATUS={status}")

    def feed_watchdog(self) -> None:
        """Say that everything makes progress."""
        if self.watchdog_ns:
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._tell("STOPPING=1")

    def close(self) -> None:
        """Close the line. Safe to call twice."""
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _tell(self, words: str) -> None:
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendto(words.encode(), self._address)
