"""Notifies systemd over its socket (sd_notify(3)): ready, alive, stopping.

Without a service manager - no NOTIFY_SOCKET in the environment - notifications are dropped, as are those that
cannot be delivered: a notification must never delay or end a flight. Only READY is repeated until it is
delivered: without it the service manager ends the process.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Mapping


class ServiceManager:
    """The service manager that started this process, if one did."""

    def __init__(self, environment: Mapping[str, str], process_id: int) -> None:
        """Read the socket and watchdog from `environment`; WATCHDOG_PID must be `process_id` if given."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._line: socket.socket | None = None
        self._undelivered_ready = ""
        if self._address:
            self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._line.setblocking(False)
        meant = environment.get("WATCHDOG_PID", str(process_id)) == str(process_id)
        period = environment.get("WATCHDOG_USEC", "")
        self.watchdog_ns = int(period) * 1000 if meant and period.isdecimal() else 0
        """The watchdog's time-out; 0 without a watchdog."""

    def ready(self, status: str) -> None:
        """Report that the start is complete; repeated with the watchdog until it is delivered."""
        self._undelivered_ready = f"READY=1\nSTATUS={status}"
        self._repeat_ready()

    def status(self, status: str) -> None:
        """Report a status line for people."""
        self._notify(f"STATUS={status}")

    def feed_watchdog(self) -> None:
        """Report that every task makes progress."""
        self._repeat_ready()
        if self.watchdog_ns:
            self._notify("WATCHDOG=1")

    def extend_start(self, seconds: float) -> None:
        """Ask for more time before the start counts as failed."""
        self._notify(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._undelivered_ready = ""
        self._notify("STOPPING=1")

    def close(self) -> None:
        """Close the line. Safe to call twice."""
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _repeat_ready(self) -> None:
        if self._undelivered_ready and self._notify(self._undelivered_ready):
            self._undelivered_ready = ""

    def _notify(self, message: str) -> bool:
        """Send a notification; return whether it was delivered."""
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendto(message.encode(), self._address)
                return True
        return False
