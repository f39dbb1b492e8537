"""Decides from the gyro whether the coils carry the commanded currents.

A command is an assumption, a measured rate is not. While a coil is broken the model predicts an acceleration
that does not happen: the gyro's innovations, as large as their covariance in every healthy flight, leave it
within one to a few samples. The currents are then unknown, from a little before, and the filter follows the
gyro. A change of the rate that no coil current can cause is no reason: then the gyro itself is in doubt.

The commands are trusted again when the rate follows them: over the last second a share g of the commanded
change c of the rate is fitted to the gyro's samples, z = b + g c. The commands must have moved the body
enough to fix g, g must be 1, and the residuals must be white. A body that is not driven proves nothing. A
gyro with more noise than assumed raises the scale of its departures, not a doubt.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.measurements import RateMeasurement
from knightcube.gnc.estimation.replay import Checkpoint, Model
from knightcube.gnc.estimation.state import State

_SURPRISE = {1: 5.5, 4: 5.5, 16: 7.5}
"""By the number of samples in a row, the standard deviations of their mean departure that begin a doubt.

Strong faults show in one sample, weak ones in the mean of many. Healthy flights reach 2.8, 4.0 and 7.0; over
more samples the model's errors add up.
"""
_BEFORE_NS = 500_000_000
"""The currents are unknown from this long before the first sample of a departure.

What a weak fault did to the other states before it showed is undone.
"""
_MOST = 3.0
"""Of the largest change: a reversed coil departs by two, and a sample's age is uncertain."""
_SHORTEST_GAP, _LONGEST_GAP = 0.025, 0.25
"""s between samples, over which currents may have acted: a longer silence would explain any departure."""
_PROOF = 1.0
"""s: the samples of this time prove the commands again."""
_KNOWN_SHARE = 0.2
"""Standard deviation of the fitted share below which the share proves something."""
_WHITE = 0.5
"""Least half mean square of the residuals' differences over their mean square: one for white noise (von
Neumann 1941), near zero for a drift."""
_SCALE_OVER = 64.0
"""Samples over which the scale of the departures is averaged."""
_SHARE_ERROR = 0.15
"""Error of the share that the model's own error of the coils' gain explains."""


class CommandDoubt:
    """Judges the commands by the gyro's samples.

    Attributes:
        active: whether the commanded currents may not flow.
        ended_ns: when they were trusted again last.
    """

    def __init__(self, model: Model) -> None:
        self.active = False
        self.ended_ns = 0
        self._model = model
        self._scale = 1.0
        self._axes = slice(1, 2) if model.body.suspended else slice(3)
        self._departures: deque[tuple[int, list[float]]] = deque(maxlen=max(_SURPRISE))
        self._samples: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._natural: FloatArray = np.zeros(1)
        self._commanded: FloatArray = np.zeros(1)

    def judge(self, newest: Checkpoint) -> int | None:
        """Judge by the newest checkpoint, if it is of a rate and the body has coils.

        Returns the time from which on the currents are unknown when a doubt begins, else None.
        """
        rate = newest.measurement
        if not isinstance(rate, RateMeasurement) or not self._model.noise.unknown_current:
            return None
        if self.active:
            self._weigh(newest.state, rate)
            return None
        return self._compare(newest)

    def _compare(self, newest: Checkpoint) -> int | None:
        """Test the departures from the model."""
        assert newest.variance is not None  # only the first checkpoint has none, and it is not judged
        spreads = [math.sqrt(variance) for variance in newest.variance.diagonal().tolist()]
        departure = [value / spread for value, spread in zip(newest.innovation, spreads, strict=True)]
        most = _SURPRISE[1] * self._scale
        if not all(abs(value) <= most for value in departure) and not self._explains(newest):
            return None
        self._departures.append((newest.time_ns, [value / self._scale for value in departure]))
        size = min(sum(value * value for value in departure) / len(departure), _SURPRISE[1] ** 2)
        self._scale = math.sqrt(max(1.0, self._scale**2 + (size - self._scale**2) / _SCALE_OVER))
        recent = [value for _, value in reversed(self._departures)]
        for count, limit in _SURPRISE.items():
            sums = map(sum, zip(*recent[:count], strict=True))
            if count <= len(recent) and any(abs(total) > limit * math.sqrt(count) for total in sums):
                since_ns = self._departures[-count][0] - _BEFORE_NS
                self.active = True
                self._forget()
                return since_ns
        return None

    def _explains(self, newest: Checkpoint) -> bool:
        """Return whether coil currents can have caused a departure, beside the noise."""
        assert newest.variance is not None
        gap = (newest.time_ns - self._departures[-1][0]) * 1e-9 if self._departures else _SHORTEST_GAP
        most = self._most_change(newest.state, min(max(gap, _SHORTEST_GAP), _LONGEST_GAP))
        noise = _SURPRISE[1] * self._scale * np.sqrt(newest.variance.diagonal())
        return bool((np.abs(newest.innovation) <= noise + _MOST * most).all())

    def _weigh(self, state: State, rate: RateMeasurement) -> None:
        """Note a sample, and end the doubt when the rate follows the commands."""
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
        """Return whether the noted rates are b + c, with c the commanded changes; set the noise's scale."""
        _, rates, commanded = zip(*self._samples, strict=True)
        weight = 1.0 / np.sqrt(variance)
        z, c = ((np.array(values) - np.mean(values, axis=0)) * weight for values in (rates, commanded))
        information = float((c * c).sum())
        if information * _KNOWN_SHARE**2 < 1.0:
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

    def _most_change(self, state: State, duration: float) -> FloatArray:
        """Return the largest change of the rate, rad/s, that unknown currents can cause in `duration` s."""
        model = self._model
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        change = model.noise.unknown_current * np.abs(idle.by_current).sum(axis=1) * duration
        return np.asarray(change[self._axes])

    def _changes(self, state: State, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the model's change of the rate, rad/s, by the coils as commanded and by all else."""
        commanded, natural = np.zeros(3), np.zeros(3)
        for torquing, span_ns in self._model.commands.spans(from_ns, to_ns):
            found = self._model.body.accelerate(state.quaternion, state.rate, state.parameters, torquing)
            by_coils = state.parameters.gain * np.array(found.by_parameters)[:, 2]
            commanded += span_ns * 1e-9 * by_coils
            natural += span_ns * 1e-9 * (np.array(found.acceleration) + state.disturbance - by_coils)
        return commanded[self._axes], natural[self._axes]

    def _variance(self, state: State, rate: RateMeasurement) -> FloatArray:
        """Return the variance of a sample, with that of the coils' noise in the middle of a proof."""
        model = self._model
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        by_coils = 0.5 * _PROOF * model.noise.current * (idle.by_current**2).sum(axis=1)
        return np.asarray((rate.covariance.diagonal() + by_coils)[self._axes])
