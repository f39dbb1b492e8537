"""The surroundings along an orbit, predicted: position, velocity, field and Sun at even instants.

Built once, off the loop, from a state of the orbit (0.3 ms an instant), and interpolated at any time between:
positions by cubic Hermite polynomials, the field and the Sun along straight lines. Steps of 10 s leave 1 mm
and 3 nT.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.geomagnetism import field
from knightcube.astro.earth.orbit_knowledge import OrbitError, OrbitState, carried_on
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.shadow import sunlit_share
from knightcube.astro.earth.sun import DAY, earth_from_sun

STEP = 10.0
"""s, between the instants."""


@dataclass(frozen=True, slots=True, eq=False)
class Ephemeris:
    """Predictions at `times` (n,) s after `julian_date` UTC, all in ICRS axes.

    Attributes:
        position, velocity: (n, 3) m and m/s.
        field: (n, 3) T.
        sun: (n, 3) m, geocentric.
        sunlit: (n,) share of the Sun's disc in view.
    """

    julian_date: float
    times: FloatArray
    position: FloatArray
    velocity: FloatArray
    field: FloatArray
    sun: FloatArray
    sunlit: FloatArray

    def position_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3) m at `times` (m,) s. Raises OrbitError outside the prediction."""
        before, share, span = self._place(times)
        s = share[:, None]
        start, end = self.position[before], self.position[before + 1]
        out, into = span * self.velocity[before], span * self.velocity[before + 1]
        bend = (1.0 - s) * (out - (end - start)) + s * ((end - start) - into)
        return np.asarray(start + s * (end - start) + s * (1.0 - s) * bend)

    def velocity_at(self, times: FloatArray) -> FloatArray:
        """Return velocities (m, 3) m/s at `times` (m,) s: the derivative of `position_at`."""
        before, share, span = self._place(times)
        s = share[:, None]
        start, end = self.position[before], self.position[before + 1]
        out, into = self.velocity[before], self.velocity[before + 1]
        mean = (end - start) / span
        return np.asarray(
            (1.0 - 4.0 * s + 3.0 * s * s) * out + (3.0 * s * s - 2.0 * s) * into + 6.0 * s * (1.0 - s) * mean
        )

    def field_at(self, times: FloatArray) -> FloatArray:
        """Return the field (m, 3) T at `times` (m,) s."""
        return self._straight(self.field, times)

    def sun_at(self, times: FloatArray) -> FloatArray:
        """Return the Sun's direction (m, 3) from the satellite at `times` (m,) s."""
        towards = self._straight(self.sun, times) - self.position_at(times)
        return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))

    def sunlit_at(self, times: FloatArray) -> FloatArray:
        """Return the visible share (m,) of the Sun's disc at `times` (m,) s."""
        return self._straight(self.sunlit[:, None], times)[:, 0]

    def _straight(self, values: FloatArray, times: FloatArray) -> FloatArray:
        before, share, _ = self._place(times)
        s = share[:, None]
        return np.asarray((1.0 - s) * values[before] + s * values[before + 1])

    def _place(
        self, times: FloatArray
    ) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], FloatArray, float]:
        """Return the instant before each time, the share of the step since, and the step."""
        times = np.atleast_1d(times)
        step = float(self.times[1] - self.times[0])
        place = (times - self.times[0]) / step
        last = len(self.times) - 2
        if not (np.all(place >= -1e-6) and np.all(place <= last + 1.0 + 1e-6)):
            raise OrbitError(
                f"{times[0]:.0f} .. {times[-1]:.0f} s: the orbit is predicted for "
                f"{self.times[0]:.0f} .. {self.times[-1]:.0f} s"
            )
        before = np.clip(place.astype(np.int64), 0, last)
        return before, place - before, step


def predict(state: OrbitState, duration: float, step: float = STEP) -> Ephemeris:
    """Return the ephemeris of `duration` s from a state of the orbit on, under J2. Raises GeomagneticError.

    Over two revolutions the neglected air and gravity move a satellite by a kilometre, 15 nT of its field.
    """
    times: FloatArray = step * np.arange(np.ceil(duration / step) + 2.0)
    dates = state.julian_date + times / DAY
    states = [np.concatenate([state.position, state.velocity])]
    for _ in times[1:]:
        states.append(carried_on(states[-1], step))
    along = np.array(states)
    position = along[:, :3]
    first, last = (-earth_from_sun(float(terrestrial_time(date)))[0] for date in dates[[0, -1]])
    sun = first + np.linspace(0.0, 1.0, len(dates))[:, None] * (last - first)
    return Ephemeris(
        state.julian_date,
        times,
        position,
        along[:, 3:],
        np.array([field(float(date), place) for date, place in zip(dates, position, strict=True)]),
        sun,
        sunlit_share(position, sun),
    )
