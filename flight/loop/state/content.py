"""The stored state: typed, bounded, validated. UTC is a label for people, never used in computations."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from knightcube.astro.arrays import FloatArray

Count = Annotated[int, Meta(ge=0, le=2**53)]
Seconds = Annotated[float, Meta(ge=0.0)]
LONGEST_LABEL = 32
Label = Annotated[str, Meta(max_length=LONGEST_LABEL)]

REMEMBERED = 32
"""How many unclean shutdowns are kept, the newest."""


class Kept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the state; unknown keys are rejected."""


class Learned(Kept, frozen=True):
    """Parameters learned in flight: `values` (n,) and their covariance (n, n), by rows, in SI units."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=16)]
    covariance: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(values: FloatArray, covariance: FloatArray) -> Learned:
        """Return the stored form of arrays; the covariance is made exactly symmetric."""
        even = 0.5 * (covariance + covariance.T)
        return Learned(tuple(values.tolist()), tuple(map(tuple, even.tolist())))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return values (n,) and covariance (n, n)."""
        return np.array(self.values), np.array(self.covariance)


class UncleanShutdown(Kept, frozen=True):
    """An unclean shutdown: boot number, and operating time and UTC label of its last stored state."""

    boot: Count
    operated: Seconds
    utc: Label


class KeptTable(Kept, frozen=True, kw_only=True):
    """A table of parameters that was loaded: values by the configuration's keys.

    Attributes:
        before: the values that flew before it, empty for those of the configuration.
        proven: whether it has flown long enough to be trusted after an unclean shutdown.
        loads: tables loaded so far.
    """

    values: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    before: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    proven: bool = True
    loads: Count = 0


class StoredState(Kept, frozen=True, kw_only=True, omit_defaults=True):
    """The stored state.

    Attributes:
        boot_count: how often the application has started.
        operated: s, total operating time by the monotonic clock: the time scale of crash counts.
        running: set at the start and cleared at a clean end.
        unclean: unclean shutdowns, oldest first.
        mode: the mode at the last write.
        utc: a label of the last write.
        learned: parameters by name.
        devices: digest of the configuration of the devices that the parameters belong to.
        table: the table of parameters that an operator loaded.
    """

    boot_count: Count = 0
    operated: Seconds = 0.0
    running: bool = False
    unclean: Annotated[tuple[UncleanShutdown, ...], Meta(max_length=REMEMBERED)] = ()
    mode: Label = ""
    utc: Label = ""
    learned: Annotated[dict[Label, Learned], Meta(max_length=32)] = {}
    devices: Label = ""
    table: KeptTable = KeptTable()


def check(state: StoredState) -> None:
    """Raise ValueError for a state that must not be stored: a non-finite number, an invalid covariance."""
    if not all(
        math.isfinite(t) for t in (state.operated, *(shutdown.operated for shutdown in state.unclean))
    ):
        raise ValueError("an operating time is not finite")
    tables = (state.table.values, state.table.before)
    if not all(math.isfinite(value) for table in tables for value in table.values()):
        raise ValueError("a parameter is not finite")
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
