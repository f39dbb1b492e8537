"""The table of streams: nominal rate, age limit and valid range of each kind of reading.

As in openpilot's SubMaster, liveness, rate and validity are checked separately. A stale value is not good,
however plausible the value was.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

from flight.loop.fdir import facts
from flight.loop.fdir.facts import Fact
from flight.schema.devices import Camera
from flight.schema.sections import Config

LEAST_RATE = 0.8
"""Fraction of the nominal rate below which a stream is slow."""
_SPAN = 2.0
_SECOND = 1e-9
_PERIODS = 5


class StreamState(IntEnum):
    """The quality of a stream; the values are those of the health packet."""

    NOT_FITTED = 0
    NEVER = 1
    STALE = 2
    INVALID = 3
    SLOW = 4
    GOOD = 5


@dataclass(frozen=True, slots=True)
class Stream:
    """One row: rate in Hz, age limit in s, and the range of its value, in the value's unit.

    `has_silence_alarm`: another fact covers the silence of this stream, so that `poor` does not.
    """

    name: str
    rate_hz: float
    max_age: float
    poor: Fact
    low: float = float("-inf")
    high: float = float("inf")
    has_silence_alarm: bool = True


def streams_of(config: Config) -> tuple[Stream, ...]:
    """Return the streams of the devices that a configuration has."""
    unit, coils, field = config.inertial_unit, config.coils, config.field_range()
    control_hz = config.executive.control_rate_hz
    rows = [
        Stream("imu", float(unit.rate_hz), unit.max_age, facts.IMU_POOR),
        Stream("field", float(unit.rate_hz), unit.max_age, facts.FIELD_POOR, *field),
        Stream("coils", control_hz, coils.stale_after, facts.COILS_POOR),
    ]
    if config.power_monitor is not None:
        most = 1.5 * sum(coils.supply_voltage / resistance for resistance in coils.resistance)
        rows.append(Stream("power", 1.0, 3.0, facts.POWER_POOR, -0.1 * most, most))
    if config.camera is not None:
        camera = config.camera
        rows.append(Stream("camera", 1.0 / _seldom(camera), camera.max_age, facts.CAMERA_POOR))
    if config.gps is not None:
        rows.append(Stream("gps", 1.0 / config.gps.period, config.gps.max_age, facts.GPS_POOR))
    return tuple(rows)


def _seldom(camera: Camera) -> float:
    """Return the longest time, s, between two frames; exposures that follow the rate shift them."""
    if camera.fine_period is None and camera.streak_exposure is None:
        return camera.period
    return max(camera.period, camera.fine_period or 0.0) + max(camera.streak_exposure or (camera.exposure,))


class StreamWatch:
    """Computes the age, rate and state of one stream from its readings."""

    def __init__(self, stream: Stream, time_ns: int) -> None:
        self.stream = stream
        self._window_ns = round(max(_SPAN, _PERIODS / stream.rate_hz) * 1e9)
        self._times: deque[int] = deque(maxlen=max(int(2.0 * stream.rate_hz * self._window_ns * _SECOND), 2))
        self._since_ns = time_ns
        self._valid = True

    def begin(self, time_ns: int) -> None:
        """Discard earlier readings; count from `time_ns`."""
        self._times.clear()
        self._since_ns = time_ns

    def note(self, time_ns: int, value: float | None = None) -> None:
        """Note a reading taken at `time_ns`, with the value that has a range."""
        if self._times and time_ns - self._times[-1] > self._window_ns // 2:
            self._since_ns = time_ns  # a gap is reported as stale, not as slow
        self._times.append(time_ns)
        if value is not None:
            self._valid = self.stream.low <= value <= self.stream.high  # NaN compares false

    def age(self, now_ns: int) -> float:
        """Return the age of the newest reading in s, infinite before the first."""
        return (now_ns - self._times[-1]) * _SECOND if self._times else float("inf")

    def rate(self, now_ns: int) -> float:
        """Return the rate in Hz over the window that ends now, NaN before it is full."""
        begin_ns = now_ns - self._window_ns
        if begin_ns < self._since_ns:
            return float("nan")
        count = sum(1 for time_ns in self._times if time_ns > begin_ns)
        return count / (self._window_ns * _SECOND)

    def state(self, now_ns: int) -> StreamState:
        """Return the state of the stream now."""
        if not self._times:
            return StreamState.NEVER
        if self.age(now_ns) > self.stream.max_age:
            return StreamState.STALE
        if not self._valid:
            return StreamState.INVALID
        if self.rate(now_ns) < LEAST_RATE * self.stream.rate_hz:  # False for NaN: an unknown rate is not slow
            return StreamState.SLOW
        return StreamState.GOOD


class Streams:
    """All streams of a flight, by name; readings of streams that are not fitted are ignored."""

    def __init__(self, rows: tuple[Stream, ...], time_ns: int = 0) -> None:
        self._watches = {row.name: StreamWatch(row, time_ns) for row in rows}

    def begin(self, time_ns: int) -> None:
        """Discard earlier readings; count from `time_ns`."""
        for watch in self._watches.values():
            watch.begin(time_ns)

    def note(self, name: str, time_ns: int, value: float | None = None) -> None:
        """Note a reading of the named stream, if fitted."""
        watch = self._watches.get(name)
        if watch is not None:
            watch.note(time_ns, value)

    def state(self, name: str, now_ns: int) -> StreamState:
        """Return the state of the named stream."""
        watch = self._watches.get(name)
        return StreamState.NOT_FITTED if watch is None else watch.state(now_ns)

    def look(self, now_ns: int) -> list[tuple[Stream, bool | None, str]]:
        """Return for each stream whether it is poor, None when unknown or covered elsewhere, and why."""
        return [(watch.stream, *_poor(watch, now_ns)) for watch in self._watches.values()]


def _poor(watch: StreamWatch, now_ns: int) -> tuple[bool | None, str]:
    stream, state = watch.stream, watch.state(now_ns)
    if state is StreamState.GOOD:
        return False, f"{stream.name}: good again"
    if state is StreamState.NEVER or (state is StreamState.STALE and stream.has_silence_alarm):
        return None, ""
    reason = {
        StreamState.STALE: f"{watch.age(now_ns):.2f} s old, {stream.max_age:g} s allowed",
        StreamState.SLOW: f"{watch.rate(now_ns):.1f} Hz, {stream.rate_hz:g} Hz nominal",
        StreamState.INVALID: f"outside {stream.low:.3g} .. {stream.high:.3g}",
    }[state]
    return True, f"{stream.name}: {state.name.lower()}, {reason}"
