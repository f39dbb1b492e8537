"""Steps of the satellite's attitude filter: coil commands and readings between two times."""

from __future__ import annotations

import bisect
import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import Measurement
from knightcube.gnc.estimation.free_filter import FilterEnvironment, FreeMemory

Floats = tuple[float, float, float]
_NOTHING: Floats = (0.0, 0.0, 0.0)


class DipoleHistory:
    """Record of the commanded dipoles, in order of time."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._times: list[int] = []
        self._dipoles: list[Floats] = []
        self._sums: list[Floats] = []  # integral of the dipole up to each time, A m^2 ns
        self.unknown_ns = -1
        """Last time (ns) at which the dipole was unknown; -1 if it was always known."""

    def record(self, time_ns: int, dipole: Floats, known: bool) -> None:
        """Record the dipole (A m^2) that is in force from `time_ns` on; calls must be in order of time."""
        if not known:
            self.unknown_ns = max(self.unknown_ns, time_ns)
        if self._dipoles and dipole == self._dipoles[-1]:
            return
        time_ns = max(time_ns, self._times[-1]) if self._times else time_ns
        self._sums.append(self._sum(time_ns))
        self._times.append(time_ns)
        self._dipoles.append(dipole)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # discard the oldest entries in batches
            del self._times[:oldest], self._dipoles[:oldest], self._sums[:oldest]

    def total(self, time_ns: int) -> FloatArray:
        """Return the integral (3,), A m^2 s, of the dipole up to a time, from an arbitrary origin."""
        return np.array(self._sum(time_ns)) / SECOND_NS

    def mean(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean dipole (3,), A m^2, between two times; it is zero before the first record."""
        if to_ns <= from_ns:
            return np.array(self._dipoles[-1] if self._dipoles else _NOTHING)
        return np.subtract(self._sum(to_ns), self._sum(from_ns)) / (to_ns - from_ns)

    def impulse(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean over t of the integral (3,), A m^2 s, of the dipole from a time t to `to_ns`.

        The mean is taken over all times t from `from_ns` to `to_ns`. The cross product of the result and the
        magnetic field is the angular momentum at `to_ns` minus the mean angular momentum from `from_ns` to
        `to_ns`.
        """
        first, last = bisect.bisect_right(self._times, from_ns), bisect.bisect_left(self._times, to_ns)
        knots = np.array([from_ns, *self._times[first:last], to_ns])
        sums = np.array([self._sum(time_ns) for time_ns in knots.tolist()])
        mean = np.diff(knots) @ (0.5 * (sums[1:] + sums[:-1])) / (to_ns - from_ns)
        return np.asarray((sums[-1] - mean) / SECOND_NS)

    def at_rest_since(self) -> int | None:
        """Return the time (ns) since which the dipole has been zero, or None if it is not zero."""
        if not self._dipoles:
            return 0
        return self._times[-1] if self._dipoles[-1] == _NOTHING else None

    def _sum(self, time_ns: int) -> Floats:
        place = bisect.bisect_right(self._times, time_ns) - 1
        if place < 0:
            return self._sums[0] if self._sums else _NOTHING
        since = time_ns - self._times[place]
        (a, b, c), (x, y, z) = self._sums[place], self._dipoles[place]
        return a + since * x, b + since * y, c + since * z


class RateByField(NamedTuple):
    """The body rate (3,), rad/s, estimated from the magnetometer, with its covariance (3, 3), rad^2/s^2."""

    rate: FloatArray
    covariance: FloatArray


@dataclass(slots=True, eq=False)
class FilterStep:
    """Coil commands and measurements between two times.

    Attributes:
        dipole: mean commanded dipole (3,), A m^2.
        doubt: standard deviation of the error of `dipole`, A m^2 per axis, in addition to that of the coils'
            matrix; zero for known dipoles of three coils.
        gyro: mean angular rate (3,), rad/s, of `samples` gyro readings with the mean time `gyro_ns`. Without
            a gyro reading, `gyro` is the rate at the end of the step, estimated from the magnetometer, and
            `spread` is the covariance (3, 3), rad^2/s^2, of this rate.
        impulse: time integral (3,), A m^2 s, of the dipole from a gyro reading to the end of the step,
            averaged over the readings.
        field: mean magnetic field (3,), T, of `fields` readings around `field_ns`, or None without a reading.
        late: measurements whose time lies in the step, oldest first.
        before: the estimate at the beginning of the step, or None without an estimate.
    """

    begin_ns: int
    end_ns: int
    dipole: FloatArray
    doubt: float
    around: FilterEnvironment
    gyro: FloatArray
    gyro_ns: int
    samples: int
    impulse: FloatArray
    field: FloatArray | None
    field_ns: int
    fields: int
    spread: FloatArray | None = None
    late: list[Measurement] = dataclasses.field(default_factory=list)
    before: FreeMemory | None = None

    @property
    def seconds(self) -> float:
        """Length of the step (s)."""
        return (self.end_ns - self.begin_ns) / SECOND_NS


class OpenStep:
    """Collects the readings of the present, incomplete filter step."""

    def __init__(self, begin_ns: int, acts: bool) -> None:
        """Start a step at a time. The flag `acts` states whether the coils carry current during the step."""
        self.begin_ns = self.end_ns = begin_ns
        self._acts = acts
        self._rates: list[FloatArray] = []
        self._totals: list[FloatArray] = []
        self._total: FloatArray = np.zeros(3)
        self._fields: list[FloatArray] = []
        self._rates_ns = self._fields_ns = 0

    def add(self, reading: ImuReading, total: FloatArray, listens: bool) -> None:
        """Add a reading, with the integral `total` (3,), A m^2 s, of the dipole up to the reading.

        The flag `listens` states whether the magnetic field of the reading is valid.
        """
        since = reading.time_ns - self.begin_ns
        self.end_ns, self._total = reading.time_ns, total
        if reading.has_rate:
            self._rates.append(reading.rate)
            self._totals.append(total)
            self._rates_ns += since
        if listens:
            self._fields.append(reading.field)
            self._fields_ns += since

    def is_over(self, acts: bool, longest_ns: int) -> bool:
        """Return whether the step has reached its full length, or the coils were switched on or off."""
        return acts != self._acts or self.end_ns - self.begin_ns >= longest_ns

    def close(
        self, dipole: FloatArray, doubt: float, around: FilterEnvironment, by_field: RateByField
    ) -> FilterStep:
        """Return the finished step; without a gyro reading, its rate is that of the magnetometer."""
        samples, fields = len(self._rates), len(self._fields)
        rate, spread = (np.mean(self._rates, axis=0), None) if samples else by_field
        return FilterStep(
            self.begin_ns,
            self.end_ns,
            dipole,
            doubt,
            around,
            rate,
            self.begin_ns + self._rates_ns // samples if samples else self.end_ns,
            samples,
            self._total - np.mean(self._totals, axis=0) if samples else np.zeros(3),
            np.mean(self._fields, axis=0) if fields else None,
            self.begin_ns + self._fields_ns // max(fields, 1),
            fields,
            spread,
        )
