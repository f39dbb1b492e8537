"""What the satellite's filter learned, stored for the next boot, and taken up by it.

Two parts without what they share: `attitude-errors` has the biases of gyro and magnetometer and the turn of
the principal axes, `attitude-torques` the residual dipole in shadow and sunlight and the torques. A third,
`learned-at`, is the time (UTC, s) at which they were known so well: until the next boot each state walks on
as in flight, and may have `changed` by a part of its deviation at the start, as a unit that was switched off
has another bias.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flight.loop.state.content import Learned
from knightcube.astro.arrays import IntArray
from knightcube.gnc.estimation.free_filter import SlowStates
from knightcube.gnc.estimation.free_motion import AXES, DIPOLE, GYRO, MAGNET, SUNLIT, TORQUES
from knightcube.gnc.estimation.free_settings import BELIEVED, FreeFilterSettings

ERRORS, SOURCES, LEARNED_AT = "attitude-errors", "attitude-torques", "learned-at"
UNKNOWN_AGE = 86_400.0
"""s: taken for an age that a clock that was put back denies, and the longest: then little is left anyway."""


def _places(*parts: slice) -> IntArray:
    """Return where parts of the filter's state stand among the slow states."""
    return np.concatenate([np.arange(part.start, part.stop) for part in parts]) - GYRO.start


PARTS = {ERRORS: _places(GYRO, MAGNET, AXES), SOURCES: _places(DIPOLE, SUNLIT, TORQUES)}


def learned_of(slow: SlowStates, utc: float) -> dict[str, Learned]:
    """Return the slow states by name, as known at a time (UTC, s)."""
    found = {name: Learned.of(slow.values[at], slow.covariance[np.ix_(at, at)]) for name, at in PARTS.items()}
    return {**found, LEARNED_AT: Learned((utc,), ((0.0,),))}


def start_from(
    learned: Mapping[str, Learned], settings: FreeFilterSettings, changed: float, utc: float
) -> tuple[SlowStates, list[str]]:
    """Return the filter's prior at a time (UTC, s), and why what was learned was rejected.

    Since then a state may have changed by the part `changed` of its deviation at the start.
    """
    start, walks = settings.of_slow(0), settings.of_slow(1)
    prior = SlowStates(np.zeros(len(start)), np.diag(start**2))
    if LEARNED_AT not in learned:
        return prior, []
    age = utc - learned[LEARNED_AT].values[0]
    if not 0.0 <= age <= UNKNOWN_AGE:
        age = UNKNOWN_AGE
    grown = walks**2 * age + (changed * start) ** 2
    problems = []
    for name, at in PARTS.items():
        if name not in learned:
            continue
        values, covariance = learned[name].arrays()
        if values.shape != at.shape or not settings.believes(values, at).all():
            problems.append(f"{name} {values.tolist()}: not within {BELIEVED:g} sigma of what is expected")
            continue
        prior.values[at] = values
        prior.covariance[np.ix_(at, at)] = covariance + np.diag(grown[at])
    return prior, problems
