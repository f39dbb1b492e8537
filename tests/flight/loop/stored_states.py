"""Stored states for several tests and processes."""

from __future__ import annotations

import numpy as np

from flight.link.events import EventKind
from flight.loop.state import Learned, StoredState, UncleanShutdown


def state_of(number: int) -> StoredState:
    """Return a state with a value in each field."""
    learned = Learned.of(np.array([1e-4, -2e-4, number * 1e-5]), np.diag([1e-8, 1e-8, 2e-8]))
    crash = UncleanShutdown(number, 10.0 * number, "2026-01-01T00:00:00Z")
    return StoredState(
        boot_count=number,
        operated=12.5 * number,
        running=True,
        unclean=(crash,),
        mode="hold",
        utc="1970-01-01T00:00:07Z",
        learned={"gyro-bias": learned},
    )


class Reports:
    """A sink that collects events."""

    def __init__(self) -> None:
        self.kinds: list[EventKind] = []
        self.texts: list[str] = []

    def __call__(self, kind: EventKind, text: str) -> None:
        self.kinds.append(kind)
        self.texts.append(text)
