"""The estimated orbit environment: position, magnetic field, Sun direction and sunlight at any time.

The position is propagated from the newest GPS fix, or from two-line elements before the first fix. The
environment is predicted for about 20 s at once, which takes 2 ms, and then interpolated. Predictions for a
whole revolution belong in a worker process, because they take 0.3 ms of computing time per 10 s of orbit. The
class `StuckFieldCheck` detects a magnetometer that repeats the same field.

A GPS fix that contradicts the elements or the previous fixes is refused. If refused fixes are consistent with
one orbit for `CONFIRMED` seconds, this orbit replaces the orbit known before, unless the magnetometer or the
Sun contradicts the new orbit. Fixes that agree with inaccurate elements are used only after `CONFIRMED`
seconds. Fixes that agree with accurate elements are used at once, but their stated accuracy is trusted only
after `CONFIRMED` seconds. Spoofed GPS signals cannot be detected if they consistently simulate a possible
orbit.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from flight.loop.navigation import GPS_DELAY_NS
from hal.interfaces.devices import GpsReading
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures, pressures
from knightcube.astro.earth.ephemeris import STEP, Ephemeris, predict
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.geomagnetism import extrapolation_sigma, field
from knightcube.astro.earth.orbit_knowledge import GpsFix, OrbitError, OrbitState, TwoLineElements
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH, earth_from_sun, earth_velocity, sunlit_share
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.free_filter import FilterEnvironment

AHEAD, BEHIND = 2.0 * STEP, STEP
"""Times (s) by which the short prediction extends after and before the requested time."""
GATE, ELEMENTS_GATE = 5.0 * math.sqrt(3.0), 4.0
"""Gates (standard deviations) for a GPS fix: the first for the distance from earlier fixes, the second for
the distance from the elements."""
LEAST_GATE, FIX_GATE = 5e3, 500.0
"""Position errors (m) up to which a GPS fix is always accepted: the first relative to the elements, the
second relative to earlier fixes."""
SPEED_GATE, ORBITAL_RATE = 20.0, 1.2e-3
"""Deviation (m/s) up to which a fix's velocity is always accepted, and orbital rate (rad/s) of the lowest
orbit."""
CONFIRMED = 420.0
"""Time (s) over which refused fixes must be consistent with one orbit to replace the orbit known before."""
_LEAST_FIXES, _SEQUENCES, _LONGEST_GAP = 5, 4, 200.0
"""`_LEAST_FIXES` is the minimum number of fixes that replace the orbit known before. `_SEQUENCES` is the
maximum number of fix sequences, each of which is a candidate orbit. `_LONGEST_GAP` is the longest time (s)
between two fixes of one sequence."""
FIRST_FIXES, TIGHT = 3, 1e4
"""Number of consistent fixes that start an orbit if there are no elements, and largest standard deviation (m)
of elements with which a single fix starts an orbit."""
UNCONFIRMED_SIGMA = 1e6
"""Standard deviation (m) of a position that follows from a few fixes if there are no elements."""
EXACT, STEEPEST = 3e3, 3.0
"""`EXACT` is a position error (m) that changes the magnetic field by less than the error of the field model.
`STEEPEST` is the largest ratio between a relative change of the field and the relative change of the radius.
"""
LOWEST_ORBIT = 1.01 * EARTH_RADIUS
"""Minimum radius (m) of a satellite's position and perigee."""
EARLIEST = 2.0
"""Longest time (days) by which orbital elements may be published before their epoch."""
TIME_GATE_NS, CLOCK_DRIFT = SECOND_NS // 2, 1e-4
"""Largest accepted step (ns) of the receiver's time relative to the host's clock, and largest drift (s/s) of
the host's clock."""
UNKNOWN_SIGMA, UNKNOWN_VELOCITY_SIGMA = 100.0, 1.0
"""Standard deviations of position (m) and velocity (m/s) per axis if the receiver does not state them."""
WITNESS_GATE, LATEST_WITNESS_NS = 4.0, 20 * SECOND_NS
"""`WITNESS_GATE` is the RMS deviation of the measured field strength from an orbit's prediction, in standard
deviations, above which the field contradicts the orbit. `LATEST_WITNESS_NS` is the largest age (ns) at which
a measurement is compared with an orbit."""
_SHORTEST = 1.0


@dataclass(frozen=True, slots=True)
class Witness:
    """Measurements of other sensors at the time of a GPS fix.

    Attributes:
        field: strength of the magnetic field, T, or None if unknown.
        field_sigma: standard deviation of the field strength, T.
        sunlit: whether the solar cells measure the Sun; false does not prove that the satellite is in shadow.
    """

    field: float | None = None
    field_sigma: float = 0.0
    sunlit: bool = False


class FixSequence:
    """GPS fixes with consistent orbit and time; `joined` counts the fixes that agree with `first`."""

    def __init__(self, fix: GpsFix, offset_ns: int) -> None:
        """`offset_ns` is the receiver's UTC minus the time of the host's clock."""
        self.first = self._newest = fix
        self.joined = 1
        self._offset_ns = offset_ns
        self._offered = 1
        self._strength = np.zeros(3)  # sums of squared field errors of two orbits; number of readings
        self._is_refuted = False
        self._shadowed = np.zeros(2)  # number of sunlit fixes at which each orbit predicts shadow

    @property
    def confirmed(self) -> bool:
        """Whether the fixes have agreed for long enough to replace the orbit known before."""
        span = (self._newest.julian_date - self.first.julian_date) * DAY
        return span >= CONFIRMED and self.joined >= max(_LEAST_FIXES, self._offered // 2)

    @property
    def is_disputed(self) -> bool:
        """Whether any later fix disagrees with the first fix."""
        return self._offered > self.joined

    @property
    def refuted(self) -> bool:
        """Whether field or Sun contradict the orbit of the fixes, but agree with the orbit known before."""
        here, known, number = self._strength.tolist()
        by_field = here > WITNESS_GATE**2 * number > known
        half = 0.5 * self.joined
        self._is_refuted |= bool(by_field or self._shadowed[0] > half > self._shadowed[1])
        return self._is_refuted

    def is_over(self, fix: GpsFix) -> bool:
        """Return whether a sequence has ended because a new fix comes too late or most fixes disagree."""
        gap = abs(fix.julian_date - self._newest.julian_date) * DAY
        return gap > _LONGEST_GAP or self._offered > 2 * (self.joined + _LEAST_FIXES)

    def accept(self, fix: GpsFix, offset_ns: int) -> bool:
        """Return whether a fix agrees with the first fix."""
        self._offered += 1
        if abs(offset_ns - self._offset_ns) > TIME_GATE_NS or not _agree(self.first, fix, FIX_GATE):
            return False
        self.joined += 1
        self._newest = fix
        return True

    def compare(self, witness: Witness, here: OrbitState, known: OrbitState) -> None:
        """Compare the measured field and Sun with predictions for the newest fix and for the known orbit."""
        states = here, known
        if witness.field is not None:
            strengths = [float(np.linalg.norm(field(here.julian_date, one.position))) for one in states]
            self._strength[:2] += ((witness.field - np.array(strengths)) / witness.field_sigma) ** 2
            self._strength[2] += 1.0
        if witness.sunlit:
            date = float(terrestrial_time(here.julian_date))
            sun = -earth_from_sun(date)[0]
            lit = sunlit_share(np.array([one.position for one in states]), np.array([sun, sun]))
            self._shadowed += lit < _DARK


_DARK = 0.01
"""Visible fraction of the solar disc below which the solar cells cannot detect the Sun."""


def _agree(known: GpsFix | TwoLineElements, fix: GpsFix, least: float) -> bool:
    """Return whether a fix agrees with a known orbit; position errors up to `least` (m) are always accepted.

    Every fix is accepted if the elements cannot be propagated to the time of the fix.
    """
    found = fix.at(fix.julian_date)
    try:
        expected = known.at(fix.julian_date)
    except OrbitError:
        return isinstance(known, TwoLineElements)
    gate = ELEMENTS_GATE if isinstance(known, TwoLineElements) else GATE
    sigma = gate * math.hypot(expected.sigma, found.sigma)
    speed = math.hypot(GATE * fix.velocity_sigma, ORBITAL_RATE * max(sigma, least))
    off, fast = found.position - expected.position, found.velocity - expected.velocity
    return bool(np.linalg.norm(off) <= max(least, sigma) and np.linalg.norm(fast) <= max(SPEED_GATE, speed))


class EstimatedEnvironment:
    """Estimate of the orbit, and of field and sunlight along the orbit.

    The number `refused` of GPS fixes does not include fixes that are kept to begin an orbit. The text
    `refusal` states why the last fix was refused; it is empty if the fix was used or kept.
    """

    def __init__(self, elements: TwoLineElements | None, clock: Clock) -> None:
        """`elements` are two-line elements; if they are None, the orbit is unknown until the first fixes."""
        self._elements = elements
        self._enlarged = 1.0  # factor of the elements' standard deviation: above 1 after a contradiction
        self._clock = clock
        self._fix: GpsFix | None = None
        self._is_confirmed = False  # whether the newest fix belongs to a confirmed orbit
        self._is_doubted = False  # whether an orbit from few fixes could not be confirmed
        self._start: FixSequence | None = None  # fixes since the start of an unconfirmed orbit
        self._sequences: list[FixSequence] = []
        self._utc_offset_ns: int | None = None
        self._fixed_ns = 0
        self._near: Ephemeris | None = None
        self._near_sigma = 0.0
        # Predicted magnetic field, air and solar radiation pressures, and visible fraction of the Sun.
        self._near_table: FloatArray = np.zeros((0, 10))
        self.refused = 0
        self.refusal = ""

    @property
    def known(self) -> bool:
        """Whether the orbit was known at the last request."""
        return self._near is not None

    @property
    def is_timed(self) -> bool:
        """Whether the time comes from a GPS receiver."""
        return self._utc_offset_ns is not None

    @property
    def clock_doubt(self) -> str:
        """The reason why the host's clock is considered wrong, or an empty text.

        The clock is wrong if it precedes the epoch of the elements by more than `EARLIEST` days.
        """
        if self._utc_offset_ns is not None or self._elements is None:
            return ""
        early = self._elements.epoch - UNIX_EPOCH - self._clock.utc_ns() / (DAY * SECOND_NS)
        if early <= EARLIEST:
            return ""
        return f"the wall clock is {early:.1f} days before the epoch of the elements: the orbit is unknown"

    def julian_date(self, now_ns: int) -> float:
        """Return the Julian date (UTC) at a time, by GPS or, before a GPS fix, by the host's clock."""
        offset_ns = self._utc_offset_ns
        if offset_ns is None:
            offset_ns = self._clock.utc_ns() - self._clock.now_ns()
        return UNIX_EPOCH + (now_ns + offset_ns) / (DAY * SECOND_NS)

    def fix(self, reading: GpsReading, witness: Witness | None = None) -> bool:
        """Use a GPS fix unless it is implausible or `witness` contradicts it; return whether it is used."""
        self.refusal = ""
        if not reading.valid:
            return False
        date = UNIX_EPOCH + reading.utc_ns / (DAY * SECOND_NS)
        sigma = UNKNOWN_SIGMA if math.isnan(reading.sigma) else reading.sigma
        speed_sigma = reading.velocity_sigma
        speed_sigma = UNKNOWN_VELOCITY_SIGMA if math.isnan(speed_sigma) else speed_sigma
        try:
            fix = GpsFix(date, reading.position, reading.velocity, sigma, speed_sigma)
            self.refusal = self._impossibility(fix)
            used = not self.refusal and self._judge(fix, reading, witness or Witness())
        except (OrbitError, ArgumentError) as error:
            used, self.refusal = False, str(error)
        self.refused += bool(self.refusal)
        return used

    def state(self, now_ns: int) -> OrbitState | None:
        """Return position and velocity (ICRS), or None while the orbit is unknown."""
        return self._state(self.julian_date(now_ns))

    def at(self, now_ns: int) -> FilterEnvironment | None:
        """Return field, position, pressures and sunlight, or None while the orbit is unknown.

        The pressures are interpolated linearly over `STEP`, in which their directions rotate by 0.01 rad. The
        interpolated pressures are too small by at most 2e-5 of their values.
        """
        near, times = self._prediction(now_ns)
        if near is None:
            return None
        values = near.interpolated(self._near_table, times)
        return FilterEnvironment(
            values[0, 0:3],
            near.position_at(times)[0],
            Pressures(values[:, 3:6], values[:, 6:9]),
            float(values[0, 9]),
            math.hypot(self.field_sigma(now_ns), self._displaced_field(near)),
        )

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the magnetic field (3,), T, ICRS, or None while the orbit is unknown."""
        near, times = self._prediction(now_ns)
        return None if near is None else np.asarray(near.field_at(times)[0])

    def field_sigma(self, now_ns: int) -> float:
        """Return the error (T per axis, one sigma) of a field model that is used past its validity, or 0."""
        return extrapolation_sigma(self.julian_date(now_ns))

    def _displaced_field(self, near: Ephemeris) -> float:
        """Return the field error (T per axis, one sigma) due to the position error of old elements."""
        strength = float(np.linalg.norm(near.field[0]))
        if self._near_sigma <= EXACT:
            return 0.0
        return strength * min(1.0, STEEPEST * self._near_sigma / float(np.linalg.norm(near.position[0])))

    def sun(self, now_ns: int) -> FloatArray | None:
        """Return the Sun direction (3,), ICRS, without aberration (21 arcsec); None for an unknown orbit."""
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
        """Return the orbit state from a recent fix or else from the elements; None if neither is usable."""
        fix = self._recent(date)
        if fix is not None:
            state = fix.at(date)
            return state if self._is_confirmed else self._unconfirmed(state)
        if self._elements is not None and not self.clock_doubt:
            with suppress(OrbitError):
                state = self._elements.at(date)
                return replace(state, sigma=self._enlarged * state.sigma)
        return None

    def _unconfirmed(self, state: OrbitState) -> OrbitState:
        """Return `state`, which follows from only a few fixes, with an increased standard deviation.

        The increased standard deviation includes the distance between the state and the position predicted by
        the elements.
        """
        sigma = UNCONFIRMED_SIGMA
        if self._elements is not None:
            with suppress(OrbitError):
                expected = self._elements.at(state.julian_date)
                off = float(np.linalg.norm(state.position - expected.position))
                sigma = math.hypot(off, self._enlarged * expected.sigma)
        return replace(state, sigma=math.hypot(sigma, state.sigma))

    def _recent(self, date: float) -> GpsFix | None:
        """Return the newest used fix, or None if it is too old.

        The age limit is shorter for an unconfirmed orbit.
        """
        fix = self._fix
        if fix is None:
            return None
        limit = fix.longest_age if self._is_confirmed else CONFIRMED
        return fix if abs(date - fix.julian_date) * DAY <= limit else None

    def _prediction(self, now_ns: int) -> tuple[Ephemeris | None, FloatArray]:
        """Return the short prediction, a new one if needed, and the time (1,), s, since its start."""
        near = self._near
        seconds = math.inf if near is None else self._seconds_into(near, now_ns)
        if near is None or not 0.0 <= seconds <= float(near.times[-1]) - _SHORTEST:
            date = self.julian_date(now_ns) - BEHIND / DAY
            state = self._state(date)
            near = None if state is None else predict(state, BEHIND + AHEAD)
            self._near = near
            if near is not None:
                shape = pressures(near, near.times)
                self._near_table = np.column_stack([near.field, shape.air, shape.light, near.sunlit])
            self._near_sigma = 0.0 if state is None or self._recent(date) is not None else state.sigma
            seconds = BEHIND if near is None else self._seconds_into(near, now_ns)
        return near, np.array([seconds])

    def _impossibility(self, fix: GpsFix) -> str:
        """Return why a fix is physically impossible, or an empty text if the fix is possible."""
        perigee, radius = fix.at(fix.julian_date).perigee_radius, float(np.linalg.norm(fix.position))
        if not (perigee >= LOWEST_ORBIT and radius >= LOWEST_ORBIT):
            return f"not an orbit: radius {1e-3 * radius:.0f} km, perigee radius {1e-3 * perigee:.0f} km"
        early = 0.0 if self._elements is None else self._elements.epoch - fix.julian_date
        return f"the date is {early:.1f} days before the epoch of the elements" if early > EARLIEST else ""

    def _judge(self, fix: GpsFix, reading: GpsReading, witness: Witness) -> bool:
        """Use a fix that agrees with the known orbit or replaces it, and return whether the fix is used."""
        time_ns, offset_ns = reading.time_ns, reading.utc_ns + GPS_DELAY_NS - reading.time_ns
        last = self._recent(fix.julian_date)
        if last is None and self._fix is not None:
            disputed = self._start is not None and self._start.is_disputed
            self._is_doubted |= disputed and not self._is_confirmed
            self._fix, self._is_confirmed = None, False
        by_time = self._is_in_time(offset_ns, time_ns)
        by_fixes = by_time and (last is None or _agree(last, fix, FIX_GATE))
        by_elements = self._agrees_with_elements(fix)
        if self._is_confirmed and by_fixes and by_elements:
            self._sequences = []
            return self._use(fix, offset_ns, time_ns, confirmed=True)
        sequence = self._followed(fix, offset_ns)
        known = self._state(fix.julian_date)
        if known is not None:
            sequence.compare(witness, fix.at(fix.julian_date), known)
        if sequence.confirmed and not sequence.refuted and not self._has_false_time(fix, time_ns):
            self._enlarge(fix)
            self._sequences, self._is_doubted = [], False
            return self._use(fix, offset_ns, time_ns, confirmed=True)
        if by_fixes and by_elements and self._is_begun(sequence, last):
            return self._use(fix, offset_ns, time_ns, confirmed=False)
        causes = {
            "the time jumps relative to the time of earlier fixes": not by_time,
            "the fix contradicts the orbit of earlier fixes": not by_fixes,
            "the fix contradicts the orbit elements": not by_elements,
            "the magnetic field or the Sun contradicts the orbit of the fixes": sequence.refuted,
            "the newest fixes contradict one another": len(self._sequences) > 1,
        }
        self.refusal = next((cause for cause, is_true in causes.items() if is_true), "")
        return False

    def _is_begun(self, sequence: FixSequence, last: GpsFix | None) -> bool:
        """Return whether a fix sequence may start or continue an orbit estimate that is not yet confirmed."""
        first = FIRST_FIXES if self._elements is None else 1
        known = self._elements is None or self._is_tight(sequence.first.julian_date)
        if not known or self._is_doubted or sequence.refuted or sequence.joined < first:
            return False
        if last is None:
            self._start = sequence
        return sequence is self._start

    def _use(self, fix: GpsFix, offset_ns: int, time_ns: int, *, confirmed: bool) -> bool:
        self._fix, self._utc_offset_ns, self._fixed_ns = fix, offset_ns, time_ns
        self._is_confirmed = confirmed
        return True

    def _followed(self, fix: GpsFix, offset_ns: int) -> FixSequence:
        """Return the longest sequence that a fix continues, or a new sequence that begins with the fix."""
        continued = [one for one in self._sequences if one.accept(fix, offset_ns)]
        if continued:
            return max(continued, key=lambda one: one.joined)
        fresh = [one for one in self._sequences if not one.is_over(fix)]
        longest = sorted(fresh, key=lambda one: -one.joined)[: _SEQUENCES - 1]
        self._sequences = [*longest, FixSequence(fix, offset_ns)]
        return self._sequences[-1]

    def _is_in_time(self, offset_ns: int, time_ns: int) -> bool:
        """Return whether the receiver's time is consistent with the times of the used fixes."""
        known = self._utc_offset_ns
        gate = TIME_GATE_NS + CLOCK_DRIFT * abs(time_ns - self._fixed_ns)
        return known is None or abs(offset_ns - known) <= gate

    def _is_tight(self, date: float) -> bool:
        """Return whether the elements are accurate enough to confirm a fix."""
        if self._elements is not None:
            with suppress(OrbitError):
                return self._enlarged * self._elements.at(date).sigma <= TIGHT
        return False

    def _agrees_with_elements(self, fix: GpsFix) -> bool:
        """Return whether a fix agrees with the elements; true for missing or contradicted elements."""
        elements = self._elements
        return elements is None or self._enlarged > 1.0 or _agree(elements, fix, LEAST_GATE)

    def _has_false_time(self, fix: GpsFix, time_ns: int) -> bool:
        """Return whether only the time stated by a fix contradicts the elements.

        In this case, the fix agrees with the elements if its time is replaced by the time known before.
        """
        if self._elements is None or self._agrees_with_elements(fix):
            return False
        known = self.julian_date(time_ns - GPS_DELAY_NS)
        return self._is_tight(known) and self._agrees_with_elements(replace(fix, julian_date=known))

    def _enlarge(self, fix: GpsFix) -> None:
        """Enlarge the standard deviation of elements that a confirmed orbit contradicts."""
        elements = self._elements
        if elements is None or self._agrees_with_elements(fix):
            return
        with suppress(OrbitError):
            expected = elements.at(fix.julian_date)
            off = float(np.linalg.norm(fix.at(fix.julian_date).position - expected.position))
            self._enlarged = max(1.0, off / expected.sigma)


STUCK, FIELDS_CONTRADICTED = 20, 4
"""Numbers of consecutive fields that indicate a fault: of equal fields, and of fields that contradict the
estimate."""


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
        """Accept the field (3,) of a reading, and return whether the magnetometer is not stuck."""
        values = field.tolist()
        self._same, self._last = (self._same + 1 if values == self._last else 0), values
        return not self.stuck

    def text(self, refused: int) -> str:
        """Return why the magnetometer is rejected after `refused` contradictions, or an empty text."""
        if self.stuck:
            return "the magnetometer gives the same field in every reading"
        if refused < FIELDS_CONTRADICTED:
            return ""
        return f"{refused} measured fields in a row contradict the estimate"
