"""A small current wave on one axis at a time, to distinguish coil faults that readings alone cannot."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray


class Probe:
    """Applies a zero-mean square wave to one axis after the other.

    The two halves last `half_ns` each and carry +`current` and -`current` A: they make no mean torque.
    """

    def __init__(self, current: float, half_ns: int) -> None:
        self._current = current
        self._half_ns = half_ns
        self._running: tuple[int, int] | None = None  # axis, and since when
        self._tried: set[int] = set()

    def begin(self, axes: set[int], now_ns: int) -> int | None:
        """Begin a wave on the next untried of `axes`; return the wave's end, None when all were tried."""
        candidates = sorted(axes - self._tried)
        if not candidates:
            self._tried.clear()
            return None
        self._tried.add(candidates[0])
        self._running = (candidates[0], now_ns)
        return now_ns + 2 * self._half_ns

    def stop(self) -> None:
        """End the wave; count all axes as untried."""
        self._running = None
        self._tried.clear()

    def wave(self, now_ns: int) -> FloatArray:
        """Return (3,) A to be added to the commands at `now_ns`."""
        wave = np.zeros(3)
        if self._running is not None:
            axis, since_ns = self._running
            half = (now_ns - since_ns) // self._half_ns
            if half < 2:
                wave[axis] = self._current * (1.0 if half == 0 else -1.0)
            else:
                self._running = None
        return wave
