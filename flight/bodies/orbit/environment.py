"""The estimated orbit environment: position, magnetic field, Sun direction and sunlight at any time.

The position is propagated from the newest GPS fix, or from two-line elements before the first fix. The
environment is predicted for about 20 s at once, which takes 2 ms, and then interpolated. Predictions for a
whole revolution belong in a worker, because they take 0.3 ms for each 10 s. The class `StuckFieldCheck`
detects a magnetometer that repeats the same field.
"""

from __future__ import annotations

import math

import numpy as np

from hal.interfaces.devices import GpsReading
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures, pressures
from knightcube.astro.earth.ephemeris import STEP, Ephemeris, predict
from knightcube.astro.earth.geomagnetism import extrapolation_sigma
from knightcube.astro.earth.orbit_knowledge import (
    LOWEST_RADIUS,
    GpsFix,
    OrbitError,
    OrbitState,
    TwoLineElements,
)
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH, earth_velocity
from knightcube.gnc.estimation.free_filter import FilterEnvironment

AHEAD, BEHIND = 2.0 * STEP, STEP
"""Time spans (s) after and before the requested time that the short prediction covers."""
GPS_DELAY_NS = 100_000_000
"""Delay (ns) from the time of a GPS fix to the first byte of the receiver's report; at most 0.2 s."""
GATE, LEAST_GATE = 5.0, 5e3
"""Largest accepted deviation of a GPS fix from the known orbit in standard deviations, and deviation (m) that
is always accepted.
"""
CONTRADICTED = 30
"""Number of rejected GPS fixes in a row after which the last accepted fix is considered wrong."""
TIME_GATE_NS = SECOND_NS // 2
"""Largest accepted step (ns) of the receiver's time relative to the host's clock."""
UNKNOWN_SIGMA, UNKNOWN_VELOCITY_SIGMA = 100.0, 1.0
"""Standard deviations of position (m) and velocity (m/s) per axis if the receiver does not know them."""
_SHORTEST = 1.0


class EstimatedEnvironment:
    """Knowledge of the orbit. The attribute `refused` counts the GPS fixes that contradict the orbit."""

    def __init__(self, elements: TwoLineElements | None, clock: Clock) -> None:
        """`elements` are the two-line elements; without them the orbit is unknown until the first fix."""
        self._elements = elements
        self._clock = clock
        self._fix: GpsFix | None = None
        self._utc_offset_ns: int | None = None
        self._newest_offset_ns: int | None = None  # time offset (ns) of the newest GPS fix, even if rejected
        self._near: Ephemeris | None = None
        self._refused_in_a_row = 0
        self.refused = 0

    @property
    def known(self) -> bool:
        """Whether the orbit was known at the last request."""
        return self._near is not None

    def julian_date(self, now_ns: int) -> float:
        """Return the Julian date (UTC) at a time of the host's clock.

        The date is that of the GPS receiver, or before the first fix that of the host's clock.
        """
        offset_ns = self._utc_offset_ns
        if offset_ns is None:
            offset_ns = self._clock.utc_ns() - self._clock.now_ns()
        return UNIX_EPOCH + (now_ns + offset_ns) / (DAY * SECOND_NS)

    def fix(self, reading: GpsReading) -> bool:
        """Accept a report of the GPS receiver, and return whether it is used."""
        if not reading.valid:
            return False
        date = UNIX_EPOCH + reading.utc_ns / (DAY * SECOND_NS)
        offset_ns = reading.utc_ns + GPS_DELAY_NS - reading.time_ns
        try:
            sigma = UNKNOWN_SIGMA if math.isnan(reading.sigma) else reading.sigma
            speed_sigma = reading.velocity_sigma
            speed_sigma = UNKNOWN_VELOCITY_SIGMA if math.isnan(speed_sigma) else speed_sigma
            fix = GpsFix(date, reading.position, reading.velocity, sigma, speed_sigma)
            contradicts = self._is_out_of_time(offset_ns) or self._contradicts(fix)
        except OrbitError:
            contradicts = True
        if contradicts:
            self.refused += 1
            self._refused_in_a_row += 1
            return False
        self._refused_in_a_row = 0
        self._fix = fix
        self._utc_offset_ns = offset_ns
        return True

    def state(self, now_ns: int) -> OrbitState | None:
        """Return position and velocity (ICRS), or None while the orbit is unknown."""
        return self._state(self.julian_date(now_ns))

    def at(self, now_ns: int) -> FilterEnvironment | None:
        """Return field, position, pressures and sunlight, or None while the orbit is unknown."""
        near, times = self._prediction(now_ns)
        if near is None:
            return None
        shape = pressures(near, times)
        return FilterEnvironment(
            near.field_at(times)[0],
            near.position_at(times)[0],
            Pressures(shape.air, shape.light),
            float(near.sunlit_at(times)[0]),
            self.field_sigma(now_ns),
        )

    def field_sigma(self, now_ns: int) -> float:
        """Return the standard deviation (T per axis) that a field model past its validity adds, usually 0."""
        return extrapolation_sigma(self.julian_date(now_ns))

    def sun(self, now_ns: int) -> FloatArray | None:
        """Return the Sun direction (3,), ICRS, without aberration (21"), or None for an unknown orbit."""
        near, times = self._prediction(now_ns)
        return None if near is None else np.asarray(near.sun_at(times)[0])

    def velocity(self, now_ns: int) -> FloatArray | None:
        """Return the velocity (3,), m/s, relative to the Sun (ICRS), or None while the orbit is unknown."""
        near, times = self._prediction(now_ns)
        if near is None:
            return None
        date = float(terrestrial_time(self.julian_date(now_ns)))
        return np.asarray(earth_velocity(date) + near.velocity_at(times)[0])

    def _seconds_into(self, ephemeris: Ephemeris, now_ns: int) -> float:
        """Return the time (s) from the start of `ephemeris` to a time of the host's clock."""
        return (self.julian_date(now_ns) - ephemeris.julian_date) * DAY

    def _state(self, date: float) -> OrbitState | None:
        for source in (self._fix, self._elements):
            if source is not None:
                try:
                    return source.at(date)
                except OrbitError:
                    continue
        return None

    def _prediction(self, now_ns: int) -> tuple[Ephemeris | None, FloatArray]:
        """Return the short prediction, renewed if needed, and the time (1,), s, since its start."""
        near = self._near
        seconds = math.inf if near is None else self._seconds_into(near, now_ns)
        if near is None or not 0.0 <= seconds <= float(near.times[-1]) - _SHORTEST:
            state = self._state(self.julian_date(now_ns) - BEHIND / DAY)
            near = None if state is None else predict(state, BEHIND + AHEAD)
            self._near = near
            seconds = BEHIND if near is None else self._seconds_into(near, now_ns)
        return near, np.array([seconds])

    def _is_out_of_time(self, offset_ns: int) -> bool:
        """Return whether the receiver's time has stopped or jumped; a lasting jump is accepted later."""
        last_offset_ns, self._newest_offset_ns = self._newest_offset_ns, offset_ns
        if last_offset_ns is not None and abs(offset_ns - last_offset_ns) > TIME_GATE_NS:
            return True
        known = self._utc_offset_ns
        jumped = known is not None and abs(offset_ns - known) > TIME_GATE_NS
        return jumped and self._refused_in_a_row < CONTRADICTED

    def _contradicts(self, fix: GpsFix) -> bool:
        """Return whether a GPS fix is impossible, or contradicts the two-line elements or the last fix.

        A lasting contradiction of the last fix is accepted later.
        """
        found = fix.at(fix.julian_date)
        if not found.perigee_radius >= LOWEST_RADIUS:
            return True
        last = None if self._refused_in_a_row >= CONTRADICTED else self._fix
        for known in (self._elements, last):
            if known is None:
                continue
            try:
                expected = known.at(fix.julian_date)
            except OrbitError:
                continue
            off = float(np.linalg.norm(found.position - expected.position))
            if off > max(LEAST_GATE, GATE * math.sqrt(3.0) * math.hypot(expected.sigma, found.sigma)):
                return True
        return False


STUCK, FIELDS_CONTRADICTED = 20, 4
"""Number of equal magnetic fields in a row, and of contradicting fields in a row, that indicate a fault."""


class StuckFieldCheck:
    """Detects a magnetometer that repeats the same field."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._same = 0

    @property
    def stuck(self) -> bool:
        """Whether the magnetometer has repeated the same field in `STUCK` readings."""
        return self._same >= STUCK

    def accept(self, field: FloatArray) -> bool:
        """Accept the field (3,) of a reading, and return whether the magnetometer is working, not stuck."""
        values = field.tolist()
        self._same, self._last = (self._same + 1 if values == self._last else 0), values
        return not self.stuck

    def text(self, refused: int) -> str:
        """Return why the magnetometer is rejected, or an empty text.

        The number `refused` counts the magnetic fields in a row that contradict the estimate.
        """
        if self.stuck:
            return "the magnetometer gives the same field in every reading"
        return f"{refused} fields in a row contradict the estimate" if refused >= FIELDS_CONTRADICTED else ""
