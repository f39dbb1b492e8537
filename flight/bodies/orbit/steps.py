"""The steps of a satellite's filter: what was commanded and measured between two times, a second at most.

A step ends early where the coils begin or cease to act, so that its dipole is nearly constant. The
magnetometer counts only while the coils are at rest and their field has decayed.
"""

from __future__ import annotations

import bisect
import dataclasses
from dataclasses import dataclass

import numpy as np

from hal.interfaces.readings import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.free_filter import FreeMemory
from knightcube.gnc.estimation.free_motion import Around
from knightcube.gnc.estimation.measurements import Measurement

Floats = tuple[float, float, float]
_NOTHING: Floats = (0.0, 0.0, 0.0)


class DipoleHistory:
    """The dipoles on the wire in order of time, and since when they are known."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._times: list[int] = []
        self._dipoles: list[Floats] = []
        self._sums: list[Floats] = []  # A m^2 ns: the integral until each time
        self.unknown_ns = -1
        """Until when dipoles were not known; -1 if they always were."""

    def record(self, time_ns: int, dipole: Floats, known: bool) -> None:
        """Record the dipole A m^2 in force from `time_ns` on; in order of time."""
        if not known:
            self.unknown_ns = max(self.unknown_ns, time_ns)
        if self._dipoles and dipole == self._dipoles[-1]:
            return
        time_ns = max(time_ns, self._times[-1]) if self._times else time_ns
        self._sums.append(self._sum(time_ns))
        self._times.append(time_ns)
        self._dipoles.append(dipole)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # in batches, not each cycle
            del self._times[:oldest], self._dipoles[:oldest], self._sums[:oldest]

    def total(self, time_ns: int) -> FloatArray:
        """Return the integral (3,) A m^2 s of the dipole until a time; only differences have a meaning."""
        return np.array(self._sum(time_ns)) / SECOND_NS

    def mean(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean dipole (3,) A m^2 between two times; before the first record it is zero."""
        if to_ns <= from_ns:
            return np.array(self._dipoles[-1] if self._dipoles else _NOTHING)
        return np.subtract(self._sum(to_ns), self._sum(from_ns)) / (to_ns - from_ns)

    def at_rest_since(self) -> int | None:
        """Return since when the dipole is zero; None while it is not."""
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


@dataclass(slots=True, eq=False)
class Step:
    """What was commanded and measured between two times.

    Attributes:
        dipole: (3,) A m^2, the mean on the wire; `doubt` A m^2 by which an axis may differ where not known.
        gyro: (3,) rad/s, the mean of `samples` readings, whose mean time is `gyro_ns`.
        impulse: (3,) A m^2 s, of the dipole after a sample, in the mean of the samples.
        field: (3,) T, the mean of `fields` readings about `field_ns`; None without one.
        late: the measurements of times within the step, in their order.
        before: the estimate at its beginning; None before there was one.
    """

    begin_ns: int
    end_ns: int
    dipole: FloatArray
    doubt: float
    around: Around
    gyro: FloatArray
    gyro_ns: int
    samples: int
    impulse: FloatArray
    field: FloatArray | None
    field_ns: int
    fields: int
    late: list[Measurement] = dataclasses.field(default_factory=list)
    before: FreeMemory | None = None

    @property
    def seconds(self) -> float:
        """Its length, s."""
        return (self.end_ns - self.begin_ns) / SECOND_NS


class OpenStep:
    """Gathers the readings of the step under way."""

    def __init__(self, begin_ns: int, acts: bool) -> None:
        """Begin at a time, with coils that act or rest."""
        self.begin_ns = self.end_ns = begin_ns
        self._acts = acts
        self._rates: list[FloatArray] = []
        self._totals: list[FloatArray] = []
        self._fields: list[FloatArray] = []
        self._rates_ns = self._fields_ns = 0

    def add(self, reading: ImuReading, total: FloatArray, listens: bool) -> None:
        """Add a reading and the dipole's `total` (3,) then; `listens`: the coils do not disturb its field."""
        since = reading.time_ns - self.begin_ns
        self.end_ns = reading.time_ns
        self._rates.append(reading.rate)
        self._totals.append(total)
        self._rates_ns += since
        if listens:
            self._fields.append(reading.field)
            self._fields_ns += since

    def is_over(self, acts: bool, longest_ns: int) -> bool:
        """Return whether it has lasted long enough, or the coils have begun or ceased to act."""
        return acts != self._acts or self.end_ns - self.begin_ns >= longest_ns

    def close(self, dipole: FloatArray, doubt: float, around: Around) -> Step:
        """Return the step from its beginning to the newest reading."""
        samples, fields = len(self._rates), len(self._fields)
        return Step(
            self.begin_ns,
            self.end_ns,
            dipole,
            doubt,
            around,
            np.mean(self._rates, axis=0),
            self.begin_ns + self._rates_ns // samples,
            samples,
            self._totals[-1] - np.mean(self._totals, axis=0),
            np.mean(self._fields, axis=0) if fields else None,
            self.begin_ns + self._fields_ns // max(fields, 1),
            fields,
        )
