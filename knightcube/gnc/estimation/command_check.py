"""Checks with the gyro whether the coils carry the commanded currents.

While a coil is broken, the model predicts an acceleration that does not occur. The innovations of the gyro
then exceed their covariance within one to a few samples, which they do not in a healthy flight. The filter
from then on treats the coil currents as unknown, also for the last half second, and follows the gyro. A
change of the rate that no coil current can cause does not contradict the commands, because the gyro may be
faulty.

The commands are trusted again when the rate follows the commands. The model z = b + g c is fitted to the gyro
samples z of the last second, where c is the change of the rate that the commands should cause. The response g
must be determined well, be 1 within its uncertainty, and leave white residuals. A body whose coils are not
driven therefore never restores the trust. If the gyro is noisier than assumed, the check widens its limits
and does not raise an alarm.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import FilterState
from knightcube.gnc.estimation.measurements import RateMeasurement
from knightcube.gnc.estimation.replay import Checkpoint, PropagationModel

_DEPARTURES = {1: 5.5, 4: 5.5, 16: 7.5}
"""Largest mean innovation of the gyro, in standard deviations, for each number of samples that are averaged.
A strong fault is detected in one sample, a weak fault only in the mean of many samples. Healthy flights reach
2.8, 4.0 and 7.0 standard deviations in the means of 1, 4 and 16 samples."""
_BEFORE_NS = 500_000_000
"""Time (ns) by which the currents are treated as unknown before the first contradicting sample. The earlier
start undoes the effects that a weak fault has on the other states before the fault is detected."""
_MAXIMUM_CHANGE = 3.0
"""Largest innovation that a coil fault can explain, as a multiple of the largest change of the rate by the
coils. A reversed coil causes twice the change of the rate, and the uncertain age of a sample adds to this."""
_SHORTEST_GAP, _LONGEST_GAP = 0.025, 0.25
"""Bounds of the time (s) between gyro samples during which wrong coil currents may have acted. Without an
upper bound, a coil fault during a long gap could explain any innovation."""
_PROOF = 1.0
"""Time span (s) of the gyro samples that must confirm the commands before the commands are trusted again."""
_SHARE_SIGMA = 0.2
"""Largest standard deviation of the fitted response g at which the commands can be confirmed."""
_WHITE = 0.5
"""Minimum ratio, for white residuals, of half their mean squared successive difference to their mean square.
This ratio of the residuals is one for white noise (von Neumann 1941) and near zero for a drift."""
_SCALE_OVER = 64.0
"""Number of gyro samples over which the scale of the gyro noise is averaged."""
_SHARE_ERROR = 0.15
"""Deviation of the fitted response g from 1 that the error of the modelled coil gain can explain."""


class CommandCheck:
    """Check of the commanded coil currents against the gyro samples.

    Attributes:
        active: whether the coils are suspected to carry other currents than commanded.
        ended_ns: time at which the commands were last trusted again.
    """

    def __init__(self, model: PropagationModel) -> None:
        self.active = False
        self.ended_ns = 0
        self._model = model
        self._scale = 1.0
        self._axes = slice(1, 2) if model.body.suspended else slice(3)
        self._departures: deque[tuple[int, list[float]]] = deque(maxlen=max(_DEPARTURES))
        self._samples: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._natural: FloatArray = np.zeros(1)
        self._commanded: FloatArray = np.zeros(1)

    def judge(self, newest: Checkpoint) -> int | None:
        """Return the time (ns) since which the currents are unknown if the newest checkpoint raises an alarm.

        Return None without an alarm, and if the measurement of the checkpoint is not a gyro rate.
        """
        rate = newest.measurement
        if not isinstance(rate, RateMeasurement) or not self._model.noise.unknown_current:
            return None
        if self.active:
            self._test_recovery(newest.state, rate)
            return None
        assert newest.variance is not None  # only the first checkpoint has no variance, and it is not checked
        spreads = [math.sqrt(variance) for variance in newest.variance.diagonal().tolist()]
        departure = [value / spread for value, spread in zip(newest.innovation, spreads, strict=True)]
        largest = _DEPARTURES[1] * self._scale
        if not all(abs(value) <= largest for value in departure) and not self._explains(newest):
            return None
        self._departures.append((newest.time_ns, [value / self._scale for value in departure]))
        size = min(sum(value * value for value in departure) / len(departure), _DEPARTURES[1] ** 2)
        self._scale = math.sqrt(max(1.0, self._scale**2 + (size - self._scale**2) / _SCALE_OVER))
        recent = [value for _, value in reversed(self._departures)]
        for count, limit in _DEPARTURES.items():
            sums = map(sum, zip(*recent[:count], strict=True))
            if count <= len(recent) and any(abs(total) > limit * math.sqrt(count) for total in sums):
                since_ns = self._departures[-count][0] - _BEFORE_NS
                self.active = True
                self._forget()
                return since_ns
        return None

    def _explains(self, newest: Checkpoint) -> bool:
        """Return whether wrong coil currents together with the noise can explain the newest innovation."""
        assert newest.variance is not None
        gap = (newest.time_ns - self._departures[-1][0]) * 1e-9 if self._departures else _SHORTEST_GAP
        # Below, `change` is the largest change of the rate (rad/s) that unknown currents can cause.
        state, model, duration = newest.state, self._model, min(max(gap, _SHORTEST_GAP), _LONGEST_GAP)
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        change = model.noise.unknown_current * np.abs(idle.by_current).sum(axis=1) * duration
        most = np.asarray(change[self._axes])
        noise = _DEPARTURES[1] * self._scale * np.sqrt(newest.variance.diagonal())
        return bool((np.abs(newest.innovation) <= noise + _MAXIMUM_CHANGE * most).all())

    def _test_recovery(self, state: FilterState, rate: RateMeasurement) -> None:
        """Record a gyro sample, and trust the commands again if the rate follows the commands."""
        before_ns = self._samples[-1][0] if self._samples else rate.time_ns
        commanded, natural = self._changes(state, before_ns, rate.time_ns)
        self._natural = self._natural + natural
        self._commanded = self._commanded + commanded
        self._samples.append((rate.time_ns, rate.rate[self._axes] - self._natural, self._commanded))
        while rate.time_ns - self._samples[0][0] > _PROOF * 1e9:
            self._samples.popleft()
            if self._follows(self._variance(state, rate)):
                self.active, self.ended_ns = False, rate.time_ns
                self._forget()
                return

    def _follows(self, variance: FloatArray) -> bool:
        """Return whether the recorded rates are a constant plus the changes that the commands should cause.

        If so, also set the scale of the gyro noise.
        """
        _, rates, commanded = zip(*self._samples, strict=True)
        weight = 1.0 / np.sqrt(variance)
        z, c = ((np.array(values) - np.mean(values, axis=0)) * weight for values in (rates, commanded))
        information = float((c * c).sum())
        if information * _SHARE_SIGMA**2 < 1.0:
            return False
        share = float((c * z).sum()) / information
        residual = z - share * c
        noise, jumps = float((residual**2).mean()), 0.5 * float((np.diff(residual, axis=0) ** 2).mean())
        scale = math.sqrt(max(1.0, noise))
        if jumps < _WHITE * noise or abs(share - 1.0) > _SHARE_ERROR + 3.0 * scale / math.sqrt(information):
            return False
        self._scale = scale
        return True

    def _forget(self) -> None:
        self._departures.clear()
        self._samples.clear()
        self._natural = self._commanded = np.zeros(1)

    def _changes(self, state: FilterState, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the modelled changes of the rate (rad/s) by the coil commands and by all other causes."""
        commanded, natural = np.zeros(3), np.zeros(3)
        for torquing, span_ns in self._model.commands.spans(from_ns, to_ns):
            found = self._model.body.accelerate(state.quaternion, state.rate, state.parameters, torquing)
            by_coils = state.parameters.gain * np.array(found.by_parameters)[:, 2]
            commanded += span_ns * 1e-9 * by_coils
            natural += span_ns * 1e-9 * (np.array(found.acceleration) + state.disturbance - by_coils)
        return commanded[self._axes], natural[self._axes]

    def _variance(self, state: FilterState, rate: RateMeasurement) -> FloatArray:
        """Return the variance of a gyro sample plus that of the rate due to the noise of the coils."""
        model = self._model
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        by_coils = 0.5 * _PROOF * model.noise.current * (idle.by_current**2).sum(axis=1)
        return np.asarray((rate.covariance.diagonal() + by_coils)[self._axes])
