"""Sun sensing: passes the readings of the solar strings to the body, and monitors the strings."""

from __future__ import annotations

from collections.abc import Callable

from flight.loop.fdir import facts
from flight.loop.services import Services
from hal.interfaces.devices import SolarStrings
from hal.interfaces.readings import StringReading


class SunSensing:
    """Owns the strings."""

    def __init__(
        self,
        strings: SolarStrings,
        accept: Callable[[StringReading], str | None],
        max_age_ns: int,
        services: Services,
    ) -> None:
        """`accept` is that of `flight.loop.body.Body.sun`; a reading older than `max_age_ns` is not used."""
        self._strings = strings
        self._accept = accept
        self._max_age_ns = max_age_ns
        self._facts = services.facts
        self._read_ns = 0

    def begin(self, time_ns: int) -> None:
        """Measure the age of the newest reading from `time_ns` on."""
        self._read_ns = time_ns

    def run(self, now_ns: int) -> None:
        """Accept the newest reading, once."""
        reading = self._strings.latest()
        if reading is not None and reading.time_ns > self._read_ns:
            self._read_ns = reading.time_ns
            if now_ns - reading.time_ns <= self._max_age_ns:
                wrong = self._accept(reading)
                if wrong is not None:
                    self._facts.update(facts.SUN_UNCLEAR, bool(wrong), now_ns, wrong or "the Sun is seen")
        age_ns = now_ns - self._read_ns
        lost = age_ns > self._max_age_ns
        text = self._strings.error() or f"no reading for {age_ns * 1e-9:.0f} s"
        self._facts.update(facts.STRINGS_LOST, lost, now_ns, text if lost else "readings come again")
