"""The Sun by the solar strings: starts the filter with the magnetic field, and feeds it while coarse.

The strings give the Sun to a few degrees, since the Earth shines on them too. Its light follows the height of
the Sun over the ground below, with clouds that are not known. What they get wrong changes slowly: readings
count as independent only `MEMORY` apart.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from flight.bodies.orbit.filter import OrbitFilter
from flight.bodies.orbit.surroundings import Surroundings
from flight.gnc.attitude.determination.direction_filter import begin
from flight.gnc.attitude.determination.single_frame import Sight, field_sight
from flight.gnc.attitude.wahba import AttitudeError
from flight.gnc.estimation.estimate import TURN, Knowledge
from flight.gnc.estimation.free_motion import Around
from flight.gnc.estimation.measurements import AttitudeMeasurement, DirectionMeasurement
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector
from flight.gnc.vision.sun_sensor.strings import CoarseSun, CoarseSunStatus, SolarStrings, coarse_sun
from hal.interfaces.readings import StringReading
from hal.interfaces.wires import SECOND_NS

MEMORY = 60.0
"""s, for which the error of the strings' Sun keeps its sign: slowly turning, the same faces see the Earth."""
PERIOD_NS = 5 * SECOND_NS
"""Between readings that the filter takes: more often they say nothing new."""
OVERHEAD_ALBEDO = 0.2
"""Light of an Earth lit from overhead, over the Sun's: an albedo of 0.3, two thirds of half the sky."""
CLOUDS = 0.5
"""By which share the Earth's light varies."""
LEAST_ALBEDO = 0.02
SUNLIT = 0.99
"""Share of the Sun's disc from which the strings are expected to see it."""
CONTRADICTED = 3
"""Readings in a row that contradict an estimate that is not fine: the filter starts again."""
IMPROBABLE, GATE = 0.02, 13.8
"""Chance by which sound directions disagree at the start, and chi-square of two axes (0.001) later."""
START_SIGMA = np.radians(15.0)
"""rad, of the worst axis of an attitude from which the filter can start; LOST until it is better."""


class CoarseSunFeed:
    """Gives the filter the strings' Sun."""

    def __init__(
        self, strings: SolarStrings, period_ns: int, filter_: OrbitFilter, surroundings: Surroundings
    ) -> None:
        """`period_ns`: of a round of readings, which are not of one instant."""
        self._strings = strings
        self._period_ns = period_ns
        self._filter = filter_
        self._surroundings = surroundings
        self._taken_ns = -PERIOD_NS
        self._against = 0

    def accept(self, reading: StringReading) -> str | None:
        """Take a reading; return why it shows no Sun, empty where it does, None where it is not judged."""
        time_ns = reading.time_ns - self._period_ns // 2
        around, sun = self._surroundings.at(time_ns), self._surroundings.sun(time_ns)
        if around is None or sun is None or around.sunlit < SUNLIT:
            return None
        if self._filter.runs and reading.time_ns - self._taken_ns < PERIOD_NS:
            return None
        self._taken_ns = reading.time_ns
        found = coarse_sun(reading.currents, self._lit(around, sun), self._nadir(time_ns, around))
        if found.status is not CoarseSunStatus.FOUND:
            return found.reason
        assert found.direction is not None
        assert found.basis is not None
        assert found.tangent_covariance is not None
        if self._filter.knowledge is Knowledge.FINE:
            return ""
        across = found.basis.T @ found.tangent_covariance @ found.basis
        self._against = self._against + 1 if self._contradicts(time_ns, found, sun) else 0
        if self._filter.runs and self._against < CONTRADICTED:
            correlated = 2.0 * MEMORY * SECOND_NS / PERIOD_NS
            sight = DirectionMeasurement(time_ns, found.direction, sun, correlated * across)
            self._filter.measure_late([sight], lambda _: None)
        else:
            self._start(time_ns, Sight(found.direction, sun, across))
        return ""

    def _contradicts(self, time_ns: int, found: CoarseSun, sun: FloatArray) -> bool:
        """Return whether the strings' Sun is too far from the estimate's; not where there is none."""
        then = self._filter.past(time_ns) if self._filter.runs else None
        if then is None or found.basis is None:
            return False
        off = found.basis @ (attitude_matrix(then.quaternion) @ sun)
        assert found.tangent_covariance is not None
        claimed = found.basis @ (np.trace(then.covariance[TURN, TURN]) * np.eye(3)) @ found.basis.T
        return bool(off @ np.linalg.solve(claimed + found.tangent_covariance, off) > GATE)

    def _start(self, time_ns: int, sun: Sight) -> None:
        """Start from the Sun and the newest field, where both fix an attitude and agree."""
        heard = self._filter.heard_field()
        if heard is None:
            return
        field, gyro = heard
        seconds = (field.time_ns - time_ns) / SECOND_NS
        turn = from_rotation_vector(seconds * gyro)
        moved = attitude_matrix(turn) @ sun.observed
        # A round is as long as a period: its readings are of a turning body.
        blurred = (float(gyro @ gyro) * (self._period_ns / SECOND_NS) ** 2 / 12.0) * np.eye(3)
        try:
            sights = [
                Sight(moved, sun.reference, sun.covariance + blurred),
                field_sight(field.field, field.reference, field.covariance),
            ]
        except AttitudeError:
            return
        fix = begin(sights, IMPROBABLE)
        if fix is not None and float(np.max(np.diag(fix.covariance))) <= START_SIGMA**2:
            self._filter.begin(AttitudeMeasurement(field.time_ns, fix.quaternion, fix.covariance))

    def _lit(self, around: Around, sun: FloatArray) -> SolarStrings:
        """Return the strings under the light of the Earth below."""
        height = max(float(sun @ around.position) / float(np.linalg.norm(around.position)), 0.0)
        light = OVERHEAD_ALBEDO * height + LEAST_ALBEDO
        return dataclasses.replace(self._strings, albedo=light, albedo_sigma=CLOUDS * light)

    def _nadir(self, time_ns: int, around: Around) -> FloatArray | None:
        """Return nadir (3,) in body axes by the estimate; None before there is one."""
        then = self._filter.past(time_ns) if self._filter.runs else None
        if then is None:
            return None
        down = attitude_matrix(then.quaternion) @ around.position
        return np.asarray(-down / np.linalg.norm(down))
