"""Allocates a torque to the available coils, preserving its direction.

A dipole m makes the torque m x B, never one along the field B (Wertz 1978, 18.1). With three coils the least
dipole for a reachable torque is B x T / B^2; with two, m + lambda B makes the same torque, and lambda can be
chosen so that the failed axis needs no current, unless that axis is normal to the field. A torque that the
available coils reach only in part is projected on the torques that they reach. When a current exceeds its
limit the whole vector is scaled, which preserves its direction (the idea of CMU's Argus flight software).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError

WEAKEST = 0.15
"""Relative strength below which a torque direction is discarded: it would take all the current, and scaling
would remove the other directions."""


@dataclass(frozen=True, slots=True)
class Allocation:
    """Currents and their torque.

    Attributes:
        currents: (3,) A, zero on axes that are not available.
        torque: (3,) N m, torque of the allocated currents.
        share: fraction of the requested torque that is made in its direction, 0 .. 1.
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

    `limits` (3,) A. `available` (3,) bool, the coils that may be used. `free` (3,) bool, the axes about which
    the body can rotate; a thread carries torque about the others. Raises FlightError for an input that is not
    finite.
    """
    wanted = np.asarray(torque, dtype=np.float64)
    if not (np.isfinite(wanted).all() and np.isfinite(field).all()):
        raise FlightError(f"allocation: torque {wanted} or field {field} is not finite")
    turns = np.ones(3) if free is None else np.asarray(free, dtype=np.float64)
    usable = np.ones(3) if available is None else np.asarray(available, dtype=np.float64)
    # Column a: the torque of one ampere in coil a, about the free axes.
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
