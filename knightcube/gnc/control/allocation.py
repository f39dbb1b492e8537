"""Allocation of a torque to the available coils, with the direction of the torque preserved.

A dipole moment m causes the torque m x B, which has no component along the field B (Wertz 1978, section
18.1). For three equal coils, the smallest dipole moment that produces a torque T normal to B is B x T / B^2.
For any scalar lambda, the dipole moment m + lambda B causes the same torque as m. If one coil has failed,
lambda is chosen so that the failed coil needs no current, which is possible unless the axis of the failed
coil is normal to the field. If the coils cannot produce a requested torque, the torque is projected onto the
space of torques that they can produce. If a current exceeds its limit, all currents are scaled by one factor,
which preserves the direction of the torque (the idea of CMU's Argus flight software).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError

WEAKEST = 0.15
"""Torque per unit current below which a torque direction is discarded, relative to the direction with the
largest torque per unit current. A torque in a discarded direction would need the full current, and scaling
would then reduce the torque in the other directions."""


@dataclass(frozen=True, slots=True)
class Allocation:
    """Allocated currents of the coils, and the torque of these currents.

    Attributes:
        currents: coil currents (n,), zero for coils that are not available, A.
        torque: torque (3,) of the allocated currents, N m.
        share: component of the torque along the requested torque, as a fraction of the requested torque, 0 to
            1.
    """

    currents: FloatArray
    torque: FloatArray
    share: float


def allocate(
    torque: FloatArray,
    field: FloatArray,
    dipoles: FloatArray,
    limits: FloatArray,
    available: FloatArray | None = None,
    free: FloatArray | None = None,
    resistance: FloatArray | None = None,
) -> Allocation:
    """Return the coil currents for a torque (3,), N m, in a magnetic field (3,), T, body axes.

    Column k of `dipoles` (3, n) is the dipole moment of coil k per ampere, m^2. The current limits of the
    coils are `limits` (n,), A, and the mask `available` (n,) marks the coils that may be used. The mask
    `free` (3,) marks the axes about which the body can rotate, because a suspension thread may prevent
    rotation about the other axes. Of all currents that produce the torque, the currents with the least heat
    in the coil resistances `resistance` (n,), ohm, are chosen. Without the argument `resistance`, the
    resistances are assumed to be equal. Raises FlightError for an input that is not finite.
    """
    wanted = np.asarray(torque, dtype=np.float64)
    if not (np.isfinite(wanted).all() and np.isfinite(field).all()):
        raise FlightError(f"allocation: torque {wanted} or field {field} is not finite")
    turns = np.ones(3) if free is None else np.asarray(free, dtype=np.float64)
    usable = np.ones(dipoles.shape[1]) if available is None else np.asarray(available, dtype=np.float64)
    # Column i of the matrix `effect` is the torque about the free axes that one ampere in coil i causes.
    effect = turns[:, None] * np.cross(dipoles.T, field).T * usable
    wanted = wanted * turns
    # The pseudo-inverse minimises the sum of (weights * currents)^2, which is proportional to the heat.
    weights = np.ones(len(usable)) if resistance is None else np.sqrt(resistance / resistance.max())
    currents = np.linalg.pinv(effect / weights, rcond=WEAKEST) @ wanted / weights * usable
    excess = float(np.max(np.abs(currents) / limits))
    if excess > 1.0:
        currents = currents / excess
    made = effect @ currents
    length = float(wanted @ wanted)
    share = float(made @ wanted) / length if length > 0.0 else 1.0
    return Allocation(currents, made, min(max(share, 0.0), 1.0))
