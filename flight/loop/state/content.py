"""What is kept: typed, bounded, checked. UTC is a label for people; nothing is reckoned with it."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from flight.gnc.math.arrays import FloatArray

Count = Annotated[int, Meta(ge=0, le=2**53)]
Seconds = Annotated[float, Meta(ge=0.0)]
LONGEST_LABEL = 32
Label = Annotated[str, Meta(max_length=LONGEST_LABEL)]

REMEMBERED = 32
"""How many unclean shutdowns are kept, the newest."""


class Kept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the state; unknown keys are refused."""


class Learned(Kept, frozen=True):
    """Parameters learned in flight: `values` (n,) and their covariance (n, n), by rows, in SI units."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=16)]
    covariance: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(values: FloatArray, covariance: FloatArray) -> Learned:
        """Return arrays as what is kept; the covariance is made symmetric to the last bit."""
        even = 0.5 * (covariance + covariance.T)
        return Learned(tuple(values.tolist()), tuple(map(tuple, even.tolist())))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return values (n,) and covariance (n, n)."""
        return np.array(self.values), np.array(self.covariance)


class UncleanShutdown(Kept, frozen=True):
    """A boot that ended without saying so: its number, the operating time when last heard of, a label."""

    boot: Count
    operated: Seconds
    utc: Label


class StoredState(Kept, frozen=True, kw_only=True):
    """All that is kept.

    Attributes:
        boot_count: how often the application has started.
        operated: s, that it has run in all, by the monotonic clock: the time in which crashes are counted.
        running: set at the start and cleared at a clean end.
        unclean: shutdowns that were not clean, oldest first.
        mode: the mode when last heard of.
        utc: when it was last heard of: a label.
        learned: parameters by name.
        devices: of which devices they were learned: a digest of what the configuration says of them.
    """

    boot_count: Count = 0
    operated: Seconds = 0.0
    running: bool = False
    unclean: Annotated[tuple[UncleanShutdown, ...], Meta(max_length=REMEMBERED)] = ()
    mode: Label = ""
    utc: Label = ""
    learned: Annotated[dict[Label, Learned], Meta(max_length=32)] = {}
    devices: Label = ""


def check(state: StoredState) -> None:
    """Raise ValueError for what must not be kept: a number that is not finite, a covariance that is none."""
    if not all(
        math.isfinite(t) for t in (state.operated, *(shutdown.operated for shutdown in state.unclean))
    ):
        raise ValueError("an operating time is not finite")
    for name, learned in state.learned.items():
        size = len(learned.values)
        if [len(row) for row in learned.covariance] != [size] * size:
            raise ValueError(f"{name}: the covariance of {size} values is no {size} x {size} matrix")
        values, covariance = learned.arrays()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise ValueError(f"{name}: a value or its covariance is not finite")
        if not np.array_equal(covariance, covariance.T):
            raise ValueError(f"{name}: the covariance is not symmetric")
        scale = float(np.max(np.abs(covariance)))
        if scale > 0.0 and float(np.linalg.eigvalsh(covariance / scale)[0]) < -1e-9:
            raise ValueError(f"{name}: the covariance has a negative eigenvalue")
