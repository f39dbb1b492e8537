"""The Protocol of what stands behind the control loop and zeroes the coils when that falls silent."""

from __future__ import annotations

from enum import Enum
from typing import Protocol


class GuardianNews(Enum):
    """What became of the guardian, or what it had to do."""

    LOST = "it has died or hangs: another is started"
    READY = "it is on watch"
    ACTED = "no heartbeat for 0.3 s: the coils were held at zero"
    FAILED = "it cannot reach the coils' PWM chip"


class CoilGuardian(Protocol):
    """A guardian on watch."""

    def beat(self) -> None:
        """Tell that a control cycle ran well. Never waits, never raises."""

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a guardian that is lost; return what has happened since the last call."""


class Overseer(Protocol):
    """The service manager, as far as the flight speaks to it."""

    def ready(self, status: str) -> None:
        """Say that the start is over."""

    def feed_watchdog(self) -> None:
        """Say that everything makes progress."""
