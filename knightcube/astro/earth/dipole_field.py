"""The geomagnetic field ahead by its dipole alone: cheap enough for the control loop.

The first degree of WMM2025 (NOAA NCEI and British Geological Survey 2025) along a circle with the satellite's
present place, direction and angular rate, turned and scaled at its begin to the field that the whole model
has there, by less the farther ahead. The direction errs by 9 deg rms, enough to plan a braking with.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.earth.orientation import ROTATION_RATE, celestial_to_terrestrial
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector

_DIPOLE = 1e-9 * np.array([-1410.8, 4545.4, -29351.8])
"""T: g11, h11 and g10 of WMM2025, ITRS axes."""
_RADIUS = 6_371_200.0
"""m, to which they refer."""
_FADES = 400.0
"""s ahead over which what the dipole lacks at the begin is forgotten."""


def dipole_field_ahead(state: OrbitState, field: FloatArray, times: FloatArray) -> FloatArray:
    """Return the field (n, 3) T, ICRS, at `times` (n,) s from a state on, where it is `field` (3,) T now."""
    found = _along(state, np.concatenate([[0.0], times]))
    first = found[0]
    across = np.cross(field, first)  # turns `first` into `field`, with this house's signs
    length = float(np.linalg.norm(across))
    rest = np.exp(-times / _FADES)[:, None]
    angle = math.atan2(length, float(first @ field))
    turned = attitude_matrix(from_rotation_vector(rest * (across * (angle / max(length, 1e-30)))))
    scale = 1.0 + rest * (float(np.linalg.norm(field) / np.linalg.norm(first)) - 1.0)
    return np.asarray(scale * np.einsum("nij,nj->ni", turned, found[1:]))


def _along(state: OrbitState, times: FloatArray) -> FloatArray:
    """Return the dipole's field (n, 3) T along the circle."""
    distance = float(np.linalg.norm(state.position))
    up = state.position / distance
    normal = np.cross(state.position, state.velocity)
    ahead = np.cross(normal, up) / np.linalg.norm(normal)
    angle = float(np.linalg.norm(normal)) / distance**2 * times[:, None]
    place = np.cos(angle) * up + np.sin(angle) * ahead
    dipole = _DIPOLE @ celestial_to_terrestrial(state.julian_date)
    sine, cosine = np.sin(ROTATION_RATE * times), np.cos(ROTATION_RATE * times)
    x, y, z = dipole.tolist()
    turning = np.stack([cosine * x - sine * y, sine * x + cosine * y, np.full(len(times), z)], axis=1)
    above = np.einsum("ni,ni->n", turning, place)[:, None]
    return np.asarray((_RADIUS / distance) ** 3 * (3.0 * above * place - turning))
