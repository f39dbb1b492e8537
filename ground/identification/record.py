"""Signals of a flight log for identification: the rotation about the thread and the coil currents.

The truth log of a simulated flight is not used. Attitude and rate are samples of the inertial unit with the
times of the unit's own clock, because a busy host timestamps some samples late. The currents are the
commanded currents after limiting and quantisation. Each current is assumed to flow from the cycle that
requested it until the next cycle. A coil driver with its own thread reports a current one control cycle after
the cycle that requested it. The field is measured while all coils are off, because an active coil disturbs
the magnetometer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.link.events import Severity
from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run, text_of
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.errors import KnightCubeError, UsageError

MIN_SAMPLES = 200
MAX_STEP = 0.025
"""Longest time step (s) between two events of a timeline."""
_AT_LIMIT = 0.97
"""Fraction of a coil's current limit above which the actual current may differ from the commanded current."""
_RESOLUTION = 1.0e-4
"""Difference (A) above which two currents count as different; one PWM count is about 4e-5 A."""
_SETTLED_FIELD = 0.5  # time (s) from switching off the coils until the field is measured
_MAX_GAP = 60.0  # longest allowed time (s) between two samples
_CLIPPED_VARIANCE = 100.0  # variance of a current at the coil's limit, relative to other currents
_MAX_VALUES = {
    "imu": {"quaternion": 1.001, "rate": 50.0, "field": 0.1},
    "control": {"current_command": 10.0, "current_written": 10.0},
}
"""Largest plausible values of recorded quantities, in SI units."""


class IdentificationError(KnightCubeError):
    """Error for a record that does not determine the constants; the message says what is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class HorizontalField:
    """Measured horizontal field.

    Attributes:
        magnitude: field, T.
        sigma: standard deviation of the magnitude, from the scatter of the samples, T.
        samples: number of samples.
        offset: offset of the magnetometer that is subtracted, T; 0 if the offset is not significant.
    """

    magnitude: float
    sigma: float
    samples: int
    offset: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Signals of one flight.

    Attributes:
        time: increasing times (n,) of the samples, s.
        angle: continuous rotation (n,) about the thread, rad.
        rate: gyro reading (n,) about the thread, rad/s.
        switch_time: times (m,) from which each current flows, s.
        current: currents (m,) in the coil on body x, A.
        clipped: mask (m,) of currents at the coil's limit, which may differ from the commanded current.
        period: control period, s.
        field: measured magnetic field, or None if the coils were never off.
    """

    time: FloatArray
    angle: FloatArray
    rate: FloatArray
    switch_time: FloatArray
    current: FloatArray
    clipped: BoolArray
    period: float
    field: HorizontalField | None


def read_record(run: Run, stale_after: float) -> Record:
    """Return the identification record of a run.

    After `stale_after` s without a command the driver sets the coil currents to zero. Raises UsageError for a
    run in which another coil was driven too, and IdentificationError for a run that is too short or whose log
    is damaged.
    """
    control, imu, label = run["control"], run["imu"], run["run"]
    if len(control) < 2 or len(imu) < MIN_SAMPLES or not len(label):
        raise IdentificationError(
            f"{run.folder}: {len(imu)} samples and {len(control)} control cycles: the run is too short, "
            f"identification needs {MIN_SAMPLES} samples"
        )
    _refuse_impossible(run, label)
    if np.any(control["current_written"][:, 1:].astype(float)):
        why = next((text for text in reported_problems(run) if text.startswith("coil-broken")), "")
        because = f", because the flight reported {why}: repair the coil, and fly again" if why else ""
        cure = because or "; identification needs a flight with coil x only"
        raise UsageError(f"{run.folder}: coils y or z were driven{cure}")
    time = _sample_times(imu)
    once = np.append(True, np.diff(np.maximum.accumulate(time)) > 0.0)
    time, imu = time[once], imu[once]
    gap = float(np.max(np.diff(time), initial=0.0))
    if len(time) < MIN_SAMPLES or gap > _MAX_GAP:
        raise IdentificationError(
            f"{run.folder}: {len(time)} samples in order of time with a longest gap of {gap:.3g} s; "
            f"identification needs {MIN_SAMPLES} samples and no gap above {_MAX_GAP:g} s"
        )
    quaternion = imu["quaternion"].astype(float)
    angle = np.unwrap(2.0 * np.arctan2(quaternion[:, 1], quaternion[:, 3]))
    saturation = float(label["supply_voltage"][0] / label["coil_resistance"][0, 0])
    limit = min(float(label["current_limit"][0]), saturation)
    switch_time, current, clipped = _currents(control, stale_after, limit)
    return Record(
        time=time,
        angle=angle,
        rate=imu["rate"][:, 1].astype(float),
        switch_time=switch_time,
        current=current,
        clipped=clipped,
        period=float(label["control_period_ns"][0]) * 1e-9,
        field=_field(time, imu["field"].astype(float), angle, switch_time, current),
    )


def reported_problems(run: Run) -> list[str]:
    """Return name, count and first text of each kind of warning and fault that a flight reported."""
    events = run["event"]
    events = events[events["severity"] >= Severity.WARNING]
    names, first, counts = np.unique(events["name"], return_index=True, return_counts=True)
    return [
        f"{text_of(names[k])} ({counts[k]}): {text_of(events['text'][first[k]])}"
        for k in np.argsort(first).tolist()
    ]


def _refuse_impossible(run: Run, label: PacketArray) -> None:
    """Raise IdentificationError for values, including NaN, that only a damaged log can contain."""
    for packet, fields in _MAX_VALUES.items():
        for name, largest in fields.items():
            values = run[packet][name].reshape(len(run[packet]), -1)
            bad = np.argwhere(~(np.abs(values) <= largest))
            if len(bad):
                value = float(values[tuple(bad[0])])
                raise IdentificationError(f"{run.folder}: {packet}, {name} = {value:g}: the log is damaged")
    for name in ("control_period_ns", "current_limit", "supply_voltage", "coil_resistance"):
        value = float(label[name].reshape(len(label), -1)[0, 0])
        if not 0.0 < value < np.inf:
            raise IdentificationError(f"{run.folder}: run, {name} = {value:g}: the log is damaged")
    if np.any(np.diff(run["control"]["time_ns"]) <= 0):
        raise IdentificationError(f"{run.folder}: control cycles out of order: the log is damaged")


def _sample_times(imu: PacketArray) -> FloatArray:
    """Return the times (n,), s, of the samples, from the unit's clock fitted to the earliest host timestamps.

    The host timestamps are used if the unit's clock was restarted.
    """
    host, unit = imu["sample_time_ns"] * 1e-9, imu["device_time_ns"] * 1e-9
    unit = unit - unit[0]
    if np.any(np.diff(unit) <= 0.0):
        return np.asarray(host)
    segments = np.array_split(np.arange(len(host)), max(2, len(host) // MIN_SAMPLES))
    earliest = [segment[np.argmin((host - unit)[segment])] for segment in segments]
    drift = np.polynomial.Polynomial.fit(unit[earliest], (host - unit)[earliest], 1)
    return np.asarray(unit + drift(unit))


def _currents(
    control: PacketArray, stale_after: float, limit: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return switch times, coil currents, and whether each current is at the `limit`.

    A current of zero is inserted at each time at which the driver switched the coils off because of a stale
    command.
    """
    time = control["time_ns"] * 1e-9
    requested, written = (
        control[name][:, 0].astype(float) for name in ("current_command", "current_written")
    )
    # A driver with its own thread reports each current one cycle late.
    late = np.append(written[1:], written[-1])
    is_late = (np.abs(written - requested) > _RESOLUTION) & (np.abs(late - requested) <= _RESOLUTION)
    current = np.asarray(np.where(is_late, late, written))
    clipped = np.abs(current) > _AT_LIMIT * limit
    gaps = np.flatnonzero(np.diff(time) > stale_after)
    return (
        np.insert(time, gaps + 1, time[gaps] + stale_after),
        np.insert(current, gaps + 1, 0.0),
        np.insert(clipped, gaps + 1, False),
    )


_OFFSET_SIGMAS, _OFFSET_SHARE, _MOST_OFFSET = 6.0, 0.01, 0.5
"""Limits of a subtracted magnetometer offset: minimum in standard deviations, and minimum and maximum as
fractions of the field."""
_LEAST_ROTATION = 0.1
"""Smallest standard deviation (rad) of the angle that separates magnetometer offset and field."""


def _field(
    time: FloatArray, field: FloatArray, angle: FloatArray, switch_time: FloatArray, current: FloatArray
) -> HorizontalField | None:
    """Return the mean horizontal field (perpendicular to the thread, axis y) while the coils are off.

    The field rotates with the body, whose rotation about the thread is `angle` (n,), rad, but an offset of
    the magnetometer does not. If the rotations show a significant offset, the offset is subtracted. Returns
    None if the coils were never off, or if most of the measured field does not rotate with the body.
    """
    on = np.flatnonzero(current)
    since = np.full(len(switch_time), -np.inf)  # end of the newest non-zero current at each switch time
    if len(on):
        newest = np.searchsorted(on, np.arange(len(switch_time)), side="right") - 1
        ends = np.append(switch_time[1:], np.inf)
        since = np.where(newest >= 0, ends[on[np.maximum(newest, 0)]], -np.inf)
    at = np.searchsorted(switch_time, time, side="right") - 1
    off = (at >= 0) & (current[np.maximum(at, 0)] == 0.0)
    off &= time - since[np.maximum(at, 0)] > _SETTLED_FIELD
    if np.count_nonzero(off) < 20:
        return None
    complex_field = field[off, 0] + 1j * field[off, 2]
    terms = np.stack([np.exp(1j * angle[off]), np.ones(np.count_nonzero(off))], axis=1)
    (rotating, offset), *_ = np.linalg.lstsq(terms, complex_field, rcond=None)
    residual = float(np.sqrt(np.mean(np.abs(complex_field - terms @ [rotating, offset]) ** 2)))
    inverse = np.linalg.pinv(terms.conj().T @ terms).real
    sigmas = residual * np.sqrt(np.diag(inverse))
    strength, constant = float(abs(rotating)), float(abs(offset))
    rotated = float(np.std(angle[off])) > _LEAST_ROTATION
    if rotated and constant > max(_OFFSET_SIGMAS * float(sigmas[1]), _OFFSET_SHARE * strength):
        corrected = HorizontalField(strength, float(sigmas[0]), len(complex_field), constant)
        return corrected if constant < _MOST_OFFSET * strength else None
    magnitude = np.hypot(field[off, 0], field[off, 2])
    sigma = float(np.std(magnitude, ddof=1) / np.sqrt(len(magnitude)))
    return HorizontalField(float(np.mean(magnitude)), sigma, len(magnitude))


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Time steps with a constant current, each of which ends at an event: a sample or a change of current.

    Attributes:
        span: time (k,) since the previous event, s.
        current: current (k,) during the time step, A.
        variance: variance (k,) of the current relative to that of an active coil, zero while the coil is off.
        sample: index (k,) of the sample at the event, or -1 for an event without a sample.
        jump: change (k,) of the current at the event, A.
    """

    span: FloatArray
    current: FloatArray
    variance: FloatArray
    sample: IntArray
    jump: FloatArray

    @classmethod
    def of(cls, record: Record, delay: float) -> Timeline:
        """Return the events from the first to the last sample; currents change `delay` s after `switch_time`.

        The current before the first switch time is zero. Intervals longer than `MAX_STEP` are divided.
        """
        switch = record.switch_time + delay
        inside = (switch > record.time[0]) & (switch < record.time[-1])
        gaps = np.diff(record.time)
        cuts = [
            np.linspace(record.time[i], record.time[i + 1], int(gaps[i] / MAX_STEP) + 2)[1:-1]
            for i in np.flatnonzero(gaps > 1.5 * MAX_STEP).tolist()
        ]
        divided = np.concatenate([np.empty(0), *cuts])
        times = np.concatenate([record.time[1:], switch[inside], divided])
        samples = len(record.time) - 1
        sample = np.append(np.arange(1, samples + 1), np.full(len(times) - samples, -1))
        jump = np.zeros(len(times))
        jump[samples : len(times) - len(divided)] = np.diff(record.current, prepend=0.0)[inside]
        order = np.lexsort((sample < 0, times))  # at equal times a sample precedes a change of the current
        times = times[order]
        # A current that is switched at the time of an event flows only after the event.
        flowing = np.searchsorted(switch, times, side="left")
        current = np.append(0.0, record.current)[flowing]
        clipped = np.append(False, record.clipped)[flowing]
        variance = np.where(current == 0.0, 0.0, np.where(clipped, _CLIPPED_VARIANCE, 1.0))
        return cls(np.diff(times, prepend=record.time[0]), current, variance, sample[order], jump[order])
