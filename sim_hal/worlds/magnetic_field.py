"""The Earth's true magnetic field: the International Geomagnetic Reference Field, 14th generation (IGRF-14).

The field is an expansion in spherical harmonics of degree 13 (Alken et al. 2021, Earth Planets Space 73:49,
eq. 1), whose coefficients (2024, doi 10.5281/zenodo.14012302) are interpolated linearly between epochs. After
the last epoch, 2030, the coefficients are extrapolated with the secular variation and acceleration of the
last epochs. The flight software uses a different model (`knightcube.astro.earth.geomagnetism`), so that the
simulation includes a realistic model error. `ring_current` gives the field of the ring current. Currents in
the ionosphere are not modelled.

The table `igrf.npz` holds the coefficients as integers in units of 0.01 nT. `tests/support/build_igrf.py`
makes the table from the file that the package ppigrf ships. The package ppigrf itself is not used, because it
needs pandas and takes 81 ms for one position instead of 3 ms. The fields of ppigrf and of this module agree
within 0.06 nT.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import celestial_to_terrestrial, julian_epoch, north_east_down

TABLE = Path(__file__).with_name("igrf.npz")
DEGREE = 13
REFERENCE_RADIUS = 6_371_200.0
"""Reference radius (m) of the spherical-harmonic expansion."""
UNIT = 1e-11
"""Unit (T) of the integer coefficients in the table `igrf.npz`."""
EXTRAPOLATION = 15.0
"""Time (years) after the last epoch for which the field is extrapolated."""
DEVICE = "geomagnetic field"
_NEAR_POLE = 0.5 * np.pi - 1e-8
"""Latitude (rad) to which larger latitudes are limited, 7 cm from the pole, where east is undefined."""


def field(julian_date: npt.ArrayLike, position: FloatArray) -> FloatArray:
    """Return the magnetic field (..., 3), T, ICRS axes.

    The field is evaluated at Julian dates UTC (...) and positions (..., 3), m, ICRS.

        Raises OutOfRange for a date outside the epochs of the table.
    """
    to_ground = celestial_to_terrestrial(julian_date)
    there = np.einsum("...ij,...j->...i", to_ground, position)
    return np.asarray(np.einsum("...ji,...j->...i", to_ground, field_on_ground(julian_date, there)))


def field_on_ground(julian_date: npt.ArrayLike, position: FloatArray) -> FloatArray:
    """Return the field (..., 3), T, at Julian dates (...) UTC and positions (..., 3), m, all in ITRS axes."""
    position = np.asarray(position, dtype=float)
    shape = np.broadcast_shapes(np.shape(julian_date), position.shape[:-1])
    place = np.broadcast_to(position, (*shape, 3)).reshape(-1, 3)
    year = np.broadcast_to(julian_epoch(julian_date), shape).reshape(-1)
    radius = np.linalg.norm(place, axis=-1)
    longitude = np.arctan2(place[:, 1], place[:, 0])
    latitude = np.arctan2(place[:, 2], np.hypot(place[:, 0], place[:, 1]))
    latitude = np.clip(latitude, -_NEAR_POLE, _NEAR_POLE)
    local = _expansion(_coefficients(year), radius, 0.5 * np.pi - latitude, longitude)
    axes = north_east_down(longitude, latitude)
    return np.asarray(np.einsum("nji,nj->ni", axes, local).reshape(*shape, 3))


def ring_current(julian_date: npt.ArrayLike, disturbance: float) -> FloatArray:
    """Return the uniform magnetic field (..., 3), T, ICRS axes, of a ring current.

    `disturbance` (T) is the negative Dst index, about 20 nT on a quiet day and 100 nT in a storm.
    """
    dipole = _coefficients(np.atleast_1d(julian_epoch(julian_date)).reshape(-1))[0, :3]
    # The dipole (g10, g11, h11) and the field inside the ring current both point south.
    axis = np.array([dipole[1], dipole[2], dipole[0]]) / np.linalg.norm(dipole)
    to_ground = celestial_to_terrestrial(julian_date)
    return np.asarray(np.einsum("...ji,j->...i", to_ground, disturbance * axis))


@cache
def _table() -> tuple[FloatArray, FloatArray]:
    """Return the epochs (e,), years, and the coefficients (e, 195), T, ordered g10, g11, h11, g20, ..."""
    with np.load(TABLE, allow_pickle=False) as stored:
        return stored["epoch"].astype(float), UNIT * stored["coefficient"].astype(float)


def _coefficients(year: FloatArray) -> FloatArray:
    """Return the coefficients (n, 195), T, interpolated or extrapolated to years (n,)."""
    epochs, values = _table()
    last = float(epochs[-1]) + EXTRAPOLATION
    if year.size and not (epochs[0] <= np.min(year) and np.max(year) <= last):
        worst = float(np.min(year) if np.min(year) < epochs[0] else np.max(year))
        raise OutOfRange(DEVICE, "year", worst, float(epochs[0]), last, "")
    after = np.clip(np.searchsorted(epochs, year, side="right"), 1, len(epochs) - 1)
    share = (year - epochs[after - 1]) / (epochs[after] - epochs[after - 1])
    found = np.asarray(values[after - 1] + share[:, None] * (values[after] - values[after - 1]))
    late = np.maximum(year - epochs[-1], 0.0)
    if np.any(late > 0.0):
        steps = np.diff(epochs[-3:])
        variation = np.diff(values[-3:], axis=0) / steps[:, None]
        found += 0.5 * (late**2)[:, None] * (variation[1] - variation[0]) / float(np.mean(steps))
    return found


def _expansion(
    coefficients: FloatArray, radius: FloatArray, colatitude: FloatArray, longitude: FloatArray
) -> FloatArray:
    """Return the field (n, 3), T, along geocentric north, east and down.

    The field is the negative gradient of the potential.
    """
    legendre, slope = _legendre(np.cos(colatitude), np.sin(colatitude))
    sine = np.sin(colatitude)
    ratio = REFERENCE_RADIUS / radius
    power = ratio**2
    north, east, down = np.zeros_like(radius), np.zeros_like(radius), np.zeros_like(radius)
    column = 0
    for n in range(1, DEGREE + 1):
        power = power * ratio
        for m in range(n + 1):
            g = coefficients[:, column]
            h = coefficients[:, column + 1] if m else np.zeros_like(g)
            column += 2 if m else 1
            cosine, sine_m = np.cos(m * longitude), np.sin(m * longitude)
            wave = g * cosine + h * sine_m
            north += power * wave * slope[n][m]
            east += power * m * (g * sine_m - h * cosine) * legendre[n][m] / sine
            down -= (n + 1) * power * wave * legendre[n][m]
    return np.stack([north, east, down], axis=-1)


def _legendre(cosine: FloatArray, sine: FloatArray) -> tuple[list[list[FloatArray]], list[list[FloatArray]]]:
    """Return Schmidt functions P[n][m] and derivatives with respect to colatitude, each an array (points,).

    The recursions are from Langel, "The main field", in Geomagnetism (Jacobs, 1987), eq. 27 and table 2.
    """
    p = [[np.ones_like(cosine)]]
    d = [[np.zeros_like(cosine)]]
    for n in range(1, DEGREE + 1):
        p_row, d_row = [], []
        for m in range(n):
            before = np.sqrt(n * n - m * m)
            lower = np.sqrt((n - 1) ** 2 - m * m)
            older_p = lower * p[n - 2][m] if m < n - 1 else 0.0
            older_d = lower * d[n - 2][m] if m < n - 1 else 0.0
            p_row.append(((2 * n - 1) * cosine * p[n - 1][m] - older_p) / before)
            d_row.append(((2 * n - 1) * (cosine * d[n - 1][m] - sine * p[n - 1][m]) - older_d) / before)
        factor = np.sqrt(1.0 - 0.5 / n) if n > 1 else 1.0
        p_row.append(factor * sine * p[n - 1][n - 1])
        d_row.append(factor * (cosine * p[n - 1][n - 1] + sine * d[n - 1][n - 1]))
        p.append(p_row)
        d.append(d_row)
    return p, d
