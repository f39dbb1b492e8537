"""The table of streams: how often each reading should come, how old it may be, where it must lie.

After openpilot's SubMaster a stream is alive, at its rate, and valid, each told apart. Stale is not good: a
value that was fine ten seconds ago says nothing of now.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

from flight.loop.fdir import facts
from flight.loop.fdir.facts import Fact
from flight.schema.sections import Config

LEAST_RATE = 0.8
"""Of the nominal rate: below it a stream is slow."""
_SPAN = 2.0
_SECOND = 1e-9
_PERIODS = 5


class StreamState(IntEnum):
    """What a stream is worth; the values are those of the health packet."""

    NOT_FITTED = 0
    NEVER = 1
    STALE = 2
    INVALID = 3
    SLOW = 4
    GOOD = 5


@dataclass(frozen=True, slots=True)
class Stream:
    """One row: rate in Hz, age limit in s, and the range of its value, in the value's unit.

    `has_silence_alarm`: another alarm tells when it falls silent, so that its own fact need not.
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
    unit, coils, plant = config.inertial_unit, config.coils, config.plant
    control_hz = config.executive.control_rate_hz
    rows = [
        Stream("imu", float(unit.rate_hz), unit.max_age, facts.IMU_POOR),
        Stream(
            "field", float(unit.rate_hz), unit.max_age, facts.FIELD_POOR, 0.2 * plant.field, 3.0 * plant.field
        ),
        Stream("coils", control_hz, coils.stale_after, facts.COILS_POOR),
    ]
    if config.power_monitor is not None:
        most = 1.5 * sum(coils.supply_voltage / resistance for resistance in coils.resistance)
        rows.append(Stream("power", 1.0, 3.0, facts.POWER_POOR, -0.1 * most, most))
    if config.camera is not None:
        camera = config.camera
        rows.append(Stream("camera", 1.0 / camera.period, camera.max_age, facts.CAMERA_POOR))
    return tuple(rows)


class StreamWatch:
    """Watches one stream: told of each reading, asked now and then."""

    def __init__(self, stream: Stream, time_ns: int) -> None:
        self.stream = stream
        self._window_ns = round(max(_SPAN, _PERIODS / stream.rate_hz) * 1e9)
        self._times: deque[int] = deque(maxlen=max(int(2.0 * stream.rate_hz * self._window_ns * _SECOND), 2))
        self._since_ns = time_ns
        self._valid = True

    def begin(self, time_ns: int) -> None:
        """Count from here."""
        self._times.clear()
        self._since_ns = time_ns

    def note(self, time_ns: int, value: float | None = None) -> None:
        """Note a reading taken at `time_ns`, with the value that has a range."""
        if self._times and time_ns - self._times[-1] > self._window_ns // 2:
            self._since_ns = time_ns  # it was silent, which is told apart from being slow
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
        """Return what the stream is worth now."""
        if not self._times:
            return StreamState.NEVER
        if self.age(now_ns) > self.stream.max_age:
            return StreamState.STALE
        if not self._valid:
            return StreamState.INVALID
        if self.rate(now_ns) < LEAST_RATE * self.stream.rate_hz:  # not yet known is not slow
            return StreamState.SLOW
        return StreamState.GOOD


class Streams:
    """All streams of a flight, by name; what is not fitted takes no notes."""

    def __init__(self, rows: tuple[Stream, ...], time_ns: int = 0) -> None:
        self._watches = {row.name: StreamWatch(row, time_ns) for row in rows}

    def begin(self, time_ns: int) -> None:
        """Count from here."""
        for watch in self._watches.values():
            watch.begin(time_ns)

    def note(self, name: str, time_ns: int, value: float | None = None) -> None:
        """Note a reading of the stream of that name, if there is one."""
        watch = self._watches.get(name)
        if watch is not None:
            watch.note(time_ns, value)

    def state(self, name: str, now_ns: int) -> StreamState:
        """Return the state of the stream of that name."""
        watch = self._watches.get(name)
        return StreamState.NOT_FITTED if watch is None else watch.state(now_ns)

    def look(self, now_ns: int) -> list[tuple[Stream, bool | None, str]]:
        """Return of each stream whether it is poor, None when not known or told elsewhere, and why."""
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
