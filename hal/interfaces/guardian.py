"""Protocols and messages of the processes that watch the control loop: coil guardian and service manager.

Flight process and guardian exchange single bytes on a socket pair.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Protocol

BEAT = b"."
"""Flight: a control cycle succeeded."""

BYE = b"q"
"""Flight: the coils are off and the flight is over."""

READY = b"r"
"""Guardian: the bus is open and the coils are zeroed."""

ACTED = b"z"
"""Guardian: the heartbeat stopped, the coils are zeroed."""

FAILED = b"x"
"""Guardian: the coils could not be zeroed; it keeps trying."""


NOTE = "coils"
"""Name of the file that records bus and address of the coils."""


@dataclass(frozen=True, slots=True)
class CoilReach:
    """How a process without numpy accesses the coils' PWM chip.

    `opener` names the function that opens the bus as `module:function`, `where` is its argument.
    """

    opener: str
    where: str
    address: int

    def note(self, folder: Path) -> None:
        """Write bus and address durably to a file in a folder, for `deploy/coils-off`. Never raises."""
        beside = folder / f"{NOTE}.part"
        with contextlib.suppress(OSError):
            with beside.open("wb") as note:
                note.write(f"{self.where} 0x{self.address:02x}\n".encode())
                note.flush()
                os.fsync(note.fileno())
            beside.replace(folder / NOTE)
            names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(names)
            finally:
                os.close(names)


class GuardianNews(Enum):
    """Events of the guardian; the values are texts for the event log."""

    LOST = "the guardian died or hangs; another one is started"
    READY = "the guardian watches the heartbeats"
    ACTED = "no heartbeat for 0.3 s: the coils were held at zero"
    FAILED = "the guardian cannot reach the coils' PWM chip"


class CoilGuardian(Protocol):
    """A running guardian: zeroes the coils when heartbeats stop."""

    def beat(self) -> None:
        """Report that a control cycle succeeded. Never waits, never raises."""

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a lost guardian; return what happened since the last call."""


class Overseer(Protocol):
    """The service manager, as far as the flight uses it."""

    def ready(self, status: str) -> None:
        """Report that the start is complete; repeated by `feed_watchdog` until it is delivered."""

    def feed_watchdog(self) -> None:
        """Report that every task makes progress."""
