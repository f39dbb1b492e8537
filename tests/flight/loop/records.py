"""Event records for several tests of the loop."""

from __future__ import annotations

from flight.loop.facts import EventLog, Facts


class EventRecord:
    """A sink that records events."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.log = EventLog(lambda kind, *_: self.names.append(kind.name), throttle_ns=0)
        self.facts = Facts(self.log)
