"""Advances the world and the emulated devices together, event by event."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sim_hal.emulators.device import NEVER, EmulatedDevice


class TimedSimulation:
    """Advances the world to each device's next event, then runs that device."""

    def __init__(self, advance_world: Callable[[int], None], devices: Sequence[EmulatedDevice]) -> None:
        self._advance_world = advance_world
        self._devices = tuple(devices)

    def next_event_ns(self) -> int:
        """Return the time of the next event of any device."""
        return min([device.next_event_ns() for device in self._devices], default=NEVER)

    def run_events(self, event_ns: int) -> None:
        """Advance to the next event, and run the devices that are due then."""
        self._advance_world(event_ns)
        for device in self._devices:
            if device.next_event_ns() <= event_ns:
                device.advance(event_ns)

    def advance_to(self, time_ns: int) -> None:
        """Process all events due at or before `time_ns`, in order."""
        while (event_ns := self.next_event_ns()) <= time_ns:
            self.run_events(event_ns)
        self._advance_world(time_ns)
