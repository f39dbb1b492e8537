"""A body held by hand on a laboratory bench, for `knightcube bringup` with emulated devices.

The reference frame is the testbed frame, whose y axis points down. The body stands with its z axis up until
it is rotated by hand. For devices that need an orbit, a satellite has the orbit of its configuration, as if a
signal simulator were connected to the GPS receiver.
"""

from __future__ import annotations

import math

import numpy as np

from flight.schema.orbit import OrbitConfig
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_matrix, from_rotation_vector, multiply
from sim_hal.worlds.world import (
    STANDARD_GRAVITY,
    BodyMotion,
    OrbitEnvironment,
    OrbitingWorld,
    OrbitTruth,
    WorldInputs,
    WorldTruth,
)

LABORATORY_FIELD = np.array([3.0e-6, 4.2e-5, -2.1e-5])
"""Magnetic field (T) in the testbed frame: 47 uT with a dip of 63 deg, as in central Europe."""
_UPRIGHT = from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))


class HeldBody:
    """A body that rests with its z axis up, or is rotated about one of its axes.

    Attributes:
        held: true for a body on a bench; Earth and Sun are not in view of its star camera.
    """

    held = True

    def __init__(self) -> None:
        self._start = _UPRIGHT
        self._axis: FloatArray = np.zeros(3)
        self._angle, self._begin_ns, self._span = 0.0, 0, 1.0

    def turn(self, axis: FloatArray, angle: float, begin_ns: int, seconds: float) -> None:
        """Rotate the upright body about `axis` (3,), body axes, by `angle` rad, from `begin_ns` on."""
        self._axis, self._angle, self._begin_ns, self._span = axis, angle, begin_ns, seconds

    def release_at(self, time_ns: int) -> None:
        """Do nothing, because the body is held by hand and is never released."""

    def advance_to(self, time_ns: int) -> None:
        """Do nothing, because the motion is a function of time."""

    def motion(self, time_ns: int) -> BodyMotion:
        """Return attitude, rate, field and specific force at `time_ns`."""
        share = min(max((time_ns - self._begin_ns) * 1e-9 / self._span, 0.0), 1.0)
        angle = 0.5 * self._angle * (1.0 - math.cos(math.pi * share))
        speed = 0.5 * self._angle * math.pi / self._span * math.sin(math.pi * share)
        attitude = multiply(from_rotation_vector(self._axis * angle), self._start)
        to_body = attitude_matrix(attitude)
        up = to_body @ np.array([0.0, -STANDARD_GRAVITY, 0.0])
        return BodyMotion(time_ns, attitude, self._axis * speed, to_body @ LABORATORY_FIELD, up)

    def truth(self) -> WorldTruth:
        """Return zero currents and energies, which are not recorded on a bench."""
        return WorldTruth(np.zeros(3), 0.0, 0.0)


class HeldSatellite(HeldBody):
    """A held body whose GPS receiver, solar cells and horizon cameras behave as in the given orbit."""

    def __init__(self, orbit: OrbitingWorld) -> None:
        super().__init__()
        self._orbit = orbit

    def advance_to(self, time_ns: int) -> None:
        """Advance the orbit."""
        self._orbit.advance_to(time_ns)

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment in the orbit at the present time."""
        return self._orbit.surroundings()

    def utc_ns(self) -> int:
        """Return the UTC of the orbit, ns since 1970."""
        return self._orbit.utc_ns()

    def orbit_truth(self) -> OrbitTruth:
        """Return the present state in the orbit."""
        return self._orbit.orbit_truth()


def make(inputs: WorldInputs) -> HeldBody:
    """Return a body on a bench, with the orbit of the configuration if it has one."""
    if isinstance(inputs.config, OrbitConfig) and inputs.section.free_body is not None:
        from sim_hal.worlds import free_body  # noqa: PLC0415 - loads the models of the orbit

        return HeldSatellite(free_body.make(inputs))
    return HeldBody()
