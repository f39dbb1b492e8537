"""A record as one sequence of events: steps under a constant current, ending in a sample or in a switch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground.identification.record import Record
from knightcube.astro.arrays import FloatArray, IntArray

LONGEST_STEP = 0.025
_CLIPPED_VARIANCE = 100.0
"""By how much more the current's variance is where it is at the limit: its mean is not known there."""


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Events in order of time, from a record's first sample to its last.

    Attributes:
        span: (k,) s since the event before.
        current: (k,) A that stood meanwhile.
        variance: (k,) of it, relative to that of a coil that is on; zero where it is off.
        sample: (k,) index of the sample taken then, -1 for none.
        jump: (k,) A by which the current rises then.
    """

    span: FloatArray
    current: FloatArray
    variance: FloatArray
    sample: IntArray
    jump: FloatArray

    @classmethod
    def of(cls, record: Record, delay: float) -> Timeline:
        """Lay the events of `record`, each switch `delay` s late; no current is known before the first."""
        switch = record.switch_time + delay
        inside = (switch > record.time[0]) & (switch < record.time[-1])
        cuts = _cuts(record.time)
        times = np.concatenate([record.time[1:], switch[inside], cuts])
        samples = len(record.time) - 1
        sample = np.append(np.arange(1, samples + 1), np.full(len(times) - samples, -1))
        jump = np.zeros(len(times))
        jump[samples : len(times) - len(cuts)] = np.diff(record.current, prepend=0.0)[inside]
        order = np.lexsort((sample < 0, times))  # at one instant first the sample, then the switch
        times = times[order]
        standing = np.searchsorted(switch, times, side="left")  # switches before, its own not counted
        current = np.append(0.0, record.current)[standing]
        clipped = np.append(False, record.clipped)[standing]
        variance = np.where(current == 0.0, 0.0, np.where(clipped, _CLIPPED_VARIANCE, 1.0))
        return cls(np.diff(times, prepend=record.time[0]), current, variance, sample[order], jump[order])


def _cuts(time: FloatArray) -> FloatArray:
    """Return instants that divide intervals between samples that are longer than a step."""
    gaps = np.diff(time)
    wide = np.flatnonzero(gaps > 1.5 * LONGEST_STEP)
    parts = [np.linspace(time[i], time[i + 1], int(gaps[i] / LONGEST_STEP) + 2)[1:-1] for i in wide.tolist()]
    return np.concatenate(parts) if parts else np.empty(0)
