"""From a wanted torque to the currents of the coils that are left, its direction first.

A dipole m makes the torque m x B, never one along the field B (Wertz 1978, 18.1). With three coils the least
dipole for a reachable torque is B x T / B^2; with two, m + lambda B makes the same torque, and lambda can be
chosen so that the lost axis needs none, unless that axis is normal to the field. Where the coils that are
left reach only a part of it, the torque is projected on what they reach. Where currents exceed a coil's limit
the whole vector is scaled, so that its direction survives: the idea of CMU's Argus flight software.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.errors import FlightError
from flight.gnc.math.arrays import FloatArray

WEAKEST = 0.15
"""Directions that the coils left reach with less than this part of the strongest are given up: there they
would ask for all the current and the rest would be scaled away."""


@dataclass(frozen=True, slots=True)
class Allocation:
    """What was made of a wish.

    Attributes:
        currents: (3,) A, zero on axes that are not available.
        torque: (3,) N m, that these currents make.
        share: of the wanted torque's length that is made in its own direction, 0 .. 1.
    """

    currents: FloatArray
    torque: FloatArray
    share: float


def allocate(
    torque: FloatArray,
    field: FloatArray,
    dipole_per_ampere: float,
    limits: FloatArray,
    available: FloatArray | None = None,
    free: FloatArray | None = None,
) -> Allocation:
    """Return currents for a torque (3,) N m in a magnetic field (3,) T, body axes.

    `limits` (3,) A; `available` (3,) bool, which coils may be used; `free` (3,) bool, about which axes the
    body can turn: a thread takes what lies about the others. Raises FlightError for what is not finite.
    """
    wanted = np.asarray(torque, dtype=np.float64)
    if not (np.isfinite(wanted).all() and np.isfinite(field).all()):
        raise FlightError(f"allocation: torque {wanted} or field {field} is not finite")
    turns = np.ones(3) if free is None else np.asarray(free, dtype=np.float64)
    usable = np.ones(3) if available is None else np.asarray(available, dtype=np.float64)
    # Column a: the torque of one ampere in coil a, about the axes that are free.
    effect = turns[:, None] * np.cross(np.eye(3), field).T * (dipole_per_ampere * usable)
    wanted = wanted * turns
    currents = np.linalg.pinv(effect, rcond=WEAKEST) @ wanted * usable
    excess = float(np.max(np.abs(currents) / limits))
    if excess > 1.0:
        currents = currents / excess
    made = effect @ currents
    length = float(wanted @ wanted)
    share = float(made @ wanted) / length if length > 0.0 else 1.0
    return Allocation(currents, made, min(max(share, 0.0), 1.0))


def keep_direction(currents: FloatArray, limits: FloatArray, available: FloatArray) -> FloatArray:
    """Return currents (3,) A with unavailable axes zero, scaled as a whole into the limits (3,)."""
    kept: FloatArray = np.where(available, currents, 0.0)
    excess = float(np.max(np.abs(kept) / limits))
    return kept / excess if excess > 1.0 else kept
