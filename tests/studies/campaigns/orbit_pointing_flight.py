"""One run of campaign `orbit-pointing`: a craft with its filter, planning job and control law.

The planner worker's job (`pointing_job`) makes the tables. If the target is far, the flight begins with a
slew, as in the loop; the tables of the pointing law follow. The tables are renewed in three cases: every
REPLAN s, when the body leaves its path, and after a body far off its path has been damped
(`knightcube.gnc.control.pointing_law`). The coils pause for 0.2 s in every 2 s for the magnetometer. Star
attitudes are available every 10 s with a delay of two seconds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from flight.bodies.orbit.control import commanded
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import box_areas, pressures
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.pointing_job import PointingJob, SlewRequest
from knightcube.gnc.control.pointing_law import PathRecovery, PointingLaw, damping_dipole
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.estimation.free_filter import (
    ATTITUDE,
    COIL_ERROR,
    GYRO,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
)
from knightcube.gnc.guidance.attitude_law import law_of, references
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from sim_hal.description_errors import NO_ERRORS
from sim_hal.settings import Disturbances, TipOff
from sim_hal.worlds.orbit import log_density
from tests.studies.campaigns.free_flight import (
    FIELD_NOISE,
    FIX_SIGMA,
    GYRO_NOISE,
    ORBITS,
    SECOND,
    STILL,
    WATTS,
    FreeFlight,
)
from tests.support.pointing_settings import AXES, WEIGHTS

CYCLE, PAUSE = 2.0, 0.2
"""Durations (s) of a cycle and of the pause of the coils."""
SAMPLES = 4
"""Number of magnetometer samples in a pause of the coils."""
STARS_EVERY, REPLAN, AGAIN, AHEAD = 10.0, 600.0, 10.0, 900.0
"""Times (s): intervals of star attitudes and of plans, delay before a failed plan is repeated, and length of
the prediction."""
COAST = 12.0
"""Time (s) with the coils off while the attitude estimate settles."""
STAR_SIGMA = 5e-5
"""Standard deviation (rad) of a star attitude per axis: 10 arcsec."""
TARGETS = {
    "nadir": PointingTarget(Goal.NADIR, roll=0.0),
    "sun": PointingTarget(Goal.SUN),
    "inertial": PointingTarget(Goal.INERTIAL, (0.0, 0.0, 0.0, 1.0)),
}
SLEW = {"knightcube": 300.0, "cubesat_3u": 900.0}
"""Duration (s) of a slew, as in the configurations."""
CAMERA: FloatArray = np.array([0.0, -1.0, 0.0])
"""Boresight of the star camera, body axes; the camera has no exclusion cone in this campaign."""
TORQUE = {"knightcube": (1e-9, 2e-12), "cubesat_3u": (3e-9, 5e-12)}
"""Prior torque (N m) of the filter and its random walk (N m per sqrt(s)), by craft, as in the
configurations."""


class PointingFlight:
    """One craft with its filter and law.

    `notes` has a row every 10 s: time; true rotation (3,), rad, from the target of the law; attitude error
    (rad); NEES of attitude and gyro bias; error of the residual dipole (A m^2); sunlight; power of the coils
    (A^2 m^4). `passed` states whether each star attitude passed the gate of the filter.
    """

    def __init__(self, wanted: dict[str, Any], seed: int) -> None:
        """Create the flight.

        Keys of `wanted`: craft, share of the worst disturbances, target, and the initial rotation (deg), if
        any.

        The optional `description` (DescriptionErrors) contains the differences of the true body from the
        configured body, and the optional `residual` multiplies the worst residual dipole of 1e-3 A m^2.
        """
        self._wanted = wanted
        target = wanted["target"]
        self._target = target if isinstance(target, PointingTarget) else TARGETS[target]
        orbit = wanted.get("orbit", "sso")
        self.notes: list[list[float]] = []
        self.passed: list[bool] = []
        share = wanted["share"]
        noises = Disturbances(
            drag=share * density_ratio(orbit, wanted.get("density")),
            solar_pressure=share,
            residual_dipole=wanted.get("residual", 1.0),
            principal_turn_deg=0.0 if "description" in wanted else 3.0 * share,
            **(STILL if wanted.get("still") else {}),
        )
        errors = wanted.get("description", NO_ERRORS)
        held = FreeFlight(wanted["craft"], seed, orbit, TipOff(rate=(0.0, 0.0, 0.0)), noises)
        held.advance(0)
        self.flight = flight = FreeFlight(wanted["craft"], seed, orbit, self._release(held), noises, errors)
        flight.advance(0)
        self._filter = FreeFilter(flight.inertia, FreeFilterSettings(torque=TORQUE[wanted["craft"]]))
        gyro = self._gyro(flight.motion.rate, 1.0)
        self._filter.start(flight.attitude(STAR_SIGMA), STAR_SIGMA**2 * np.eye(3), gyro)
        self._law: PointingLaw | None = None
        self._begun, self._ahead_begun, self._arrives = 0.0, -AHEAD, 0.0
        self._ahead: Ephemeris = held.ephemeris(0.0)
        self._stars: FloatArray | None = None
        self._astray = PathRecovery()
        self._turn: FloatArray = np.zeros(3)

    def _release(self, held: FreeFlight) -> TipOff:
        """Return the initial attitude and rate, as the pointing law requires them.

        If an initial rotation is given, the attitude is that of the law rotated about a random axis, and the
        rate has a random direction.
        """
        way = law_of(self._target, AXES, held.motion.quaternion, held.ephemeris(60.0), 2.0)
        start = references(way, held.ephemeris(60.0), np.array([2.0]))
        quaternion, rate = start.quaternion[0], start.rate[0]
        if (turn := self._wanted.get("turn_deg")) is not None:
            generator = np.random.default_rng([round(1e3 * turn), 7])
            about, spin = generator.standard_normal((2, 3))
            quaternion = multiply(
                from_rotation_vector(np.radians(turn) * about / np.linalg.norm(about)), quaternion
            )
            rate = np.radians(self._wanted["speed_deg"]) * spin / np.linalg.norm(spin)
        qx, qy, qz, qw = quaternion.tolist()
        wx, wy, wz = rate.tolist()
        return TipOff(rate=(wx, wy, wz), attitude=(qx, qy, qz, qw))

    def cycle(self, time: float) -> None:
        """Simulate one cycle."""
        flight, found = self.flight, self._filter
        if time - self._ahead_begun >= AHEAD:
            self._ahead, self._ahead_begun = flight.ephemeris(AHEAD + 60.0), time
        self._astray.update(float(np.linalg.norm(self._turn)), float(np.linalg.norm(found.rate)), time)
        if time >= COAST and self._is_due(time):
            self._plan(time)
        around = self._around(time)
        flight.act(np.zeros(3))
        before = flight.motion.rate
        flight.advance(round((time + PAUSE) * SECOND))
        found.begin_mean()
        found.advance(PAUSE, np.zeros(3), around)
        found.field(flight.field(SAMPLES), self._field_at(time + PAUSE), FIELD_NOISE**2 / SAMPLES * np.eye(3))
        dipole = self._command(time + PAUSE, around)
        flight.act(dipole)
        acting = flight.motion.rate
        flight.advance(round((time + CYCLE) * SECOND))
        found.advance(CYCLE - PAUSE, dipole, around)
        # The gyro measures the mean rate over the cycle. The filter adds its own estimate of the rate's
        # curvature since `begin_mean`.
        mean = _mean(before, acting, flight.motion.rate)
        change = 0.5 * CYCLE * found.acceleration
        spread = COIL_ERROR**2 * float(change @ change) + GYRO_NOISE**2 / CYCLE
        found.gyro(self._gyro(mean, CYCLE), spread * np.eye(3), change, 0.5 * CYCLE)
        self._see_stars(time + CYCLE)

    def _is_due(self, time: float) -> bool:
        """Return whether a plan is due; during a slew, only if the body left its path and was damped."""
        since = time - self._begun
        if self._law is None or (self._astray.ready and since >= AGAIN):
            return True
        if time < self._arrives:
            return False
        arrived = self._arrives > self._begun
        return (
            arrived
            or (self._astray.leaving and since >= AGAIN)
            or since >= self._wanted.get("replan", REPLAN)
        )

    def _command(self, time: float, around: FilterEnvironment) -> FloatArray:
        """Return the dipole (3,), A m^2, that the coils have until the end of the cycle."""
        found, flight = self._filter, self.flight
        if time < COAST:
            return np.zeros(3)
        field = attitude_matrix(found.quaternion) @ around.field
        residual = found.residual_dipole(around.sunlit)
        assert self._law is not None
        since = time - self._begun
        command = self._law.command(since, found.quaternion, found.rate, field, residual, found.torque_sizes)
        self._turn, dipole = command.rotation, command.dipole
        if self._astray.since is not None:
            dipole = damping_dipole(flight.inertia, found.rate, field) - residual
        dipole = commanded(dipole, found.coil_matrix)
        dipole = dipole * CYCLE / (CYCLE - PAUSE)
        dipole = dipole * min(1.0, flight.limit / float(np.abs(dipole).max()))
        if round(time / CYCLE) % 5 == 0:
            self._note(time, float(dipole @ dipole))
        return np.asarray(dipole)

    def _law_at(self, time: float, quaternion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return attitude and rate of the target at a time.

        If the roll angle is free, the target has the roll angle of the present attitude.
        """
        if self._law is not None:
            wanted = self._law.wanted(time - self._begun)
            return wanted.quaternion, wanted.rate
        ahead, at = self._ahead, max(time - self._ahead_begun, 2.0)
        found = references(law_of(self._target, AXES, quaternion, ahead, at), ahead, np.array([at]))
        return found.quaternion[0], found.rate[0]

    def _note(self, time: float, square: float) -> None:
        """Record the true error from the target of the law, and the errors of the filter."""
        flight, found = self.flight, self._filter
        wanted = self._law_at(time, flight.motion.quaternion)[0]
        turn = to_rotation_vector(multiply(flight.motion.quaternion, conjugate(wanted)))
        error = to_rotation_vector(multiply(flight.motion.quaternion, conjugate(found.quaternion)))
        both = np.concatenate([error, flight.gyro_bias - found.gyro_bias])
        pick = np.r_[ATTITUDE, GYRO]
        nees = float(both @ np.linalg.solve(found.covariance[np.ix_(pick, pick)], both)) / 6.0
        truth = flight.body.orbit_truth()
        missing = truth.residual_dipole - found.residual_dipole(truth.sunlit)
        known, unknown = float(np.linalg.norm(error)), float(np.linalg.norm(missing))
        self.notes.append([time, *turn, known, nees, unknown, truth.sunlit, square])

    def _plan(self, time: float) -> None:
        on_path = self._law is not None and self._astray.since is None
        job = self._job() if on_path else replace(self._job(), slew=self._wish(time))
        table = pointing_job.new_table(job)
        self._fly(table, time)
        self._arrives = time if table.slew is None else time + pointing_job.LEAD + table.slew.horizon

    def _wish(self, time: float) -> SlewRequest:
        """Return the request for a slew that starts at `time`."""
        craft, lit = self._wanted["craft"], self._around(time).sunlit
        return SlewRequest(SLEW[craft], np.full(3, WATTS[craft]), self._filter.residual_dipole(lit), CAMERA)

    def _fly(self, table: PointingTable, time: float) -> None:
        """Start to use a table if its values are finite, as the flight does.

        Raises LookupError if the first table is not finite.
        """
        if not np.isfinite(table.dipole).all():
            if self._law is None:
                raise LookupError("the path to the target is not finite")
            return
        self._law, self._begun = PointingLaw(table, self.flight.limit), time
        self._turn = np.zeros(3)
        self._astray.planned()

    def _job(self) -> PointingJob:
        """Return the job for the planner at this time."""
        flight, found = self.flight, self._filter
        truth, draw = flight.body.orbit_truth(), flight.generator.standard_normal
        place, velocity = truth.position + FIX_SIGMA * draw(3), truth.velocity + 0.05 * draw(3)
        return PointingJob(
            0,
            0,
            OrbitState(truth.utc, place, velocity, FIX_SIGMA),
            found.inertia,
            AXES,
            self._wanted.get("weights", WEIGHTS[self._wanted["craft"]]),
            self._target,
            found.quaternion,
            found.rate,
            found.torque_sizes,
            flight.limit * (CYCLE - PAUSE) / CYCLE,
            box_areas(flight.inertia),
        )

    def _around(self, time: float) -> FilterEnvironment:
        ahead, at = self._ahead, np.array([time - self._ahead_begun + 0.5 * CYCLE])
        lit = float(ahead.sunlit_at(at)[0])
        return FilterEnvironment(ahead.field_at(at)[0], ahead.position_at(at)[0], pressures(ahead, at), lit)

    def _field_at(self, time: float) -> FloatArray:
        """Return the model's field (3,), T, ICRS, at a time."""
        return np.asarray(self._ahead.field_at(np.array([time - self._ahead_begun]))[0])

    def _see_stars(self, time: float) -> None:
        """Give the filter the star attitude of the frame exposed a cycle ago; expose the next frame."""
        if self._stars is not None and time % STARS_EVERY < CYCLE:
            self.passed.append(self._filter.attitude(self._stars, STAR_SIGMA**2 * np.eye(3), CYCLE))
        self._stars = self.flight.attitude(STAR_SIGMA)

    def _gyro(self, rate: FloatArray, seconds: float) -> FloatArray:
        flight = self.flight
        noise = GYRO_NOISE / np.sqrt(seconds) * flight.generator.standard_normal(3)
        return np.asarray(rate + flight.gyro_bias + noise)


def density_ratio(orbit: str, density: float | None) -> float:
    """Return the ratio of a mean air density, kg/m^3, to the simulated one, or 1 if `density` is None."""
    if density is None:
        return 1.0
    position = np.array([[EARTH_RADIUS + ORBITS[orbit][0], 0.0, 0.0]])
    return density / math.exp(float(log_density(position, np.array([[0.0, 0.0, 1.0]]), 0.0)[0]))


def _mean(before: FloatArray, acting: FloatArray, after: FloatArray) -> FloatArray:
    """Return a cycle's mean rate (3,) from the rates at its start, after its pause, and at its end."""
    pause = 0.5 * PAUSE / CYCLE
    return np.asarray(pause * (before + acting) + (0.5 - pause) * (acting + after))
