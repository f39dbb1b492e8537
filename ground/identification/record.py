"""What a flight log says for identification: the turn about the thread and the currents, never the truth.

Attitude and rate are the unit's own samples, at the times of its own clock: a busy host notes some late. The
currents are those on the wire (limited and quantised), each from the cycle that asked for it until the next
one's; a wire that is written in a thread of its own shows them a cycle later. The field is the magnetometer's
while all coils are off, since a coil that is on lies beside the magnetometer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.errors import FlightError, UsageError

LEAST_SAMPLES = 200
_AT_LIMIT = 0.97
_RESOLUTION = 1.0e-4  # A; a count of the PWM chip is some 4e-5 A
_SETTLED_FIELD = 0.5  # s after the coils went off until the field is taken
_LONGEST_GAP = 60.0  # s between two samples
_LARGEST = {
    "imu": {"quaternion": 1.001, "rate": 50.0, "field": 0.1},
    "control": {"current_command": 10.0, "current_written": 10.0},
}
"""Beyond which, in SI units, a value was not written by a flight."""


class IdentificationError(FlightError):
    """A record that does not determine the constants; the message says what is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldMeasurement:
    """The horizontal field in T, from `samples` samples while the coils were off, and its scatter's error."""

    magnitude: float
    sigma: float
    samples: int


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """The signals of one flight.

    Attributes:
        time: (n,) s of each sample, increasing.
        angle: (n,) rad, turn about the thread, without jumps.
        rate: (n,) rad/s.
        switch_time: (m,) s from which on each current stands.
        current: (m,) A in the coil on body x.
        clipped: (m,) at the coil's limit, where the true current is not the one on the wire.
        period: s between control cycles.
        field: what the magnetometer measured; None when the coils were never off.
    """

    time: FloatArray
    angle: FloatArray
    rate: FloatArray
    switch_time: FloatArray
    current: FloatArray
    clipped: BoolArray
    period: float
    field: FieldMeasurement | None


def read_record(run: Run, stale_after: float) -> Record:
    """Return the record of a run.

    Without commands for `stale_after` s the driver lets the coils fall to zero. Raises UsageError for a run
    in which another coil was driven too, IdentificationError for a run that is too short, or whose log holds
    values that no flight writes.
    """
    control, imu, label = run["control"], run["imu"], run["run"]
    if len(control) < 2 or len(imu) < LEAST_SAMPLES or not len(label):
        raise IdentificationError(
            f"{run.folder}: {len(imu)} samples and {len(control)} control cycles: too short a flight"
        )
    _refuse_impossible(run, label)
    written = control["current_written"].astype(float)
    if np.any(written[:, 1:]):
        raise UsageError(f"{run.folder}: coils y or z were driven: identification knows the one on x only")
    time = _sample_times(imu)
    once = np.append(True, np.diff(np.maximum.accumulate(time)) > 0.0)
    time, imu = time[once], imu[once]
    gap = float(np.max(np.diff(time), initial=0.0))
    if len(time) < LEAST_SAMPLES or gap > _LONGEST_GAP:
        raise IdentificationError(
            f"{run.folder}: {len(time)} samples in order of time, the longest gap {gap:.3g} s: "
            f"{LEAST_SAMPLES} are needed, and none longer than {_LONGEST_GAP:g} s"
        )
    quaternion = imu["quaternion"].astype(float)
    turn = 2.0 * np.arctan2(quaternion[:, 1], quaternion[:, 3])
    saturation = float(label["supply_voltage"][0] / label["coil_resistance"][0, 0])
    limit = min(float(label["current_limit"][0]), saturation)
    switch_time, current, clipped = _with_stale_ends(control, stale_after, limit)
    return Record(
        time=time,
        angle=np.unwrap(turn),
        rate=imu["rate"][:, 1].astype(float),
        switch_time=switch_time,
        current=current,
        clipped=clipped,
        period=float(label["control_period_ns"][0]) * 1e-9,
        field=_field(time, imu["field"].astype(float), switch_time, current),
    )


def _refuse_impossible(run: Run, label: PacketArray) -> None:
    """Raise IdentificationError for values that no flight writes, NaN among them: they are damage."""
    for packet, fields in _LARGEST.items():
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
    """Return the times (n,) s of the samples: the unit's clock, laid along the earliest of the host's notes.

    Where the unit's clock does not run on (it was restarted), the host's time stamps are used.
    """
    host, unit = imu["sample_time_ns"] * 1e-9, imu["device_time_ns"] * 1e-9
    unit = unit - unit[0]
    if np.any(np.diff(unit) <= 0.0):
        return np.asarray(host)
    stretches = np.array_split(np.arange(len(host)), max(2, len(host) // LEAST_SAMPLES))
    earliest = [part[np.argmin((host - unit)[part])] for part in stretches]
    drift = np.polynomial.Polynomial.fit(unit[earliest], (host - unit)[earliest], 1)
    return np.asarray(unit + drift(unit))


def _currents(control: PacketArray) -> FloatArray:
    """Return the current (m,) A that each cycle brought onto the wire, seen at once or a cycle later."""
    asked = control["current_command"][:, 0].astype(float)
    written = control["current_written"][:, 0].astype(float)
    late = np.append(written[1:], written[-1])
    is_late = (np.abs(written - asked) > _RESOLUTION) & (np.abs(late - asked) <= _RESOLUTION)
    return np.asarray(np.where(is_late, late, written))


def _with_stale_ends(
    control: PacketArray, stale_after: float, limit: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return times, currents and whether at the `limit`, with a zero where commands failed to come."""
    time = control["time_ns"] * 1e-9
    current = _currents(control)
    clipped = np.abs(current) > _AT_LIMIT * limit
    gaps = np.flatnonzero(np.diff(time) > stale_after)
    return (
        np.insert(time, gaps + 1, time[gaps] + stale_after),
        np.insert(current, gaps + 1, 0.0),
        np.insert(clipped, gaps + 1, False),
    )


def _field(
    time: FloatArray, field: FloatArray, switch_time: FloatArray, current: FloatArray
) -> FieldMeasurement | None:
    """Return the mean horizontal field over the samples with the coils off; y lies along the thread."""
    on = np.flatnonzero(current)
    since = np.full(len(switch_time), -np.inf)  # when the coil was last on, as seen from each switch
    if len(on):
        newest = np.searchsorted(on, np.arange(len(switch_time)), side="right") - 1
        ends = np.append(switch_time[1:], np.inf)
        since = np.where(newest >= 0, ends[on[np.maximum(newest, 0)]], -np.inf)
    at = np.searchsorted(switch_time, time, side="right") - 1
    off = (at >= 0) & (current[np.maximum(at, 0)] == 0.0)
    off &= time - since[np.maximum(at, 0)] > _SETTLED_FIELD
    if np.count_nonzero(off) < 20:
        return None
    magnitude = np.hypot(field[off, 0], field[off, 2])
    count = len(magnitude)
    return FieldMeasurement(
        float(np.mean(magnitude)), float(np.std(magnitude, ddof=1) / np.sqrt(count)), count
    )
