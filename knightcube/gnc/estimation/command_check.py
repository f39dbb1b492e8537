"""Checks with the gyro whether the coils carry the commanded currents.

A command is an assumption, a measured rate is not. While a coil is broken the model predicts an acceleration
that does not occur: the innovations of the gyro, which agree with their covariance in every healthy flight,
exceed it within one to a few samples. The currents are then unknown, from a little earlier on, and the filter
follows the gyro. A change of the rate that no coil current can cause does not count as contradiction,
because the gyro may be faulty.

The commands are trusted again when the rate follows them. Over the last second the share g of the commanded
change c of the rate is fitted to the gyro samples, z = b + g c. The commands must have moved the body enough
to determine g, g must be 1, and the residuals must be white. A body that is not driven proves nothing. More
gyro noise than assumed raises the scale of the departures and not an alarm.
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
"""Largest mean departure, in its standard deviations, by the number of consecutive samples that are averaged.
Strong faults show in one sample, weak ones in the mean of many. Healthy flights reach 2.8, 4.0 and 7.0; over
more samples the errors of the model add up."""
_BEFORE_NS = 500_000_000
"""Time (ns) before the first sample of a departure from which the currents are unknown. The effects of a weak
fault on the other states before its detection are undone."""
_MAXIMUM_CHANGE = 3.0
"""Largest explained departure, as a multiple of the largest change of the rate by the coils: a reversed coil
departs by two, and the age of a sample is uncertain."""
_SHORTEST_GAP, _LONGEST_GAP = 0.025, 0.25
"""Bounds of the time (s) between samples over which currents may have acted: a longer gap would explain any
departure."""
_PROOF = 1.0
"""Duration (s) of the samples that confirm the commands again."""
_SHARE_SIGMA = 0.2
"""Largest standard deviation of the fitted share that proves something."""
_WHITE = 0.5
"""Minimum ratio of half the mean squared successive difference of the residuals to their mean square. The
ratio is one for white noise (von Neumann 1941) and near zero for a drift."""
_SCALE_OVER = 64.0
"""Number of samples over which the scale of the departures is averaged."""
_SHARE_ERROR = 0.15
"""Error of the share that the error of the modelled coil gain explains."""


class CommandCheck:
    """Compares the gyro samples with the commands.

    Attributes:
        active: whether the coils may carry other currents than commanded.
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
        """Return the time from which on the currents are unknown if the newest checkpoint raises the alarm.

        Otherwise, and for a checkpoint of another measurement than a rate, return None.
        """
        rate = newest.measurement
        if not isinstance(rate, RateMeasurement) or not self._model.noise.unknown_current:
            return None
        if self.active:
            self._test_recovery(newest.state, rate)
            return None
        assert newest.variance is not None  # only the first checkpoint, which is not judged, has none
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
        """Return whether coil currents together with the noise can have caused a departure."""
        assert newest.variance is not None
        gap = (newest.time_ns - self._departures[-1][0]) * 1e-9 if self._departures else _SHORTEST_GAP
        # The largest change of the rate, rad/s, by unknown currents.
        state, model, duration = newest.state, self._model, min(max(gap, _SHORTEST_GAP), _LONGEST_GAP)
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        change = model.noise.unknown_current * np.abs(idle.by_current).sum(axis=1) * duration
        most = np.asarray(change[self._axes])
        noise = _DEPARTURES[1] * self._scale * np.sqrt(newest.variance.diagonal())
        return bool((np.abs(newest.innovation) <= noise + _MAXIMUM_CHANGE * most).all())

    def _test_recovery(self, state: FilterState, rate: RateMeasurement) -> None:
        """Record a sample, and trust the commands again if the rate follows them."""
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
        """Return whether the recorded rates are b + c, c the commanded changes.

        Set the scale of the noise.
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
        """Return the modelled change of the rate, rad/s, by the commanded coils and by all other causes."""
        commanded, natural = np.zeros(3), np.zeros(3)
        for torquing, span_ns in self._model.commands.spans(from_ns, to_ns):
            found = self._model.body.accelerate(state.quaternion, state.rate, state.parameters, torquing)
            by_coils = state.parameters.gain * np.array(found.by_parameters)[:, 2]
            commanded += span_ns * 1e-9 * by_coils
            natural += span_ns * 1e-9 * (np.array(found.acceleration) + state.disturbance - by_coils)
        return commanded[self._axes], natural[self._axes]

    def _variance(self, state: FilterState, rate: RateMeasurement) -> FloatArray:
        """Return the variance of a sample, including that of the coils' noise after half of `_PROOF`."""
        model = self._model
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        by_coils = 0.5 * _PROOF * model.noise.current * (idle.by_current**2).sum(axis=1)
        return np.asarray((rate.covariance.diagonal() + by_coils)[self._axes])
