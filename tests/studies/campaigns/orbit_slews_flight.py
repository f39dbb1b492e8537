"""One flight of campaign `orbit-slews`: a craft with its filter, held, then slewed by one of the laws.

The flight is that of `orbit_pointing_flight`. For LEARN s the body is held among the stars by the pointing
law, and the filter learns torques and residual dipole; then it is slewed from where it is. Law `path` flies
the table of the planner worker (`pointing_job`); `blind` flies a table planned without torques; `eigen-axis`
follows the turn about one axis in fifth-order time by the pointing law with preview; `projected` by
proportional and derivative torque whose part along the field is lost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.estimation.free_filter import FilterEnvironment
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeReferences, references
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import SlewPath
from tests.studies.campaigns.free_flight import WATTS
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, PAUSE, PointingFlight
from tests.support.held_motion import table_along

LEARN = 1_200.0
"""s."""
HORIZON = {"knightcube": (300.0, 300.0), "cubesat_3u": (600.0, 1200.0)}
"""s."""
BANDWIDTH = 12.0
"""Of the projected law: rad a horizon."""
KNOT = 2.0
"""s, of the eigen-axis law's table."""
TAIL = 300.0
"""s that its gains look at past the end."""


class SlewFlight(PointingFlight):
    """A flight with a slew.

    Attributes:
        angle: deg, of the turn that is drawn; the body is held with an error before.
        horizon: s.
    """

    def __init__(self, wanted: dict[str, Any], seed: int) -> None:
        """`wanted`: craft, orbit, share of the worst disturbances, law, and how long it is held."""
        rng = np.random.default_rng([seed, 16])
        start = normalise(rng.normal(size=4))
        self.angle = float(rng.uniform(30.0, 180.0))
        turn = np.radians(self.angle) * normalise(rng.normal(size=3))
        self._end: FloatArray = multiply(from_rotation_vector(turn), start)
        self.horizon = float(round(rng.uniform(*HORIZON[wanted["craft"]])))
        # The pointing law holds the body before the slew, whatever law slews it.
        super().__init__({**wanted, "law": "whole", "target": _inertial(start)}, seed)
        self._slews_by, self._slews = wanted["law"], False
        self._from: tuple[float, FloatArray] | None = None
        self._about: AttitudeReferences | None = None

    def fly(self) -> tuple[float, float, float]:
        """Fly hold and slew: deg off the target at the end, heat J, and that of the planned path.

        Raises LookupError where no slew is planned.
        """
        begin = round(self._wanted.get("learn", LEARN) / CYCLE)
        for k in range(begin):
            self.cycle(k * CYCLE)
        self._target = _inertial(self._end)
        path = self._begin(begin * CYCLE)
        square = self.flight.square
        for k in range(begin, begin + round(path.horizon / CYCLE) + 1):
            self.cycle(k * CYCLE)
        off = np.degrees(angle_between(self.flight.motion.quaternion, self._end))
        watts = WATTS[self._wanted["craft"]]
        squares = np.sum(path.dipole**2, axis=1)
        planned = watts * float(np.trapezoid(squares, path.times))
        return float(off), watts * (self.flight.square - square), planned

    def _plan(self, time: float) -> None:
        """Plan while the body is held; a slew is flown to its end."""
        if not self._slews:
            super()._plan(time)

    def _begin(self, time: float) -> SlewPath:
        """Begin the slew; return the planned path."""
        job, found = self._job(), self._filter
        wish = replace(self._wish(time), seconds=self.horizon)
        sizes = job.sizes * (self._slews_by != "blind")
        table = pointing_job.run(replace(job, slew=wish, sizes=sizes))
        if table.slew is None:
            raise LookupError("no slew")
        self._slews = True
        if self._slews_by in {"path", "blind"}:
            self._fly(table, time)
            return table.slew
        quaternion = found.quaternion
        turn = to_rotation_vector(multiply(self._end, conjugate(quaternion)))
        self._about = self._one_axis(quaternion, turn)
        self._from = (time, turn)
        if self._slews_by == "eigen-axis":
            self._fly(self._along_axis(self._about), time)
        return table.slew

    def _one_axis(self, quaternion: FloatArray, turn: FloatArray) -> AttitudeReferences:
        """Return the turn about one axis, in times since its begin."""

        def law(_: object, times: FloatArray) -> FloatArray:
            s = np.clip(times / self.horizon, 0.0, 1.0)[:, None]
            share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
            return multiply(from_rotation_vector(share * turn), quaternion)

        return references(law, self._ahead, np.arange(2.0, self.horizon + TAIL, KNOT))

    def _along_axis(self, about: AttitudeReferences) -> PointingTable:
        """Return the table of the turn about one axis."""
        ahead = self.flight.ephemeris(self.horizon + TAIL + 60.0)
        field, position = ahead.field_at(about.times), ahead.position_at(about.times)
        weights = self._job().weights
        weights = replace(weights, dipole=5.0 * weights.dipole)
        table = table_along(about, field, position, self.flight.inertia, weights)
        sizes = self._filter.torque_sizes
        return replace(table, sizes=sizes, torque_part=np.zeros((len(table.dipole), 3, len(sizes))))

    def _command(self, time: float, around: FilterEnvironment) -> FloatArray:
        if self._from is None or self._slews_by != "projected":
            return super()._command(time, around)
        assert self._about is not None
        found, flight = self._filter, self.flight
        now, pace = self._about.at(time - self._from[0]), BANDWIDTH / self.horizon
        field, inertia = attitude_matrix(found.quaternion) @ around.field, flight.inertia
        turn = to_rotation_vector(multiply(found.quaternion, conjugate(now.quaternion)))
        pull = pace**2 * turn + 2.0 * pace * (found.rate - now.rate)
        torque = inertia @ (now.acceleration - pull) + np.cross(found.rate, inertia @ found.rate)
        dipole = np.cross(field, torque) / float(field @ field) - found.residual_dipole(around.sunlit)
        dipole = dipole * CYCLE / (CYCLE - PAUSE)
        return np.asarray(dipole * min(1.0, flight.limit / float(np.abs(dipole).max())))


def _inertial(quaternion: FloatArray) -> PointingTarget:
    x, y, z, w = quaternion.tolist()
    return PointingTarget(Goal.INERTIAL, (x, y, z, w))
