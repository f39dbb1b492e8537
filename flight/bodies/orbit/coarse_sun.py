"""The solar strings: with the magnetic field they start the filter, and feed it while it is not fine.

An attitude by field and strings claims every turn that is possible while any one string fails
(`FieldAndStrings`). What the strings get wrong may stay for minutes: an attitude of theirs is used only
where it says more than the filter, so that repetition never narrows the filter's claim.
"""

from __future__ import annotations

import numpy as np

from flight.bodies.orbit.filter import OrbitFilter
from flight.bodies.orbit.surroundings import Surroundings
from hal.interfaces.readings import StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.estimate import TURN, Knowledge
from knightcube.gnc.estimation.free_motion import Around
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, DirectionMeasurement
from knightcube.vision.sun.field_and_strings import FieldAndStrings, Sky, StringFix
from knightcube.vision.sun.strings import SolarStrings

PERIOD_NS = 5 * SECOND_NS
"""Between readings that are judged: more often they say nothing new."""
OVERHEAD_ALBEDO = 0.2
"""Light of an Earth lit from overhead, over the Sun's: an albedo of 0.3, two thirds of half the sky."""
CLOUDS = 0.5
"""By which share the Earth's light varies."""
LEAST_ALBEDO = 0.02
STUCK = 3
"""Readings in a row that are the same to the last bit: their noise never is."""
SUNLIT = 0.99
"""Share of the Sun's disc from which the strings are expected to see it."""
CONTRADICTED, GATE = 3, 30.7
"""Attitudes in a row that contradict an estimate that is not fine: the filter starts again; chi-square of
three axes (1e-6) from which they do."""
START_SIGMA = np.radians(5.0)
"""rad, of the turn about the field, from which the filter starts."""
STRENGTH_SIGMA = 5.0
"""Sigmas by which the field may be stronger or weaker than its model says."""


class CoarseSunFeed:
    """Gives the filter the attitude by field and strings."""

    def __init__(
        self, strings: SolarStrings, period_ns: int, filter_: OrbitFilter, surroundings: Surroundings
    ) -> None:
        """`period_ns`: of a round of readings, which are not of one instant."""
        self.strings = strings
        self.newest: StringReading | None = None
        self._turns = FieldAndStrings(strings)
        self._period_ns = period_ns
        self._filter = filter_
        self._surroundings = surroundings
        self._judged_ns = -PERIOD_NS
        self._against = 0
        self._last: list[float] = []
        self._same = 0

    def accept(self, reading: StringReading) -> str | None:
        """Take a reading; return what it shows to be wrong, empty for nothing, None where not judged."""
        self.newest = reading
        time_ns = reading.time_ns - self._period_ns // 2
        around, sun = self._surroundings.at(time_ns), self._surroundings.sun(time_ns)
        if around is None or sun is None or around.sunlit < SUNLIT:
            return None
        currents = reading.currents.tolist()
        self._same, self._last = (self._same + 1 if currents == self._last else 0), currents
        if self._same >= STUCK:
            return "the strings give the same currents in every reading"
        if time_ns - self._judged_ns < PERIOD_NS:
            return None
        heard = self._filter.heard_field()
        turned = None if heard is None else self._filter.turned(heard[0].time_ns, time_ns)
        if heard is None or turned is None:
            return None
        self._carry_on(time_ns)
        (field, gyro), sky = heard, _sky(around, sun)
        seen = attitude_matrix(turned) @ field.field
        sigma = float(np.sqrt(field.covariance[0, 0]))
        excess = float(np.linalg.norm(seen) - np.linalg.norm(sky.field))
        if abs(excess) > STRENGTH_SIGMA * sigma:
            self._turns.forget()
            return f"the field is {excess * 1e6:+.1f} uT off its model: no attitude by it"
        # A round is as long as a period: its readings are of a turning body.
        blur = float(np.linalg.norm(gyro)) * self._period_ns / SECOND_NS / np.sqrt(12.0)
        fix = self._turns.accept(reading.currents, seen, sigma, sky, blur)
        if fix is not None and self._filter.knowledge is not Knowledge.FINE:
            self._use(time_ns, fix, sun)
        return self._turns.wrong

    def _carry_on(self, time_ns: int) -> None:
        """Carry the possible turns on to the time of a reading."""
        since_ns, self._judged_ns = self._judged_ns, time_ns
        turned = self._filter.turned(since_ns, time_ns)
        if turned is None:
            self._turns.forget()
        else:
            self._turns.turn(turned, (time_ns - since_ns) / SECOND_NS)

    def _use(self, time_ns: int, fix: StringFix, sun: FloatArray) -> None:
        """Start the filter from an attitude, or feed it the turn about the field."""
        if not self._filter.runs or self._against >= CONTRADICTED:
            doubted, self._against = self._against >= CONTRADICTED, 0
            if fix.about <= START_SIGMA:
                attitude = AttitudeMeasurement(time_ns, fix.quaternion, fix.covariance)
                self._filter.begin(attitude, doubted=doubted)
            return
        then = self._filter.past(time_ns)
        if then is None:  # the filter began after this reading
            return
        claim = then.covariance[TURN, TURN]
        off = to_rotation_vector(multiply(fix.quaternion, conjugate(then.quaternion)))
        contradicts = float(off @ np.linalg.solve(claim + fix.covariance, off)) > GATE
        self._against = self._against + 1 if contradicts else 0
        if not contradicts and float(fix.axis @ claim @ fix.axis) > fix.about**2:
            seen = attitude_matrix(fix.quaternion) @ sun
            covariance = fix.about**2 * np.eye(3)
            self._filter.measure_late([DirectionMeasurement(time_ns, seen, sun, covariance)], lambda _: None)


def _sky(around: Around, sun: FloatArray) -> Sky:
    """Return the directions and the light of the Earth below, with clouds that are not known."""
    up = around.position / np.linalg.norm(around.position)
    light = OVERHEAD_ALBEDO * max(float(sun @ up), 0.0) + LEAST_ALBEDO
    return Sky(around.field, sun, -up, light, CLOUDS * light)
