"""The path of a satellite: the table of the pointing law that is flown, until its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.three_axes.pointing_law import PathRecovery, PointingLaw
from knightcube.gnc.control.three_axes.pointing_table import PointingTable
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeReference
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """The path at one time of the clock, `seconds` after its origin; implements `Reference` of the loop."""

    paths: PointingPaths
    law: PointingLaw
    time_ns: int
    seconds: float

    @property
    def motion(self) -> AttitudeReference:
        """The wanted motion."""
        return self.law.reference(self.seconds)

    @property
    def quaternion(self) -> FloatArray:
        """(4,) ICRS into body."""
        return self.motion.quaternion

    @property
    def body_rate(self) -> FloatArray:
        """(3,) rad/s, body axes."""
        return self.motion.rate


class PointingPaths:
    """Implements `flight.loop.body.Paths`.

    Attributes:
        off: rad, how far the body was off the path at the last command; zero for a new path.
        astray: whether it is held still because of that.
    """

    def __init__(self, limit: float, fastest: float) -> None:
        """`limit` A m^2 of each coil, mean over a window; `fastest` rad/s, of no path to be reached."""
        self._limit, self._fastest = limit, fastest
        self._law: PointingLaw | None = None
        self._target: PointingTarget | None = None
        self._origin_ns = 0
        self._arrival_ns: int | None = None
        self.off = 0.0
        self.astray = PathRecovery()

    def offer(self, table: PointingTable, target: PointingTarget, origin_ns: int) -> str:
        """Fly a table, or its part that is slow enough; return why it is refused, empty when it is flown."""
        parts = (table.gain, table.dipole, table.torque_part, table.path.quaternion)
        if not all(np.isfinite(part).all() for part in parts):
            return "it holds values that are not finite"
        flown = table.below(self._fastest)
        if flown is None:
            turn, most = np.rad2deg([table.fastest, self._fastest])
            return f"it turns the body at {turn:.2f} deg/s, where {most:.2f} are braked or blind the camera"
        self._law, self._target, self._origin_ns = PointingLaw(flown, self._limit), target, origin_ns
        self.off, self._arrival_ns = 0.0, None
        self.astray.planned()
        if table.slew is not None:
            self._arrival_ns = origin_ns + round((self._law.span[0] + table.slew.horizon) * SECOND_NS)
        return ""

    def led(self, turn: FloatArray, rate: FloatArray, now_ns: int) -> bool:
        """Take the turn (3,) off the path and the rate (3,); return whether it is flown: not while astray."""
        self.off = float(np.linalg.norm(turn))
        self.astray.see(self.off, float(np.linalg.norm(rate)), now_ns / SECOND_NS)
        return self.astray.since is None

    def is_slewing(self, now_ns: int, target: PointingTarget) -> bool:
        """Return whether a slew to a target is flown and not over."""
        return self._arrival_ns is not None and now_ns < self._arrival_ns and target == self._target

    def has_arrived(self, now_ns: int) -> bool:
        """Return whether a slew is over: once for each."""
        over = self._arrival_ns is not None and now_ns >= self._arrival_ns
        if over:
            self._arrival_ns = None
        return over

    def sample(self, now_ns: int) -> PathPoint | None:
        """Return the path now; None without one, or after its end."""
        if self._law is None:
            return None
        seconds = (now_ns - self._origin_ns) / SECOND_NS
        return PathPoint(self, self._law, now_ns, seconds) if seconds <= self._law.span[1] else None

    def attitude(self, target: PointingTarget, now_ns: int) -> FloatArray | None:
        """Return the attitude (4,) of a target now; None while no path to this target is flown."""
        point = self.sample(now_ns)
        if point is None or target != self._target:
            return None
        return point.law.wanted(point.seconds).quaternion

    def is_following(self, now_ns: int) -> bool:
        """Return whether there is a path: all of it is followed."""
        return self.sample(now_ns) is not None

    def is_adrift(self, now_ns: int) -> bool:
        """Return False: the coils rest after the end of a path."""
        return False

    def release(self) -> None:
        """Discard the path."""
        self._law = self._target = self._arrival_ns = None
        self.astray.planned()
