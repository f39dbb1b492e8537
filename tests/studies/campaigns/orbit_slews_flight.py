"""One flight of campaign `orbit-slews`: a craft with its filter, held, then slewed.

The flight is that of `orbit_pointing_flight`. For LEARN s the body is held among the stars by the pointing
law, and the filter learns torques and residual dipole; then it is slewed from where it is by the table of the
planner worker (`pointing_job`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    angle_between,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.gnc.control import pointing_job
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import SlewPath
from tests.studies.campaigns.free_flight import WATTS
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, PointingFlight

LEARN = 1_200.0
"""s."""
HORIZON = {"knightcube": (300.0, 300.0), "cubesat_3u": (600.0, 1200.0)}
"""s."""


class SlewFlight(PointingFlight):
    """A flight with a slew.

    Attributes:
        angle: deg, of the turn that is drawn; the body is held with an error before.
        horizon: s.
    """

    def __init__(self, wanted: dict[str, Any], seed: int) -> None:
        """`wanted`: craft, orbit, share of the worst disturbances, and how long it is held."""
        rng = np.random.default_rng([seed, 16])
        start = normalise(rng.normal(size=4))
        self.angle = float(rng.uniform(30.0, 180.0))
        turn = np.radians(self.angle) * normalise(rng.normal(size=3))
        self._end: FloatArray = multiply(from_rotation_vector(turn), start)
        self.horizon = float(round(rng.uniform(*HORIZON[wanted["craft"]])))
        super().__init__({**wanted, "target": _inertial(start)}, seed)
        self._slews = False

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
        wish = replace(self._wish(time), seconds=self.horizon)
        table = pointing_job.new_table(replace(self._job(), slew=wish))
        if table.slew is None:
            raise LookupError("no slew")
        self._slews = True
        self._fly(table, time)
        return table.slew


def _inertial(quaternion: FloatArray) -> PointingTarget:
    x, y, z, w = quaternion.tolist()
    return PointingTarget(Goal.INERTIAL, (x, y, z, w))
