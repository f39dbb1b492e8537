"""Self-test of rarely used coils by short test currents, whose effect on the body's motion is measured.

While a satellite points, its coil currents of a few mA reveal neither an open nor a reversed coil. A coil
that the motion has not confirmed for `interval_ns` is therefore driven alone by a known current with the
signs +, -, -, + in four equal quarters. After these four quarters, neither the rate nor the attitude has
changed. Duration and current of a test follow from the gyro's noise, so that a test measures the gain of a
healthy coil with a standard deviation of 1/`_SHOWN`. The largest rotation angle during a test is the angular
acceleration times the square of the duration of one of the four quarters. `CoilResponse` evaluates the
response, with the errors of the inertia as nuisance parameters. The current monitor compares the supply
current with the command, as at any other time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.loop.coil_response import CoilResponse
from hal.interfaces.devices import COIL_NAMES
from knightcube.astro.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class SelfTestSettings:
    """Settings of the coils' self-test.

    Attributes:
        interval_ns: longest time (ns) without evidence about a coil, after which the coil is tested.
        limits: largest currents (n,), A, of a test.
        gyro_hz: number of gyro samples per second.
    """

    interval_ns: int
    limits: FloatArray
    gyro_hz: float


_SHOWN = 8.0
"""Gain of a healthy coil divided by the standard deviation with which a self-test measures the gain."""
_EFFICIENCY = 0.7
"""Ratio of two standard deviations of a gain: without and with the simultaneous estimation of a constant
torque."""
_SHORTEST_QUARTER, _LONGEST_QUARTER = 1.0, 4.0
"""Minimum and maximum duration (s) of each of the four quarters of a test."""
_GAP_NS = 400_000_000
"""Time (ns) with zero current before a test, during which the magnetic field is measured."""
_CALM_NS = 10_000_000_000
"""Time (ns) for which the commands must be small before a test."""
_QUIET = 0.25
"""Largest commanded current at which a test is made, as a fraction of the largest current of the test."""
_REPORT_NS = 5_000_000_000
"""Time (ns) between the last test and the report, during which the motion is evaluated."""
_NEAR_FIELD_NS = 60_000_000_000
"""Time (ns) after which a coil that was nearly parallel to the magnetic field is tested again."""


class SelfTest:
    """The self-test of all coils."""

    def __init__(self, response: CoilResponse, rate_noise: float, settings: SelfTestSettings) -> None:
        """Set the standard deviation `rate_noise` (rad/s) of a gyro sample."""
        self._response, self._settings = response, settings
        self._least = _SHOWN * rate_noise / (_EFFICIENCY * math.sqrt(4.0 * settings.gyro_hz / 3.0))
        self._shown_ns: list[int | None] = [None] * len(settings.limits)
        self._running: tuple[int, int, int, float] | None = None
        self._loud_ns = 0
        self._tested: dict[int, int] = {}  # end (ns) of each test without a report, by axis

    def request(self) -> None:
        """Test all coils as soon as possible, because the body does not move as commanded."""
        self._shown_ns = [-self._settings.interval_ns] * len(self._shown_ns)

    def stop(self) -> None:
        """End the tests, because a coil is suspected or the correction of a coil has changed."""
        self._running = None
        self._tested.clear()

    def wave(self, wanted: FloatArray, usable: BoolArray, now_ns: int) -> FloatArray | None:
        """Return the test currents (n,), A, that replace the `wanted` currents (n,), or None without a test.

        The currents `wanted` are effective currents. Only coils that are `usable` (n,) are tested.
        """
        if (np.abs(wanted) > _QUIET * self._settings.limits).any():
            self._loud_ns, self._running = now_ns, None
        for axis, shown_ns in enumerate(self._shown_ns):
            if shown_ns is None or self._response.is_healthy(axis):
                self._shown_ns[axis] = now_ns
        if self._running is None and now_ns - self._loud_ns >= _CALM_NS:
            self._begin(usable, now_ns)
        if self._running is None:
            return None
        axis, since_ns, quarter_ns, current = self._running
        quarter = (now_ns - since_ns) // quarter_ns
        currents = np.zeros(len(self._shown_ns))
        if quarter >= 4:
            self._running, self._tested[axis], self._shown_ns[axis] = None, now_ns, now_ns
        elif now_ns >= since_ns:
            currents[axis] = current if quarter in {0, 3} else -current
        return currents

    def report(self, now_ns: int) -> str:
        """Return the results of the last tests as text, once the motion has been evaluated, or ""."""
        if not self._tested or self._running or now_ns - max(self._tested.values()) < _REPORT_NS:
            return ""
        tested, self._tested = sorted(self._tested), {}
        return "; ".join(f"coil {COIL_NAMES[axis]}: {self._response.text(axis)}" for axis in tested)

    def _begin(self, usable: BoolArray, now_ns: int) -> None:
        """Begin the test of the next coil that is due."""
        interval_ns, strength = self._settings.interval_ns, self._response.strength
        if strength is None:
            return
        for axis in np.flatnonzero(usable).tolist():
            shown_ns = self._shown_ns[axis]
            if shown_ns is None or now_ns - shown_ns < interval_ns:
                continue
            current, limit = self._least / float(strength[axis]), float(self._settings.limits[axis])
            quarter = max(_SHORTEST_QUARTER, (current / limit) ** (2.0 / 3.0))
            if quarter > _LONGEST_QUARTER:
                self._shown_ns[axis] = now_ns - interval_ns + _NEAR_FIELD_NS
                continue
            self._running = axis, now_ns + _GAP_NS, round(quarter * 1e9), min(current, limit)
            return
