"""Estimation of the torque gain of each coil from the motion of the body.

The class `CoilResponse` estimates the torque gain of each coil from the body's angular acceleration over some
seconds. The measured rate and the commanded rate change, which is the integral of J^-1 (m x B), are averaged
over short bins. Differences of neighbouring bins yield accelerations. A generalised least squares fit over
the last bins estimates the gain of each coil, together with a constant disturbance, a torsion and a damping
about each free axis. The fit accounts for the correlated noise of neighbouring differences. The gain is 1 for
a healthy coil, 0 for a coil without torque, and -1 for a reversed coil. If the commands vary too little, the
standard deviation of the gain is large, and the fit yields no finding about the axis. A gain larger than
`LARGEST_GAIN` is physically impossible and shows that the model is wrong; then the fit yields no finding
about any axis.

The torques of all coils are normal to the field, so that the gains of the coils can hardly be separated
within a short time. The gain of each coil is therefore estimated under the assumption that the other coils
are healthy. The gains of healthy coils may differ from 1 by the relative errors of the configured coil
dipoles. A fault of an axis is diagnosed only if it explains the motion clearly better than a fault of another
axis. A coil is considered reversed if a reversed coil explains the motion far better than healthy coils.

The axes of healthy coils differ from the configured axes. In a field along the axis of a strong coil, a tilt
of this coil by some degrees causes as much torque as half the dipole of a weak coil. For a free body, the fit
therefore estimates the tilts as nuisance parameters, so that the standard deviations of the gains include the
uncertainty of the axes.

While a free body tumbles, its gyroscopic acceleration is a hundred times the acceleration by the coils, so
that an inertia error of 2 % can make healthy coils appear reversed. The fit therefore subtracts the
gyroscopic acceleration for the assumed inertia, and estimates the remaining error by nuisance parameters
(`knightcube.gnc.estimation.rigid_body`). The aerodynamic torque and the torque of the residual dipole change
while the body rotates, and the commands of pointing counteract them, which can make healthy coils appear weak
or reversed. The fit therefore admits a random walk of the disturbance, whose magnitude follows from the
largest expected disturbance. If the coils' own field at the magnetometer is comparable with the Earth's
field, the fit uses the field measured in the last pause of the coils, rotated with the body.

The residual accelerations, computed for healthy coils, are stored for a longer time. If the residual
accelerations change together with the supply current, a coil is broken; otherwise the current monitor is
faulty (`observed_share`). The class `MotionWitness` compares diagnoses of broken coils with the residual
accelerations.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from flight.loop.coil_currents import NEWEST, Bounds, CoilFault, Supplied
from hal.interfaces.devices import NO_AXES, Axes, PowerReading
from knightcube.astro.arrays import FloatArray, IntArray, tangent_basis
from knightcube.compiled import compiled_form_of
from knightcube.gnc.estimation.rigid_body import (
    BodyErrors,
    coefficient_modes,
    fitted_gains,
    gyroscopic_coefficients,
    rate_products,
    whitenings,
)

_SAMPLES_NS = 25_000_000
"""Step (ns) in which recorded commands are sampled, which is one control cycle."""
_NOTED_LATE_NS = 25_000_000
"""Time (ns) from the sending of a command to its record, which is one control cycle."""


class CoilCommands:
    """Record of the commanded currents and of the braking; `braked` lists the bridges that are braked now."""

    def __init__(self, reach_ns: int) -> None:
        """Store commands for `reach_ns` ns."""
        self._reach_ns = reach_ns
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque()
        self._braked_ns = 0
        self.braked = NO_AXES

    def __bool__(self) -> bool:
        """Return whether any command was recorded."""
        return bool(self._commands)

    @property
    def newest_ns(self) -> int:
        """The time (ns) of the newest command."""
        return self._commands[-1][0]

    def note(self, time_ns: int, currents: tuple[float, ...], braked: Axes) -> None:
        """Record the currents (n,), A, and the braking in force from `time_ns` on."""
        if braked != self.braked:
            self._braked_ns, self.braked = time_ns, braked
        self._commands.append((time_ns, currents))
        horizon = time_ns - self._reach_ns
        while len(self._commands) > 1 and self._commands[1][0] <= horizon:
            self._commands.popleft()

    def is_known_since(self, time_ns: int) -> bool:
        """Return whether all commands since `time_ns` are recorded and the braking has not changed since."""
        return time_ns >= max(self._braked_ns, self._commands[0][0])

    def window(self, begin_ns: int, end_ns: int) -> list[tuple[float, ...]]:
        """Return the commands (k, n), A, that may be in force between two times, sampled in equal steps."""
        earlier = reversed(self._commands)
        since_ns, currents = next(earlier)
        sampled: list[tuple[float, ...]] = []
        for time_ns in reversed(range(begin_ns, end_ns + _NOTED_LATE_NS + 1, _SAMPLES_NS)):
            while since_ns > time_ns:
                since_ns, currents = next(earlier, (time_ns, currents))
            sampled.append(currents)
        return sampled[::-1]

    def supplied(self, reading: PowerReading, bounds: Bounds, known: Mapping[int, CoilFault]) -> Supplied:
        """Return the newest ADC sample, with bounds of the supply current for the `known` faults only."""
        window = self.window(reading.newest_since_ns, reading.time_ns)
        free = [axis for axis, fault in known.items() if fault in {CoilFault.SHORTED, CoilFault.UNCERTAIN}]
        unsure = [axis for axis, fault in known.items() if fault is not CoilFault.SHORTED]
        driven = [any(column) for column in zip(*window, strict=True)]
        totals = [sum(map(abs, currents)) for currents in window]
        lowest, highest = min(totals), max(totals)
        sure = lowest
        if unsure:
            sure = float(np.abs(np.delete(window, unsure, axis=1)).sum(axis=1).min())
        slack = sum(driven) * bounds.uncertainty + bounds.noise
        error = bounds.gain + NEWEST.scatter
        return Supplied(
            reading.newest,
            least=sure * (1.0 - error) - slack,
            most=highest * (1.0 + error) + slack + sum(bounds.full_current[axis] for axis in free),
            at_rest=[axis for axis in range(len(driven)) if not driven[axis] and axis not in known],
            driven=any(driven),
            spread=highest - lowest,
        )


@dataclass(frozen=True, slots=True)
class ResponseSettings:
    """Settings of the fit of the coil gains to the motion of the body.

    Attributes:
        inertia: inertia matrix (3, 3), kg m^2.
        dipole_per_ampere: dipole moment per ampere, m^2, of three equal coils along the body axes, or one
            column (3,) in body axes for each coil.
        rate_noise: standard deviation (rad/s) of a gyro sample about each axis.
        free: flags (3,) of the axes about which the body can rotate; a body on a thread rotates only about y.
        bin_samples: number of gyro samples in a bin.
        bins: largest number of differences of neighbouring bins in the fit.
        least_bins: minimum number of differences of neighbouring bins for a fit.
        model_error: acceleration error (rad/s^2) of a bin due to the uncertain delay from command to current.
        torsion, damping: prior standard deviations of torsion (1/s^2) and damping (1/s) about each free axis.
        errors: largest errors of the coils' gains, and of inertia and gyro of a body that is free about three
            axes.
        sure: a gain is used to assess a coil if its standard deviation is below this value.
        settle_ns: time (ns) from switching the coils off until their field at the magnetometer has decayed,
            or None if their field is small compared with the Earth's.
        disturbance: function of a time (ns) that returns the largest accelerations (3,), rad/s^2, expected
            from disturbance torques. None if the disturbance is constant within a fit.
    """

    inertia: FloatArray
    dipole_per_ampere: float | FloatArray
    rate_noise: float
    free: tuple[bool, bool, bool] = (True, True, True)
    bin_samples: int = 8
    bins: int = 15
    least_bins: int = 7
    model_error: float = 8.0e-4
    torsion: float = 0.03
    damping: float = 5.0e-3
    errors: BodyErrors = field(default_factory=BodyErrors)
    sure: float = 0.25
    settle_ns: int | None = None
    disturbance: Callable[[int], FloatArray] | None = None


_PERSISTENCE = 3
"""Number of consecutive fits that must agree on a finding about a coil."""
_LOWEST_SOUND, _HIGHEST_FEEBLE, _HIGHEST_REVERSED = 0.6, 0.4, -0.5
"""Gain thresholds: minimum of a healthy coil, maximum of a coil without torque, maximum of a reversed
coil."""
_MEMORY_NS = 20_000_000_000
"""Time (ns) for which residual accelerations are stored."""
_STALE_NS = 200_000_000
"""Longest gap (ns) between two samples of a fit."""
_REACH_NS = 3_000_000_000
"""Time (ns) for which commands are stored. The time is long, because samples arrive late and in a burst after
a stall of the loop."""
_LEAST_CHANGE = 4.0e-3
"""Smallest detectable change of the angular acceleration, rad/s^2."""
LARGEST_GAIN = 1.5
"""Largest absolute gain of a coil that is physically possible."""
_DISTURBANCE_NS = 10_000_000_000
"""Time (ns) for which the largest expected disturbance is assumed constant."""
_SLOWEST_ROTATION = 1.1e-3
"""Rate (rad/s) at which the air flow rotates in the axes of a body that points to an inertial target."""
_GAIN_PRIOR = 10.0
"""Prior standard deviation of a gain that a hypothesis does not restrict."""
_LEAST_TILT = 0.01
"""Lower limit of the largest error (rad) assumed for the axis of a coil."""
_LEAST_GAIN_ERROR = 0.05
"""Smallest error assumed for the gain of a healthy coil."""
_WEAK_GAIN, _SIGMAS = 0.7, 2.5
"""Largest gain of a coil that is reported as weak, and number of standard deviations by which the estimate
must be below this gain."""
_USED_WEAK_GAIN = 0.6
"""Gain below which a weak coil is used with its estimated gain. The gain is well below 1, because the axes of
the coils can differ from the configured axes by more than assumed."""
_STRONG_GAIN = 1.25
"""Gain above which a coil counts as stronger than assumed."""
LEAST_GAIN, _EXACT = 0.1, 0.1
"""Smallest gain at which a weak coil is used, and largest standard deviation of a used gain."""
_STEADY = 2.0
"""Threshold for a steady gain: largest difference between the gain from the newest half of the bins and the
gain from all bins, in standard deviations of the gain from the newest half."""
_CLEARLY, _CERTAINLY, _WORSE = 9.0, 20.0, 25.0
"""Thresholds for differences of cost between hypotheses. The cost of a hypothesis is the weighted sum of the
squared residuals of its fit. A fault of one coil is accepted under two conditions: its cost is lower by
`_CLEARLY` than the cost of a fault of any other coil, and it exceeds the cost of a fit of all gains by less
than `_WORSE`. A reversed coil is accepted if its cost is also lower by `_CERTAINLY` than the cost of healthy
coils."""


class CoilResponse:
    """Estimates the torque gains of the coils over a sliding window.

    Attributes:
        gain, sigma: gains (n,) of the newest fit, and their standard deviations (n,), infinite before the
            first fit.
        fastest: largest body rate (rad/s) within the window of the newest fit.
        largest: largest physically possible gains (n,), relative to the dipole of the recorded currents.
    """

    def __init__(self, settings: ResponseSettings) -> None:
        self._settings = settings
        dipoles = np.asarray(settings.dipole_per_ampere)
        if dipoles.ndim == 0:
            dipoles = np.eye(3) * dipoles
        strongest = float(np.linalg.norm(dipoles, axis=0).max())
        self._count_of_coils = coils = dipoles.shape[1]
        # The last n rows are the dipoles of the coils, relative to the strongest coil's dipole.
        directions = _with_tilts(dipoles.T / strongest) if all(settings.free) else dipoles.T / strongest
        self._tilts = len(directions) - coils
        # Accelerations per ampere (3, 3 m): row b is for a unit field along body axis b, with three columns
        # per row of `directions`. A dipole per ampere d causes the acceleration J^-1 (d x B).
        torques = strongest * np.cross(directions, np.eye(3)[:, None])
        self._per_field: FloatArray = (torques @ np.linalg.inv(settings.inertia).T).reshape(3, -1)
        self._free = np.flatnonzero(settings.free)
        self._mask: FloatArray = np.array(settings.free, dtype=float)
        count = len(self._free)
        # Coefficients (3 + 3 k, 6) of the gyroscopic acceleration, and of its changes due to k inertia
        # errors.
        self._gyroscopic: FloatArray = np.zeros((3, 6))
        if count == 3:
            modes = coefficient_modes(settings.inertia, settings.errors)
            self._gyroscopic = np.vstack([gyroscopic_coefficients(settings.inertia), *modes])
        errors = len(self._gyroscopic) // 3 - 1
        # Fit parameters: torsion and damping of each free axis, a weight of each error mode, the tilts of the
        # coils' axes, and the gains.
        spreads = [settings.torsion] * count + [settings.damping] * count + [1.0] * errors
        spreads += [max(settings.errors.coil_axes, _LEAST_TILT) / math.sqrt(3.0)] * self._tilts
        self._others = len(spreads)
        self._prior: FloatArray = 1.0 / np.array(spreads) ** 2
        # Prior weight (inverse variance) of a healthy coil's gain, whose error is uniformly distributed.
        healthy = np.full(coils, 3.0 / max(settings.errors.coil_gain, _LEAST_GAIN_ERROR) ** 2)
        # The hypotheses: all gains are free (1), one gain is free (n), no gain is free (1), one coil is
        # reversed (n).
        each = np.eye(coils, dtype=bool)
        self._prior_weights: FloatArray = np.concatenate(
            [
                np.full((1, coils), _GAIN_PRIOR**-2),
                np.where(each, _GAIN_PRIOR**-2, healthy),
                np.tile(healthy, (coils + 1, 1)),
            ]
        )
        self._expected: FloatArray = np.ones((2 * coils + 2, coils))
        self._expected[coils + 2 :][each] = -1.0
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque([(0, (0.0,) * coils)])
        self._known_ns = self._last_ns = 0
        self._disturbed_ns, self._disturbance = -_DISTURBANCE_NS, np.zeros(3)
        self.gain: FloatArray = np.ones(coils)
        self.largest: FloatArray = np.full(coils, LARGEST_GAIN)
        self.reset()

    def reset(self) -> None:
        """Discard all samples."""
        coils = self._count_of_coils
        # Samples: time since the previous sample (s), rate (3,), field (3,) and currents (n,).
        self._samples: list[tuple[float, ...]] = []
        self._times: list[int] = []  # times (ns) of the samples
        # Time (s), sums and motion of the last bin, as `_bin_equations` needs them for the next bin.
        self._middle: float | None = None
        self._sums: FloatArray = np.zeros((2, self._per_field.shape[1] + 6))
        self._motion: FloatArray = np.zeros((2, 3))
        self._quiet_field: tuple[float, ...] | None = None
        # Equations (f, p + 1) of each bin for f free axes: coefficients of p parameters, and acceleration.
        self._rows: deque[FloatArray] = deque(maxlen=self._settings.bins)
        self._speeds: deque[float] = deque(maxlen=self._settings.bins)
        self.fastest = 0.0
        # The newest fit determines the weights of the inertia error modes.
        self._weights: FloatArray = np.zeros(len(self._gyroscopic) // 3 - 1)
        # Bins of the last `_MEMORY_NS`: time (ns), equations (3, p + 1), and last field (3,), T.
        self._history: deque[tuple[int, FloatArray, tuple[float, ...]]] = deque()
        self._in_a_row = {finding: [0] * coils for finding in Finding}
        self.sigma: FloatArray = np.full(coils, np.inf)

    def commanded(self, time_ns: int, currents: tuple[float, ...]) -> None:
        """Record the currents (n,), A, in force from `time_ns` on."""
        if currents == self._commands[-1][1]:
            return
        self._commands.append((time_ns, currents))
        while len(self._commands) > 1 and self._commands[1][0] < time_ns - _REACH_NS:
            self._commands.popleft()

    def interrupted(self, until_ns: int) -> None:
        """Ignore samples up to `until_ns`, because the coil currents up to this time are unknown."""
        self._known_ns = until_ns
        self.reset()

    def observe_motion(self, time_ns: int, rate: FloatArray, field: FloatArray) -> bool:
        """Add a sample of rate (3,), rad/s, and field (3,), T, and return whether a new fit was made."""
        if time_ns < self._known_ns:
            return False
        since_ns = time_ns - self._last_ns
        self._last_ns = time_ns
        if not 0 < since_ns < _STALE_NS:
            self.reset()
            return False
        rates: list[float] = rate.tolist()
        fields: Sequence[float] = field.tolist()
        if self._settings.settle_ns is not None:
            quiet_field = self._field_without_coils(time_ns, since_ns * 1e-9, rates, fields)
            if quiet_field is None:
                return False
            fields = quiet_field
        self._times.append(time_ns)
        self._samples.append((since_ns * 1e-9, *rates, *fields, *self._command_at(time_ns)))
        return len(self._samples) >= self._settings.bin_samples and self._close_bin()

    def _field_without_coils(
        self, time_ns: int, span: float, rate: list[float], field: Sequence[float]
    ) -> tuple[float, ...] | None:
        """Return the field of the last pause of the coils, rotated with the body; None before the first."""
        since_ns, currents = self._commands[-1]
        settle_ns = self._settings.settle_ns or 0
        if not any(currents) and time_ns - since_ns >= settle_ns:
            self._quiet_field = tuple(field)
        elif self._quiet_field is not None:
            (x, y, z), (wx, wy, wz) = self._quiet_field, (span * speed for speed in rate)
            self._quiet_field = x + y * wz - z * wy, y + z * wx - x * wz, z + x * wy - y * wx
        return self._quiet_field

    def _command_at(self, time_ns: int) -> tuple[float, ...]:
        earlier = (currents for since_ns, currents in reversed(self._commands) if since_ns <= time_ns)
        return next(earlier, self._commands[0][1])

    def axes(self, finding: Finding) -> list[int]:
        """Return the axes for which a finding held in each of the last `_PERSISTENCE` fits."""
        counts = self._in_a_row[finding]
        return [axis for axis, count in enumerate(counts) if count >= _PERSISTENCE]

    def is_healthy(self, axis: int) -> bool:
        """Return whether an axis had the gain of a healthy coil in each of the last `_PERSISTENCE` fits."""
        return axis in self.axes(Finding.SOUND)

    def observed_share(self, axis: int, constant: float, since_ns: int, settled_ns: int) -> float | None:
        """Return the observed change of torque, divided by the change that a suspected fault would cause.

        With the suspected fault, the coil carries the current `constant` (A) instead of its commanded
        current. The residuals before `since_ns` are compared with those after `settled_ns`. The result is
        None if the expected change is too small to be observed, and NaN if there are too few residuals.
        """
        before = [rows for time_ns, rows, _ in self._history if time_ns < since_ns]
        after = [(rows, field) for time_ns, rows, field in self._history if time_ns >= settled_ns]
        if len(before) < 3 or len(after) < 3:
            return math.nan
        column, first = self._others + axis, 3 * (self._tilts + axis)
        per_field = constant * self._per_field[:, first : first + 3]
        changes = [np.array(field) @ per_field - rows[:, column] for rows, field in after]
        expected: FloatArray = np.mean(changes, axis=0)
        expected *= self._mask
        size = float(expected @ expected)
        if size < _LEAST_CHANGE**2:
            return None
        change = self._residual([rows for rows, _ in after]) - self._residual(before[-10:])
        return float(change @ expected) / size

    def _residual(self, equations: list[FloatArray]) -> FloatArray:
        """Return the mean residual acceleration (3,) of equations (3, p + 1), assuming healthy coils."""
        rows = np.mean(equations, axis=0)
        # The tilts are left out, because those of the newest fit can contain the effect of a fault.
        first = 2 * len(self._free)
        modes, gains = rows[:, first : first + len(self._weights)], rows[:, self._others : -1]
        return np.asarray(rows[:, -1] - gains.sum(axis=1) - modes @ self._weights)

    @property
    def strength(self) -> FloatArray | None:
        """Angular acceleration per ampere (n,), rad/s^2/A, by each coil; None before the first pause.

        The magnetic field is that of the last pause of the coils.
        """
        if self._quiet_field is None:
            return None
        per_ampere = np.array(self._quiet_field) @ self._per_field
        return np.asarray(np.linalg.norm(per_ampere.reshape(-1, 3)[self._tilts :], axis=1))

    def text(self, axis: int) -> str:
        """Return the gain of an axis as text."""
        return f"the motion shows {self.gain[axis]:+.2f} +- {self.sigma[axis]:.2f} of its expected torque"

    def _close_bin(self) -> bool:
        samples, field = np.array(self._samples), self._samples[-1][4:7]
        if self._tilts:  # the two tilts of a coil act like coils with the same current
            samples = np.concatenate([samples, samples[:, 7:], samples[:, 7:]], axis=1)
        middle = sum(self._times) / len(samples) * 1e-9
        self._samples.clear()
        self._times.clear()
        before, self._middle = self._middle, middle
        span = 0.0 if before is None else middle - before
        self._sums, self._motion, rows, fastest = _bin_equations(
            samples, self._per_field, self._gyroscopic, self._free, self._sums, self._motion, span
        )
        if before is None:
            return False
        self._rows.append(rows[self._free])
        self._speeds.append(fastest)
        self._history.append((self._last_ns, rows, field))
        while self._history[0][0] < self._last_ns - _MEMORY_NS:
            self._history.popleft()
        if len(self._rows) < self._settings.least_bins:
            return False
        self._fit(span)
        return True

    def _fit(self, span: float) -> None:
        """Fit the gains over all bins, and look for a reversed coil in the newest bins too.

        In a fit over all bins, the bins before a fault would hide the fault.
        """
        rows = np.concatenate(self._rows).reshape(len(self._rows), len(self._free), -1)
        counts = [len(rows)]
        while counts[-1] // 2 >= self._settings.least_bins:
            counts.append(counts[-1] // 2)
        fits = self._solved(rows, tuple(counts), span)
        whole = fits[0]
        self.fastest = max(self._speeds)
        self.gain, self.sigma, self._weights = np.array(whole.gain), np.array(whole.sigma), whole.weights
        # The gain of a coil that has just failed differs between the whole window and its newest half.
        newest = fits[min(1, len(fits) - 1)]
        for axis in range(self._count_of_coils):
            shown = [fit for fit in fits if fit.possible and fit.is_reversed[axis]]
            shown = [fit for fit in shown if fit.gain[axis] < _HIGHEST_REVERSED]
            if shown:
                self.gain[axis], self.sigma[axis] = shown[0].gain[axis], shown[0].sigma[axis]
            alone = bool(whole.alone[axis])
            is_steady = bool(abs(newest.gain[axis] - whole.gain[axis]) < _STEADY * newest.sigma[axis])
            self._count(axis, whole.possible, alone=alone, is_reversed=bool(shown), is_steady=is_steady)

    def _solved(self, rows: FloatArray, counts: tuple[int, ...], span: float) -> list[MotionFit]:
        """Fit all gains freely, and fit each gain under the assumption that the other coils are healthy.

        The equations `rows` (m, f, p + 1) belong to m neighbouring bins, and `span` is the time (s) from bin
        to bin. Each element of `counts` is the number of newest bins that one fit uses.
        """
        free, coils = len(self._free), self._count_of_coils
        equations = self._whitened(rows, counts, span)
        normal = equations.transpose(0, 2, 1) @ equations
        gains, variances, costs, others = fitted_gains(
            normal, self._prior, self._prior_weights, self._expected
        )
        largest, fits = self.largest.tolist(), []
        for count, gain, variance, cost, other in zip(
            counts, gains.tolist(), variances.tolist(), costs.tolist(), others, strict=True
        ):
            spread = max(1.0, cost[0] / max(free * (count - 1) - coils, 1))
            # If a gain is impossible even within its uncertainty, the model is wrong.
            possible = all(
                [
                    abs(value) - 3.0 * math.sqrt(spread * square) < limit
                    for value, square, limit in zip(gain[0], variance[0], largest, strict=True)
                ]
            )
            single = [gain[axis + 1][axis] for axis in range(coils)]
            sigma = [math.sqrt(spread * variance[axis + 1][axis]) for axis in range(coils)]
            judged = _judged([each / spread for each in cost])
            fits.append(
                MotionFit(single, sigma, other[2 * free : self._others - self._tilts], possible, *judged)
            )
        return fits

    def _count(self, axis: int, possible: bool, *, alone: bool, is_reversed: bool, is_steady: bool) -> None:
        """Count the consecutive fits with the same finding about an axis.

        Args:
            axis: index of the axis.
            possible: whether the gains of all axes are physically possible.
            alone: whether a fault of this axis explains the motion clearly better than a fault of any other
                axis.
            is_reversed: whether a reversed coil on this axis explains the motion clearly better than a fault
                of another axis, and far better than healthy coils.
            is_steady: whether the newest half of the bins yields the same gain as all bins.
        """
        settings, gain, sigma = self._settings, float(self.gain[axis]), float(self.sigma[axis])
        judged = possible and abs(gain) <= float(self.largest[axis])
        sure = judged and sigma < settings.sure
        weak = alone and gain + _SIGMAS * sigma < _WEAK_GAIN and gain < _HIGHEST_FEEBLE
        exact = judged and alone and is_steady and sigma < _EXACT
        # After an earlier correction, the dipole of a coil may be several times the dipole assumed now.
        corrected = float(self.largest[axis]) > LARGEST_GAIN
        wrong = is_reversed or (corrected and exact and gain + 3.0 * sigma < -LEAST_GAIN)
        holds = (  # in the order of `Finding`
            wrong,
            wrong or (sure and weak),
            sure and gain > _LOWEST_SOUND,
            exact and gain + 3.0 * sigma < _USED_WEAK_GAIN and gain - 3.0 * sigma > LEAST_GAIN,
            exact and gain - 3.0 * sigma > _STRONG_GAIN,
        )
        for counts, held in zip(self._in_a_row.values(), holds, strict=True):
            counts[axis] = counts[axis] + 1 if held else 0

    def _whitened(self, rows: FloatArray, counts: tuple[int, ...], span: float) -> FloatArray:
        """Return the equations (w, m f, p + 1) of w fits, whitened and without the constant disturbance.

        The equations `rows` (m, f, p + 1) belong to m bins. Each element of `counts` is the number of newest
        bins that one fit uses; the equations of its older bins are zero. Whitening is needed, because the
        noise of each bin enters two neighbouring differences with opposite signs.
        """
        settings = self._settings
        # The span is rounded to ns, so that equal spans share a cached matrix.
        span = round(span, 9)
        variance = (settings.rate_noise / span) ** 2 / settings.bin_samples
        white = [
            whitenings(counts, settings.model_error**2, variance, walk * span) @ rows[:, axis]
            for axis, walk in enumerate(self._disturbance_walks())
        ]
        return np.concatenate(white, axis=1)

    def _disturbance_walks(self) -> list[float]:
        """Return the variances (f,) per second, (rad/s^2)^2/s, of the random walks of the disturbances.

        Each disturbance is assumed to change by its own magnitude while the body rotates by 1 rad. The result
        is rounded to a power of two, so that few whitening matrices are needed.
        """
        disturbance = self._settings.disturbance
        if disturbance is not None and not 0 <= self._last_ns - self._disturbed_ns < _DISTURBANCE_NS:
            self._disturbed_ns, self._disturbance = self._last_ns, disturbance(self._last_ns)
        walks = 2.0 * self._disturbance[self._free] ** 2 * max(self._speeds[-1], _SLOWEST_ROTATION)
        return [2.0 ** round(math.log2(walk)) if walk > 0.0 else 0.0 for walk in walks.tolist()]


def _with_tilts(dipoles: FloatArray) -> FloatArray:
    """Return the changes (2 n, 3) of dipoles (n, 3) by tilts of 1 rad in two directions, and the dipoles."""
    sizes = np.linalg.norm(dipoles, axis=1).tolist()
    tilts = [size * tangent_basis(row / size) for row, size in zip(dipoles, sizes, strict=True)]
    return np.concatenate([*np.stack(tilts, axis=1), dipoles])


@functools.cache
def _sums_and_means(count: int) -> FloatArray:
    """Return the matrix (2, m) that yields the sum of m steps, and the mean of their m cumulative sums."""
    return np.stack([np.ones(count), np.arange(count, 0, -1) / count])


def _bin_equations_numpy(
    samples: FloatArray,
    per_field: FloatArray,
    gyroscopic: FloatArray,
    free: IntArray,
    sums: FloatArray,
    motion: FloatArray,
    span: float,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the equations of the angular acceleration between two neighbouring bins of samples.

    The 3 n + 6 time integrals are those of the accelerations by n coils (rad/s, three per coil) and of the
    six rate products (rad^2/s).

    Args:
        samples: samples (m, 7 + n) of the second bin: time (s) since the previous sample, rate, field (T) and
            currents (A).
        per_field: accelerations per ampere (3, 3 n), with one row per field axis and three columns per coil.
        gyroscopic: coefficients (3 + 3 k, 6) of the gyroscopic acceleration, and of its k error modes.
        free: indices (f,) of the axes about which the body can rotate.
        sums: the integrals (2, 3 n + 6): their values at the end of the first bin, and their means over it.
        motion: rotation vector (rad) up to the first bin, and mean rate (rad/s) in the first bin, (2, 3).
        span: time (s) between the bins, or 0.0 if the first bin is missing.

    Returns:
        The sums and the motion of the second bin, the equations (3, 2 f + k + n + 1), and the largest body
        rate in the second bin. The columns of the equations are the coefficients of torsions, dampings, error
        modes and coil gains, then the acceleration. If the first bin is missing, the equations are zero.
    """
    count, coils, rates = len(samples), samples.shape[1] - 7, samples[:, 1:4]
    products = rate_products(rates)
    commanded = np.repeat(samples[:, 7:], 3, axis=1) * (samples[:, 4:7] @ per_field)
    steps = np.concatenate([commanded, products], axis=1)
    after = sums[0] + (_sums_and_means(count) * samples[:, 0]) @ steps
    rate = rates.sum(axis=0) / count
    mean_rate = 0.5 * (motion[1] + rate)
    moved = np.stack([motion[0] + span * mean_rate, rate])
    fastest = math.sqrt(float(products[:, :3].sum(axis=1).max()))
    number, modes = len(free), len(gyroscopic) // 3 - 1
    rows = np.zeros((3, 2 * number + modes + coils + 1))
    if span:
        change = (after[1] - sums[1]) / span
        turning = (gyroscopic @ change[3 * coils :]).reshape(-1, 3)
        for place, axis in enumerate(free.tolist()):
            rows[axis, place], rows[axis, number + place] = -moved[0, axis], -mean_rate[axis]
        rows[:, 2 * number : 2 * number + modes] = turning[1:].T
        rows[:, 2 * number + modes : -1] = change[: 3 * coils].reshape(coils, 3).T
        rows[:, -1] = (rate - motion[1]) / span - turning[0]
    return after, moved, rows, fastest


@compiled_form_of(_bin_equations_numpy)
def _bin_equations(
    samples: FloatArray,
    per_field: FloatArray,
    gyroscopic: FloatArray,
    free: IntArray,
    sums: FloatArray,
    motion: FloatArray,
    span: float,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """See `_bin_equations_numpy`."""
    (count, columns), number, modes = samples.shape, len(free), len(gyroscopic) // 3 - 1
    coils, last = columns - 7, 2 * number + modes + columns - 7
    after, moved, rows = np.empty_like(sums), np.zeros((2, 3)), np.zeros((3, last + 1))
    after[:] = sums[0]
    fastest = 0.0
    for place in range(count):
        weight, (x, y, z) = samples[place, 0], (samples[place, 1], samples[place, 2], samples[place, 3])
        products = (x * x, y * y, z * z, y * z, z * x, x * y)
        fastest = max(fastest, x * x + y * y + z * z)
        for column in range(3 * coils + 6):
            step = weight * products[max(column - 3 * coils, 0)]
            if column < 3 * coils:
                acceleration = 0.0
                for axis in range(3):
                    acceleration += samples[place, 4 + axis] * per_field[axis, column]
                step = weight * samples[place, 7 + column // 3] * acceleration
            after[0, column] += step
            after[1, column] += (count - place) / count * step
        for axis in range(3):
            moved[1, axis] += samples[place, 1 + axis] / count
    for axis in range(3):
        moved[0, axis] = motion[0, axis] + 0.5 * span * (motion[1, axis] + moved[1, axis])
    if span == 0.0:
        return after, moved, rows, math.sqrt(fastest)
    change = (after[1] - sums[1]) / span
    for place in range(number):
        axis = free[place]
        rows[axis, place] = -moved[0, axis]
        rows[axis, number + place] = -0.5 * (motion[1, axis] + moved[1, axis])
    for axis in range(3):
        rows[axis, last] = (moved[1, axis] - motion[1, axis]) / span
        for k in range(6):
            rows[axis, last] -= gyroscopic[axis, k] * change[3 * coils + k]
            for mode in range(modes):
                rows[axis, 2 * number + mode] += gyroscopic[3 + 3 * mode + axis, k] * change[3 * coils + k]
        for coil in range(coils):
            rows[axis, 2 * number + modes + coil] = change[3 * coil + axis]
    return after, moved, rows, math.sqrt(fastest)


class Finding(Enum):
    """Kinds of findings about a coil: wrong sign, no torque, healthy, weak but usable, and too strong."""

    REVERSED = auto()
    FEEBLE = auto()
    SOUND = auto()
    WEAK = auto()
    STRONG = auto()


class MotionFit(NamedTuple):
    """Result of a fit of the coil gains over the newest bins.

    Attributes:
        gain, sigma: gain (n,) of each coil with the other coils assumed healthy, and standard deviation (n,)
            of this gain.
        weights: weights (k,) of the error modes.
        possible: whether the gains of all axes are physically possible.
        alone: for each axis, whether its fault explains the motion clearly better than a fault of any other
            axis.
        is_reversed: for each coil, whether its reversal explains the motion clearly better than a fault of
            any other coil, and far better than healthy coils.
    """

    gain: Sequence[float]
    sigma: Sequence[float]
    weights: FloatArray
    possible: bool
    alone: tuple[bool, ...]
    is_reversed: tuple[bool, ...]


def _judged(costs: list[float]) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
    """Return for each of n coils whether only its fault explains the motion, and whether it is reversed.

    The 2 n + 2 `costs` belong to these hypotheses: all gains are free (1), one gain is free (n), no gain is
    free (1), one coil is reversed (n).
    """
    coils = len(costs) // 2 - 1
    free, sound = costs[0], costs[coils + 1]
    alone, is_reversed = [], []
    singles = costs[1 : coils + 1]
    least, second = sorted(singles)[:2]
    for single, turned in zip(singles, costs[coils + 2 :], strict=True):
        # The hypothesis that only this axis is broken is accepted if its cost is below this limit.
        limit = min((second if single == least else least) - _CLEARLY, free + _WORSE)
        alone.append(single < limit)
        is_reversed.append(turned < min(limit, sound - _CERTAINLY))
    return tuple(alone), tuple(is_reversed)


LONGEST_REST_NS = 600_000_000_000
"""Longest time (ns) for which a coil whose sign changes repeatedly is kept at zero current."""
_MOST_CHANGES = 2
"""Largest number of changes of a coil's sign within ten minutes."""


class CoilCorrection:
    """Sign and gain of each coil relative to its configuration, and the corrections still to be reviewed.

    Attributes:
        factors: dipole (n,) of each coil divided by its configured dipole at the same current: 1 for a
            healthy coil, -1 for a reversed coil.
        deviations: relative standard deviations (n,) of the estimated gains; zero for coils without an
            estimated gain.
        sizes: absolute values of the factors, n floats.
    """

    def __init__(self, coils: int = 3) -> None:
        """Start with `coils` healthy coils."""
        self.factors: FloatArray = np.ones(coils)
        self.sizes: tuple[float, ...] = (1.0,) * coils
        self.deviations: FloatArray = np.zeros(coils)
        self._changes: list[list[int]] = [[] for _ in range(coils)]  # times (ns) of the changes of sign
        self._unreviewed: set[int] = set()

    def effective(self, wire: FloatArray) -> FloatArray:
        """Convert actual to effective currents (n,), A, which cause the same dipole in healthy coils."""
        return self.factors * wire

    def wire(self, effective: FloatArray) -> FloatArray:
        """Convert effective to actual currents (n,), A, which cause the same dipole in the actual coils."""
        return effective / self.factors

    @property
    def unreviewed(self) -> frozenset[int]:
        """The axes whose sign was changed in a tumble, and not yet confirmed while the body was slow."""
        return frozenset(self._unreviewed)

    def reverse(self, axis: int, now_ns: int, *, in_tumble: bool) -> bool:
        """Change the sign of a coil unless it changed too often in ten minutes; return whether it changed."""
        recent = [time_ns for time_ns in self._changes[axis] if now_ns - time_ns < LONGEST_REST_NS]
        self._changes[axis] = recent
        if len(recent) >= _MOST_CHANGES:
            return False
        recent.append(now_ns)
        self._set(axis, -float(self.factors[axis]))
        if in_tumble:
            self._unreviewed.add(axis)
        else:
            self._unreviewed.discard(axis)
        return True

    def weigh(self, axis: int, gain: float, sigma: float = 0.0) -> bool:
        """Multiply a coil's gain by `gain` +- `sigma`; return whether the gain changed.

        The resulting gain is limited to the range from `LEAST_GAIN` to 1, which `restore` accepts.
        """
        before = float(self.factors[axis])
        size = min(max(gain * abs(before), LEAST_GAIN), 1.0)
        if size == abs(before):
            return False
        self._set(axis, math.copysign(size, before))
        self.deviations = self.deviations.copy()
        self.deviations[axis] = sigma / gain
        return True

    def restore(self, factors: FloatArray, deviations: FloatArray) -> str:
        """Start from factors (n,) of an earlier boot, with relative deviations (n,).

        Return why the factors were rejected, or "".
        """
        sizes = np.abs(factors)
        if factors.shape != self.factors.shape or not ((sizes >= LEAST_GAIN) & (sizes <= 1.0)).all():
            number = f"not {len(self.factors)} factors"
            return f"{factors.tolist()}: {number} from {LEAST_GAIN:g} to 1 in magnitude"
        self.factors, self.deviations = factors.copy(), deviations.copy()
        self.sizes = tuple(sizes.tolist())
        return ""

    def confirm(self, axis: int) -> None:
        """Accept the changed sign of a coil, because the motion of the slowly rotating body confirms it."""
        self._unreviewed.discard(axis)

    def text(self, axis: int) -> str:
        """Return the factor of a coil as text."""
        return f"used with {self.factors[axis]:+.2f} of its configured dipole"

    def _set(self, axis: int, factor: float) -> None:
        self.factors = self.factors.copy()
        self.factors[axis] = factor
        self.sizes = tuple(np.abs(self.factors).tolist())


_DRIVEN = {CoilFault.A_HIGH: 1.0, CoilFault.B_HIGH: -1.0}
"""Sign of the continuous current through the coil, for each kind of fault with a leg stuck high."""
_LITTLE_RESPONSE = 0.4
"""Share of the expected change of torque below which a diagnosed fault is considered refuted."""
_DOUBTED_FOR_NS = 60_000_000_000
"""Time (ns) after a refuted diagnosis during which further diagnoses are rejected if the motion is
inconclusive."""


class MotionWitness:
    """Checks diagnoses by the body's motion; `doubt` states why the current monitor seems faulty."""

    def __init__(self, response: CoilResponse | None, full_current: tuple[float, ...]) -> None:
        """Set the current `full_current` (n,), A, of each coil that is fully on."""
        self._response, self._full_current = response, full_current
        self._doubted_ns = -_DOUBTED_FOR_NS
        self.doubt = ""

    def trust_monitor(self) -> None:
        """Trust the current monitor again, because its readings are consistent with healthy coils."""
        self.doubt = ""

    def doubt_monitor(self, why: str, now_ns: int) -> None:
        """Consider the current monitor faulty from now on."""
        self.doubt, self._doubted_ns = why, now_ns

    def contradicts(self, axis: int, fault: CoilFault, begun_ns: int, suspected_ns: int, now_ns: int) -> bool:
        """Return whether the coil's torque is unchanged, which means that the current monitor is faulty.

        The coil last drew the expected current at `begun_ns`, and the fault began after this time. The fault
        was suspected at `suspected_ns`, and the newest reading was made at `now_ns`.
        """
        if self._response is None:
            return False
        carried = _DRIVEN.get(fault, 0.0) * self._full_current[axis]
        observed = self._response.observed_share(axis, carried, begun_ns, suspected_ns)
        if (observed is None or math.isnan(observed)) and now_ns - self._doubted_ns < _DOUBTED_FOR_NS:
            return True
        if observed is None:
            return fault not in _DRIVEN and self._response.is_healthy(axis)
        if math.isnan(observed):
            # Without residuals from before the fault, only the present torque shows a healthy coil.
            return fault in _DRIVEN or self._response.is_healthy(axis)
        return observed < _LITTLE_RESPONSE
