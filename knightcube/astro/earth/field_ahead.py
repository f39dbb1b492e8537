"""The geomagnetic field along the orbit for an hour ahead, cheap enough for the control loop.

The whole model takes 0.3 ms an instant. So each call makes a few knots more, a minute apart, and the field
between them is straight; beyond the last knot it is that of the dipole. The dipole alone errs by 9 deg rms,
and where the field is weak by more: a braking planned with it takes up to a quarter longer.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.dipole_field import dipole_field_ahead
from knightcube.astro.earth.geomagnetism import GeomagneticError, field
from knightcube.astro.earth.orbit_knowledge import OrbitState, carried_on
from knightcube.astro.earth.sun import DAY

STEP = 60.0
"""s between the knots: the field turns by 8 deg, and is 0.2 % weaker between them."""
MORE = 5
"""Knots that one call makes."""
FAR = 50e3
"""m: an orbit that is known otherwise by more, such as at the first fix after a wrong clock, begins again."""


class FieldAhead:
    """Keeps the knots from call to call."""

    def __init__(self) -> None:
        self._begin = 0.0
        self._states: list[FloatArray] = []
        self._fields: list[FloatArray] = []

    def along(self, state: OrbitState, times: FloatArray) -> FloatArray:
        """Return the field (n, 3) T, ICRS, at `times` (n,) s, rising, from a state of the orbit on.

        Raises GeomagneticError where even the first instant is outside the model's years.
        """
        since = self._restart(state)
        last = since + float(times[-1])
        for _ in range(MORE):
            if self._span < last and not self._extend():
                break
        at = since + times
        inside = at <= self._span
        found = np.empty((len(times), 3))
        knots = np.array(self._fields)
        place = at[inside] / STEP
        before = np.minimum(place.astype(np.int64), max(len(knots) - 2, 0))
        share = (place - before)[:, None]
        found[inside] = (1.0 - share) * knots[before] + share * knots[np.minimum(before + 1, len(knots) - 1)]
        if not inside.all():
            end = self._states[-1]
            there = OrbitState(self._begin + self._span / DAY, end[:3], end[3:], state.sigma)
            found[~inside] = dipole_field_ahead(there, knots[-1], at[~inside] - self._span)
        return found

    @property
    def _span(self) -> float:
        return STEP * (len(self._fields) - 1)

    def _restart(self, state: OrbitState) -> float:
        """Return the time since the first knot, s; knots that are past or do not fit are forgotten."""
        since = (state.julian_date - self._begin) * DAY
        if not (0.0 <= since <= self._span and self._fits(state, since)):
            self._begin = state.julian_date
            self._states = [np.concatenate([state.position, state.velocity])]
            self._fields = [field(state.julian_date, state.position)]
            return 0.0
        while since >= STEP and len(self._fields) > 1:
            del self._states[0], self._fields[0]
            self._begin += STEP / DAY
            since -= STEP
        return since

    def _fits(self, state: OrbitState, since: float) -> bool:
        before = min(int(since / STEP), len(self._states) - 1)
        here = carried_on(self._states[before], since - STEP * before)[:3]
        return float(np.linalg.norm(here - state.position)) < FAR

    def _extend(self) -> bool:
        """Make one knot more; return whether the model reaches so far."""
        after = carried_on(self._states[-1], STEP)
        try:
            there = field(self._begin + (self._span + STEP) / DAY, after[:3])
        except GeomagneticError:
            return False
        self._states.append(after)
        self._fields.append(there)
        return True
