"""Positioning: passes the fixes of the GPS receiver to the body, and monitors the receiver."""

from __future__ import annotations

from collections.abc import Callable

from flight.link import events
from flight.loop.fdir import facts
from flight.loop.services import Services
from hal.interfaces.devices import GpsReceiver
from hal.interfaces.errors import DeviceError
from hal.interfaces.readings import GpsReading
from hal.interfaces.wires import SECOND_NS

CLOCK_OFF_NS = SECOND_NS
"""By which the wall clock may differ from the receiver's time."""


class Positioning:
    """Owns the receiver."""

    def __init__(
        self,
        receiver: GpsReceiver,
        accept: Callable[[GpsReading], bool],
        max_age_ns: int,
        services: Services,
    ) -> None:
        """`accept` returns whether the body uses a fix; without one for `max_age_ns` the receiver is lost."""
        self._receiver = receiver
        self._accept = accept
        self._max_age_ns = max_age_ns
        self._events = services.events
        self._facts = services.facts
        self._streams = services.streams
        self._clock = services.clock
        self._fixed_ns = 0

    def begin(self, time_ns: int) -> None:
        """Measure the age of the newest fix from `time_ns` on."""
        self._fixed_ns = time_ns

    def run(self, now_ns: int) -> None:
        """Accept the fixes since the last call."""
        error = ""
        try:
            readings = self._receiver.poll()
        except DeviceError as lost:
            readings, error = [], str(lost)
        for reading in readings:
            if not reading.valid:
                continue
            self._streams.note("gps", reading.time_ns)
            if self._accept(reading):
                self._fixed_ns = reading.time_ns
                self._compare_clock(reading, now_ns)
            else:
                self._events.report(events.GPS_REFUSED, now_ns, f"{reading.satellites} satellites")
        age_ns = now_ns - self._fixed_ns
        text = error or f"no fix of use for {age_ns * 1e-9:.0f} s"
        lost_now = bool(error) or age_ns > self._max_age_ns
        self._facts.update(facts.GPS_LOST, lost_now, now_ns, text if lost_now else "fixes come again")

    def _compare_clock(self, reading: GpsReading, now_ns: int) -> None:
        """Report a wall clock that is wrong: before the first fix the place was found by it."""
        clock = self._clock
        off_ns = clock.utc_ns() - (clock.now_ns() - reading.time_ns) - reading.utc_ns
        text = f"the wall clock is {off_ns * 1e-9:+.1f} s off the receiver's time"
        self._facts.update(facts.CLOCK_OFF, abs(off_ns) > CLOCK_OFF_NS, now_ns, text)
