"""The attitude over an exposure: samples in time, and a turn at constant rate between one and the next.

Sease 2.12 integrates a constant rate from the start of the exposure; here the attitude that the body really
had is given, so that a slew's acceleration or a jitter shows in the streak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray

DEVICE = "star camera model"
GREATEST_TURN = 0.5 * np.pi
"""Between two samples, rad. Beyond pi the shorter rotation would be the wrong one."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeHistory:
    """Attitudes (k, 4), ICRS into camera, at `times` (k,) s; the first and the last bound the exposure."""

    times: FloatArray
    quaternions: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", np.asarray(self.times, dtype=float))
        object.__setattr__(self, "quaternions", np.asarray(self.quaternions, dtype=float))
        count = len(self.times) if self.times.ndim == 1 else 0
        if count < 2 or self.quaternions.shape != (count, 4):
            raise ValueError(
                f"{DEVICE}: times {self.times.shape} and quaternions {self.quaternions.shape}: "
                "give (k,) and (k, 4), k of 2 or more, from the start to the end of the exposure"
            )
        step = np.diff(self.times)
        if not np.all((step > 0.0) & np.isfinite(step)):
            raise OutOfRange(
                DEVICE, "time between two attitude samples", float(np.min(step)), 0.0, np.inf, "s"
            )
        length = np.linalg.norm(self.quaternions, axis=1)
        worst = float(length[np.argmax(np.abs(length - 1.0))])
        if not abs(worst - 1.0) < 1e-6:
            raise OutOfRange(DEVICE, "norm of an attitude quaternion", worst, 1.0 - 1e-6, 1.0 + 1e-6, "")
        greatest = float(np.max(_turns(self.quaternions)))
        if greatest > GREATEST_TURN:
            raise OutOfRange(DEVICE, "turn between two attitude samples", greatest, 0.0, GREATEST_TURN, "rad")

    @property
    def span(self) -> float:
        """The time from the first sample to the last, s."""
        return float(self.times[-1] - self.times[0])

    def at(self, times: FloatArray) -> FloatArray:
        """Return the attitudes (m, 4) at `times` (m,); extrapolated beyond the ends."""
        return _interpolate(self.times, self.quaternions, times)

    def matrices_at(self, times: FloatArray) -> FloatArray:
        """Return the attitude matrices (m, 3, 3), ICRS into camera, at `times` (m,)."""
        return quaternion.attitude_matrix(self.at(times))

    def knots(self, tolerance: float, longest_turn: float) -> FloatArray:
        """Return times (j,) from start to end between which the motion is smooth and short.

        Between two knots the attitude stays within `tolerance` rad of a turn at constant rate, and turns by
        `longest_turn` rad at most. Smooth motion needs no more knots for being sampled finely.
        """
        last = len(self.times) - 1
        kept = np.arange(last + 1)
        stride = 2
        while stride < 2 * last:
            thinned = np.append(np.arange(0, last, stride), last)
            guess = _interpolate(self.times[thinned], self.quaternions[thinned], self.times)
            if np.max(quaternion.angle_between(guess, self.quaternions)) > tolerance:
                break
            kept = thinned
            stride *= 2
        times = self.times[kept]
        parts = np.maximum(1, np.ceil(_turns(self.quaternions[kept]) / longest_turn)).astype(int)
        within = np.concatenate([np.arange(part) / part for part in parts])
        starts = np.repeat(times[:-1], parts) + within * np.repeat(np.diff(times), parts)
        return np.append(starts, times[-1])


def _interpolate(times: FloatArray, quaternions: FloatArray, wanted: FloatArray) -> FloatArray:
    before = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    start, end = quaternions[before], quaternions[before + 1]
    turn = quaternion.to_rotation_vector(quaternion.multiply(end, quaternion.conjugate(start)))
    share = (wanted - times[before]) / (times[before + 1] - times[before])
    return quaternion.multiply(quaternion.from_rotation_vector(share[:, None] * turn), start)


def _turns(quaternions: FloatArray) -> FloatArray:
    return quaternion.angle_between(quaternions[1:], quaternions[:-1])
