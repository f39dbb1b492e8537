"""The states of the satellite's filter that are stored for the next boot.

The learned states are stored for the next boot in three parts, without the cross-covariance of different
parts. The part `attitude-errors` holds the biases and matrices of gyro and magnetometer and the misalignment
of the star camera. The part `attitude-torques` holds the residual dipole in shadow and in sunlight and the
torques. The part `body` holds the inertia and the matrix of the coils. The matrix of the coils applies to
dipoles that were computed with the signs and gains from the coil monitor. These signs and gains are therefore
stored too, in the entry `coil-factors`. Another entry, `learned-at`, is the time (UTC, s) for which the
learned states were estimated. At the next boot, the covariance of each state grows by its random walk over
the elapsed time, and by a fraction of its initial covariance, because switching a sensor off and on changes
its bias.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flight.loop.state import Learned
from knightcube.astro.arrays import IntArray
from knightcube.gnc.estimation.error_state import PLAUSIBLE, ErrorState, plausible
from knightcube.gnc.estimation.free_filter import (
    CAMERA,
    COILS,
    DIPOLE,
    FIELD_MATRIX,
    GYRO,
    GYRO_MATRIX,
    INERTIA,
    MAGNET,
    SLOW,
    SUNLIT,
    TORQUES,
    SlowStates,
    density_walk,
)

ERRORS, SOURCES, BODY, LEARNED_AT = "attitude-errors", "attitude-torques", "body", "learned-at"
COIL_FACTORS = "coil-factors"
UNKNOWN_AGE = 86_400.0
"""Largest assumed age (s) of learned states, which is also assumed after the clock was set back."""


def _places(*parts: slice) -> IntArray:
    """Return the indices, counted within the slow states, of slices of the filter's state vector."""
    return np.asarray(np.concatenate([np.arange(part.start, part.stop) for part in parts]) - GYRO.start)


_TORQUES = slice(TORQUES.start - GYRO.start, TORQUES.stop - GYRO.start)
"""Slice of the slow states that holds the amplitudes of the disturbance torques."""
PARTS = {
    ERRORS: _places(GYRO, MAGNET, GYRO_MATRIX, FIELD_MATRIX, CAMERA),
    SOURCES: _places(DIPOLE, SUNLIT, TORQUES),
    BODY: _places(INERTIA, COILS),
}


def learned_of(slow: SlowStates, utc: float) -> dict[str, Learned]:
    """Return the slow states by name, as estimated at a time (UTC, s)."""
    found = {name: Learned.of(slow.values[at], slow.covariance[np.ix_(at, at)]) for name, at in PARTS.items()}
    return {**found, LEARNED_AT: Learned((utc,), ((0.0,),))}


def start_from(
    learned: Mapping[str, Learned],
    layout: ErrorState,
    changed: float,
    utc: float,
    dipole: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[SlowStates, list[str]]:
    """Return the prior of the slow states at a time (UTC, s), and why learned states were rejected.

    The residual dipole that is expected before the first boot is `dipole` (3,), A m^2. Between two boots,
    each state may have changed by the fraction `changed` of its initial standard deviation.
    """
    initial, walks = layout.prior[SLOW, SLOW], layout.walks[SLOW]
    prior = SlowStates(np.zeros(len(initial)), initial.copy())
    prior.values[DIPOLE.start - SLOW.start : DIPOLE.stop - SLOW.start] = dipole
    if LEARNED_AT not in learned:
        return prior, []
    age = utc - learned[LEARNED_AT].values[0]
    if not 0.0 <= age <= UNKNOWN_AGE:
        age = UNKNOWN_AGE
    grown = age * np.diag(walks) + changed**2 * initial
    problems = []
    for name, at in PARTS.items():
        if name not in learned:
            continue
        values, covariance = learned[name].arrays()
        if values.shape != at.shape:
            problems.append(f"{name} has {len(values)} values instead of {len(at)}")
            continue
        if not plausible(values - prior.values[at], initial.diagonal()[at]).all():
            problems.append(f"{name} {values.tolist()}: not within {PLAUSIBLE:g} sigma of the prior")
            continue
        prior.values[at] = values
        prior.covariance[np.ix_(at, at)] = covariance + grown[np.ix_(at, at)]
    prior.covariance[_TORQUES, _TORQUES] += age * density_walk(prior.values[_TORQUES])
    return prior, problems
