"""Protocols of the processes that watch the control loop: coil guardian and service manager."""

from __future__ import annotations

from enum import Enum
from typing import Protocol


class GuardianNews(Enum):
    """Events of the guardian; the values are texts for the event log."""

    LOST = "it has died or hangs: another is started"
    READY = "it is on watch"
    ACTED = "no heartbeat for 0.3 s: the coils were held at zero"
    FAILED = "it cannot reach the coils' PWM chip"


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
