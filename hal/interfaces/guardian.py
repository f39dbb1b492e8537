"""Protocols and messages of the processes that monitor the control loop: coil guardian, service manager.

The flight process and the guardian exchange messages of one byte over a socket pair.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Protocol

BEAT = b"."
"""Message from the flight process: a control cycle succeeded (heartbeat)."""

BYE = b"q"
"""Message from the flight process: the flight has ended and the coils are off (goodbye)."""

READY = b"r"
"""Message from the guardian: the bus is open and the coils are at zero."""

ACTED = b"z"
"""Message from the guardian: the heartbeats stopped and the coils were set to zero."""

FAILED = b"x"
"""Message from the guardian: the coils could not be set to zero, and the guardian keeps trying."""


NOTE = "coils"
"""Name of the file that states the I2C bus of the coils' chips and the writes that switch the coils off."""


@dataclass(frozen=True, slots=True)
class CoilReach:
    """Access to the coils' chips for a process without numpy.

    Attributes:
        opener: function that opens the bus, written as `module:function`.
        where: argument of the function `opener`, such as a device file.
        writes: I2C writes (address, register, value) that switch all coils off in any state of the chips.
    """

    opener: str
    where: str
    writes: tuple[tuple[int, int, int], ...]

    @property
    def words(self) -> list[str]:
        """Addresses, registers and values of the writes as hexadecimal words."""
        return [f"0x{number:02x}" for write in self.writes for number in write]

    def note(self, folder: Path) -> None:
        """Store the attributes `where` and `writes` in `folder` for the script `deploy/coils-off`.

        The file is synced to the disk, and ends with the SHA-256 of its text. This method never raises.
        """
        import hashlib  # noqa: PLC0415 - the guardian, which imports this module, needs no checksum

        text = " ".join((self.where, *self.words)).encode()
        beside = folder / f"{NOTE}.part"
        with contextlib.suppress(OSError):
            with beside.open("wb") as note:
                note.write(text + f" {hashlib.sha256(text).hexdigest()}\n".encode())
                note.flush()
                os.fsync(note.fileno())
            beside.replace(folder / NOTE)
            names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(names)
            finally:
                os.close(names)


class GuardianNews(Enum):
    """Events of the guardian. The enumeration values are texts for the event log."""

    LOST = "the guardian died or hangs; another one is started"
    READY = "the guardian watches the heartbeats"
    ACTED = "no heartbeat for 0.3 s: the coils were held at zero"
    FAILED = "the guardian cannot reach the coils' PWM chip"


class CoilGuardian(Protocol):
    """Running guardian process, which sets the coils to zero when the heartbeats stop."""

    def beat(self) -> None:
        """Send a heartbeat after a successful control cycle, without blocking or raising errors."""

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a lost guardian and return the events since the last call."""


class Overseer(Protocol):
    """Service manager of the operating system, such as systemd."""

    def ready(self, status: str) -> None:
        """Report that the start is complete. The method `feed_watchdog` repeats the report until delivery."""

    def feed_watchdog(self) -> None:
        """Report that all tasks make progress."""
