"""Events, monitored conditions and streams, which reveal faults to the loop, and the services of all tasks.

Events are written to the flight log, and each event triggers the reaction that belongs to its kind. The first
event of a kind is written at once. Later, at most one event of each kind is written per `THROTTLE_NS`,
together with the number of events held back. A fault in every 40 Hz cycle therefore writes only one event
every few seconds. The last event held back is written with its own time and text.

A monitored condition (class `Fact`) is active or inactive. As in NASA's Limit Checker, it becomes active
after N consecutive updates in which the condition is true; an update with an unknown state (None) leaves the
count unchanged. A latching condition stays active until a command clears it. In modes in which a condition is
not monitored, its count is reset.

A stream is a series of readings of one kind, with nominal rate, age limit and valid range. As in openpilot's
SubMaster, age, rate and range are checked separately, so that a stale value is not used even if it is
plausible.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

from flight.link import events
from flight.link.events import STEERING, EventKind, Mode, Reaction
from flight.link.telemetry.log import Recorder
from flight.loop.executive import JobRunner
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.devices import COIL_NAMES
from hal.interfaces.wires import Clock, Ticker
from knightcube.errors import KnightCubeError

THROTTLE_NS = 5_000_000_000

Sink = Callable[[EventKind, int, int, str], None]
"""Function that writes an event; its arguments are kind, time (ns), number of events held back, and text."""

Reactor = Callable[[EventKind, int, str], None]
"""Function that carries out the reaction to an event, given its kind, time (ns) and text."""


@dataclass(frozen=True, slots=True)
class _HeldBack:
    """The newest held-back event of a kind, and the number `count` of held-back events of this kind."""

    kind: EventKind
    time_ns: int
    text: str
    count: int


class EventLog:
    """Passes events to a sink, and limits the number of written events of each kind.

    The attributes `count` and `counts` include events held back. The attribute `first_texts` contains the
    text of the first event of each kind.
    """

    def __init__(self, sink: Sink, throttle_ns: int = THROTTLE_NS) -> None:
        self._sink = sink
        self._react: Reactor | None = None
        self._throttle_ns = throttle_ns
        self._last_written: dict[int, int] = {}
        self._held_back: dict[int, _HeldBack] = {}
        self.count = 0
        self.counts: Counter[EventKind] = Counter()
        self.first_texts: dict[EventKind, str] = {}

    def react_by(self, react: Reactor) -> None:
        """Call `react` for every event with a reaction besides recording, including events held back."""
        self._react = react

    def report(self, kind: EventKind, time_ns: int, text: str) -> None:
        """Write an event or, if it is held back, only count it; then carry out its reaction."""
        self.count += 1
        self.counts[kind] += 1
        self.first_texts.setdefault(kind, text)
        last_ns, held = self._last_written.get(kind.code), self._held_back.pop(kind.code, None)
        before = held.count if held else 0
        if last_ns is not None and time_ns - last_ns < self._throttle_ns:
            self._held_back[kind.code] = _HeldBack(kind, time_ns, text, before + 1)
        else:
            self._write(kind, time_ns, before, text, time_ns)
        if self._react is not None and kind.reaction is not Reaction.NOTE:
            self._react(kind, time_ns, text)

    def release(self, now_ns: int) -> None:
        """Write the newest held-back event of each kind whose throttle time is over."""
        for code, held in list(self._held_back.items()):
            if now_ns - self._last_written[code] >= self._throttle_ns:
                self._release(held, now_ns)

    def flush(self, now_ns: int) -> None:
        """At the end of the flight, write the newest held-back event of each kind."""
        for held in list(self._held_back.values()):
            self._release(held, now_ns)

    def _release(self, held: _HeldBack, now_ns: int) -> None:
        del self._held_back[held.kind.code]
        self._write(held.kind, held.time_ns, held.count - 1, held.text, now_ns)

    def _write(self, kind: EventKind, time_ns: int, held_back: int, text: str, now_ns: int) -> None:
        self._last_written[kind.code] = now_ns
        self._sink(kind, time_ns, held_back, text)


EVERYWHERE = frozenset(Mode)
_DRIVEN = STEERING | {Mode.DETUMBLE}


@dataclass(frozen=True, slots=True)
class Fact:
    """A monitored condition, with the events that are reported when it becomes active and inactive.

    Conditions are updated either in every control cycle (40 Hz) or in every run of the health task.

    Attributes:
        after: number of consecutive true updates after which the condition is active.
        mended_after: number of consecutive false updates after which the condition is inactive again.
        latching: whether only a command can make the condition inactive.
        modes: modes in which the condition is monitored; in other modes, it is inactive.
    """

    name: str
    begins: EventKind
    ends: EventKind | None = None
    after: int = 1
    mended_after: int = 1
    latching: bool = False
    modes: frozenset[Mode] = EVERYWHERE


BOOT_WAITS = Fact("boot-waits", events.BOOT_WAITS, modes=frozenset({Mode.BOOT}))
TASK_FAILING = Fact("task-failing", events.TASK_FAILING, latching=True)
NO_PROGRESS = Fact("no-progress", events.NO_PROGRESS)
IMU_SILENT = Fact("imu-silent", events.IMU_SILENT, events.IMU_RECOVERED)
IMU_UNUSABLE = Fact("imu-unusable", events.IMU_UNUSABLE, events.IMU_RECOVERED)
IMU_LINE_LOST = Fact("imu-line-lost", events.IMU_LINE_LOST, events.IMU_RECOVERED)
CONTROL_LOST = Fact("control-lost", events.CONTROL_LOST, events.CONTROL_REGAINED)
BLIND = Fact("blind", events.BLIND, modes=_DRIVEN | {Mode.ACQUIRE})
TUMBLING = Fact("tumbling", events.TUMBLING, after=8, modes=STEERING | {Mode.ACQUIRE})
HOLD_IMPOSSIBLE = Fact(
    "hold-impossible", events.HOLD_IMPOSSIBLE, modes=frozenset({Mode.HOLD, Mode.TESTBED_DEMO})
)
SLEW_LATE = Fact("slew-late", events.SLEW_LATE, modes=frozenset({Mode.SLEW}))
HOLDING = Fact("holding", events.HOLDING, modes=frozenset({Mode.SLEW, Mode.TESTBED_DEMO}))
COIL_FAULT = Fact("coil-fault", events.COIL_FAULT, events.COIL_RECOVERED)
COIL_X_BROKEN, COIL_Y_BROKEN, COIL_Z_BROKEN = (
    Fact(f"coil-{name}-broken", events.COIL_BROKEN, latching=True) for name in COIL_NAMES[:3]
)
COIL_SUSPECT = Fact("coil-suspect", events.COIL_SUSPECT)
COMMANDS_DOUBTED = Fact("commands-doubted", events.COMMANDS_DOUBTED, events.COMMANDS_TRUSTED)
POWER_DOUBTED = Fact("power-doubted", events.POWER_DOUBTED)
POWER_FAULT = Fact("power-fault", events.POWER_FAULT, events.POWER_RECOVERED)
CAMERA_LOST = Fact("camera-lost", events.CAMERA_LOST, events.CAMERA_RECOVERED)
LOG_FAULT = Fact("log-fault", events.LOG_FAULT, events.LOG_RECOVERED)
CPU_HIGH = Fact("cpu-high", events.CPU_HIGH, events.RESOURCE_NORMAL, after=3, mended_after=3)
MEMORY_GROWS = Fact("memory-grows", events.MEMORY_GROWS, events.RESOURCE_NORMAL, after=3, mended_after=3)
MEMORY_HIGH = Fact("memory-high", events.MEMORY_HIGH, after=3)
DISK_LOW = Fact("disk-low", events.DISK_LOW, events.RESOURCE_NORMAL, after=2, mended_after=2)
HOT = Fact("hot", events.HOT, events.RESOURCE_NORMAL, after=2, mended_after=2)
TOO_HOT = Fact("too-hot", events.TOO_HOT, after=2, latching=True)
IMU_POOR, FIELD_POOR, COILS_POOR, POWER_POOR, CAMERA_POOR = (
    Fact(f"{stream}-poor", events.STREAM_POOR, events.STREAM_GOOD, after=4, mended_after=8)
    for stream in ("imu", "field", "coils", "power", "camera")
)
SERVICE_FAILING = Fact("service-failing", events.SERVICE_FAILING, events.SERVICE_RECOVERED)
CAMERA_LATE = Fact("camera-late", events.CAMERA_LATE, events.CAMERA_RECOVERED)
VISION_SLOW = Fact("vision-slow", events.VISION_SLOW)
GPS_LOST = Fact("gps-lost", events.GPS_LOST, events.GPS_RECOVERED)
GPS_POOR = Fact("gps-poor", events.STREAM_POOR, events.STREAM_GOOD, after=4, mended_after=8)
STRINGS_LOST = Fact("strings-lost", events.STRINGS_LOST, events.STRINGS_RECOVERED)
SUN_UNCLEAR = Fact("sun-unclear", events.SUN_UNCLEAR, events.SUN_CLEAR, after=3, mended_after=3)
CLOCK_OFF = Fact("clock-off", events.CLOCK_OFF, after=2)
FIELD_REFUSED = Fact("field-refused", events.FIELD_REFUSED, events.FIELD_TRUSTED)
WIDE_LOST = Fact("wide-lost", events.WIDE_LOST, events.WIDE_RECOVERED)
WIDE_FALSE = Fact("wide-false", events.WIDE_FALSE, events.WIDE_TRUSTED, after=3)
COIL_4_BROKEN, COIL_5_BROKEN, COIL_6_BROKEN = (
    Fact(f"coil-{name}-broken", events.COIL_BROKEN, latching=True) for name in COIL_NAMES[3:]
)
COILS_BROKEN = (COIL_X_BROKEN, COIL_Y_BROKEN, COIL_Z_BROKEN, COIL_4_BROKEN, COIL_5_BROKEN, COIL_6_BROKEN)
"""Conditions that are active while a coil is diagnosed as broken, in the order of the coils."""
FIELD_EXTRAPOLATED = Fact("field-extrapolated", events.FIELD_EXTRAPOLATED)
GYRO_LOST = Fact("gyro-lost", events.GYRO_LOST, events.GYRO_RECOVERED, after=4, mended_after=4)
BATTERY_LOW = Fact("battery-low", events.BATTERY_LOW, events.BATTERY_RECOVERED, after=3, mended_after=3)
BATTERY_VERY_LOW = Fact(
    "battery-very-low", events.BATTERY_VERY_LOW, events.BATTERY_RECOVERED, after=3, mended_after=3
)
BATTERY_CRITICAL = Fact(
    "battery-critical", events.BATTERY_CRITICAL, events.BATTERY_CHARGED, after=3, mended_after=3
)
BATTERY_MONITOR_LOST, BUS_MONITOR_LOST = (
    Fact(name, events.POWER_SENSOR_LOST, events.POWER_SENSOR_RECOVERED, after=3, mended_after=3)
    for name in ("battery-monitor-lost", "bus-monitor-lost")
)

FACTS: tuple[Fact, ...] = tuple(value for value in dict(vars()).values() if isinstance(value, Fact))


def check(facts: Iterable[Fact], modes_of: Callable[[Reaction], frozenset[Mode]]) -> None:
    """Check the table of monitored conditions, and raise KnightCubeError with the name of an invalid row.

    `modes_of` is a function that returns the modes in which a reaction has an effect. A condition is invalid
    if the reaction to its event has no effect in any mode in which the condition is monitored.
    """
    seen: set[str] = set()
    for fact in facts:
        if fact.name in seen:
            raise KnightCubeError(f"condition {fact.name} is listed twice in the table")
        seen.add(fact.name)
        if fact.after < 1 or fact.mended_after < 1:
            raise KnightCubeError(f"condition {fact.name}: the numbers of updates must be at least 1")
        if not fact.modes & modes_of(fact.begins.reaction):
            raise KnightCubeError(
                f"condition {fact.name}: its reaction {fact.begins.reaction.name.lower()} has no effect "
                "in any mode in which the condition is monitored"
            )


@dataclass(slots=True)
class _State:
    holds: bool = False
    count: int = 0
    cause: str = ""


class Facts:
    """States of all monitored conditions; reports an event when a condition becomes active or inactive."""

    def __init__(self, event_log: EventLog) -> None:
        self._events = event_log
        self._states = {fact.name: _State() for fact in FACTS}
        self._mode = Mode.BOOT

    def update(self, fact: Fact, holds: bool | None, now_ns: int, text: str | Callable[[], str]) -> None:
        """Update a condition (`holds` is None if unknown); report a change as an event with `text`.

        If `text` is a function that returns the text, it is called only if the condition changes.
        """
        state = self._states[fact.name]
        if holds is None or self._mode not in fact.modes:
            return
        if holds == state.holds:
            state.count = 0
            return
        state.count += 1
        if state.holds and (fact.latching or state.count < fact.mended_after):
            return
        if not state.holds and state.count < fact.after:
            return
        text = text if isinstance(text, str) else text()
        state.holds, state.count, state.cause = holds, 0, text if holds else ""
        kind = fact.begins if holds else fact.ends
        if kind is not None:
            self._events.report(kind, now_ns, text)

    def holds(self, fact: Fact) -> bool:
        """Return whether a monitored condition is active."""
        return self._states[fact.name].holds

    def held(self) -> tuple[Fact, ...]:
        """Return the active conditions, in the order of the table."""
        return tuple(fact for fact in FACTS if self._states[fact.name].holds)

    def cause(self, fact: Fact) -> str:
        """Return the event text with which a condition became active, or "" for an inactive condition."""
        return self._states[fact.name].cause

    def clear(self, event_name: str) -> bool:
        """Make the latched conditions that reported an event inactive, and return whether there were any."""
        found = [fact for fact in self.held() if fact.latching and fact.begins.name == event_name]
        for fact in found:
            self._states[fact.name] = _State()
        return bool(found)

    def release(self, fact: Fact) -> None:
        """Make a latched condition inactive, so that it is reported again if its cause persists."""
        self._states[fact.name] = _State()

    def enter(self, mode: Mode) -> None:
        """Monitor the conditions of `mode`, and reset all conditions that are not monitored in this mode."""
        self._mode = mode
        for fact in FACTS:
            if mode not in fact.modes:
                self._states[fact.name] = _State()


LEAST_RATE = 0.8
"""Fraction of the nominal rate below which a stream is slow."""
_SPAN = 2.0
_SECOND = 1e-9
_PERIODS = 5


class StreamState(IntEnum):
    """Quality of a stream; the values are the numbers in the health packet.

    A stream without a reading is NO_READING_YET until its age limit has passed since the start, and NEVER
    afterwards.
    """

    NOT_FITTED = 0
    NEVER = 1
    STALE = 2
    INVALID = 3
    SLOW = 4
    GOOD = 5
    NO_READING_YET = 6


@dataclass(frozen=True, slots=True)
class StreamLimits:
    """Limits of a stream: nominal rate (Hz), age limit (s), and range of its value in the value's unit.

    `has_silence_alarm` states whether another monitored condition reports missing readings; if so, the
    condition `poor` does not report them.
    """

    name: str
    rate_hz: float
    max_age: float
    poor: Fact
    low: float = float("-inf")
    high: float = float("inf")
    has_silence_alarm: bool = True


def streams_of(config: Config) -> tuple[StreamLimits, ...]:
    """Return the stream limits of the devices in a configuration."""
    unit, coils, field = config.inertial_unit, config.coils, config.field_range()
    rows = [
        StreamLimits("imu", float(unit.rate_hz), unit.max_age, IMU_POOR),
        StreamLimits("field", float(unit.rate_hz), unit.max_age, FIELD_POOR, *field),
        StreamLimits("coils", CONTROL_RATE_HZ, coils.stale_after, COILS_POOR),
    ]
    if config.power_monitor is not None:
        most = 1.5 * sum(coils.supply_voltage / resistance for resistance in coils.resistance)
        rows.append(StreamLimits("power", 1.0, 3.0, POWER_POOR, -0.1 * most, most))
    if config.camera is not None:
        camera = config.camera
        longest = camera.period
        if camera.fine_period is not None or camera.streak_exposure is not None:
            # The period of the frames varies if the exposure time depends on the body rate.
            longest = max(longest, camera.fine_period or 0.0)
            longest += max(camera.streak_exposure or (camera.exposure,))
        rows.append(StreamLimits("camera", 1.0 / longest, camera.max_age, CAMERA_POOR))
    if config.gps is not None:
        rows.append(StreamLimits("gps", 1.0 / config.gps.period, config.gps.max_age, GPS_POOR))
    return tuple(rows)


class StreamWatch:
    """Computes the age, rate and state of one stream from its readings."""

    def __init__(self, stream: StreamLimits, time_ns: int) -> None:
        self.stream = stream
        self._window_ns = round(max(_SPAN, _PERIODS / stream.rate_hz) * 1e9)
        self._times: deque[int] = deque(maxlen=max(int(2.0 * stream.rate_hz * self._window_ns * _SECOND), 2))
        self._begin_ns = self._since_ns = time_ns
        self._valid = True

    def begin(self, time_ns: int) -> None:
        """Discard earlier readings. From `time_ns` on, measure the rate and the time without a reading."""
        self._times.clear()
        self._begin_ns = self._since_ns = time_ns

    def note(self, time_ns: int, value: float | None = None) -> None:
        """Record a reading made at `time_ns`, and the value that must be within the valid range."""
        if self._times and time_ns - self._times[-1] > self._window_ns // 2:
            self._since_ns = time_ns  # after a gap, which makes the stream stale, the rate is measured again
        self._times.append(time_ns)
        if value is not None:
            self._valid = self.stream.low <= value <= self.stream.high  # NaN compares false

    def age(self, now_ns: int) -> float:
        """Return the age (s) of the newest reading, which is infinite before the first reading."""
        return (now_ns - self._times[-1]) * _SECOND if self._times else float("inf")

    def rate(self, now_ns: int) -> float:
        """Return the rate (Hz) in the window that ends now, or NaN while the window is incomplete."""
        begin_ns = now_ns - self._window_ns
        if begin_ns < self._since_ns:
            return float("nan")
        count = len(self._times) - bisect_right(self._times, begin_ns)
        return count / (self._window_ns * _SECOND)

    def state(self, now_ns: int) -> StreamState:
        """Return the present state of the stream."""
        if not self._times:
            waited = (now_ns - self._begin_ns) * _SECOND
            return StreamState.NEVER if waited > self.stream.max_age else StreamState.NO_READING_YET
        if self.age(now_ns) > self.stream.max_age:
            return StreamState.STALE
        if not self._valid:
            return StreamState.INVALID
        # The ratio is rounded so that exactly 80 % is not slow. A stream of unknown rate (NaN) is not slow.
        if round(self.rate(now_ns) / self.stream.rate_hz, 9) < LEAST_RATE:
            return StreamState.SLOW
        return StreamState.GOOD

    def poor(self, now_ns: int) -> tuple[bool | None, str]:
        """Return whether the readings are poor, and why; None if unknown or reported by other conditions."""
        stream, state = self.stream, self.state(now_ns)
        if state is StreamState.GOOD:
            return False, f"{stream.name}: good again"
        without_reading = state in (StreamState.NEVER, StreamState.NO_READING_YET)
        if without_reading or (state is StreamState.STALE and stream.has_silence_alarm):
            return None, ""
        reason = {
            StreamState.STALE: f"{self.age(now_ns):.2f} s old, {stream.max_age:g} s allowed",
            StreamState.SLOW: f"{self.rate(now_ns):.3g} Hz, {stream.rate_hz:g} Hz nominal",
            StreamState.INVALID: f"outside {stream.low:.3g} to {stream.high:.3g}",
        }[state]
        return True, f"{stream.name}: {state.name.lower()}, {reason}"


class Streams:
    """All streams of a flight by name. Readings from devices that are not configured are ignored."""

    def __init__(self, rows: tuple[StreamLimits, ...]) -> None:
        self._watches = {row.name: StreamWatch(row, 0) for row in rows}

    def begin(self, time_ns: int) -> None:
        """Discard earlier readings. From `time_ns` on, measure rates and times without a reading."""
        for watch in self._watches.values():
            watch.begin(time_ns)

    def note(self, name: str, time_ns: int, value: float | None = None) -> None:
        """Record a reading of the named stream, if this stream is configured."""
        watch = self._watches.get(name)
        if watch is not None:
            watch.note(time_ns, value)

    def state(self, name: str, now_ns: int) -> StreamState:
        """Return the state of the named stream."""
        watch = self._watches.get(name)
        return StreamState.NOT_FITTED if watch is None else watch.state(now_ns)

    def look(self, now_ns: int) -> list[tuple[StreamLimits, bool | None, str]]:
        """Return for each stream its limits, whether its readings are poor, and why."""
        return [(watch.stream, *watch.poor(now_ns)) for watch in self._watches.values()]


CLOCK_OFF_NS = 1_000_000_000
"""Largest accepted difference (ns) between the wall clock and the GPS receiver's time."""


class FlightClock:
    """Clock of the `host`, with the GPS receiver's UTC if the host's UTC is off by more than a second."""

    def __init__(self, host: Clock) -> None:
        self.host = host
        self._offset_ns: int | None = None

    def now_ns(self) -> int:
        """Return the monotonic time, ns."""
        return self.host.now_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the monotonic time `deadline_ns`. Return at once if the deadline has passed."""
        self.host.sleep_until_ns(deadline_ns)

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns`, by the clock of the host."""
        return self.host.ticker(name, period_ns, job)

    @property
    def tickers(self) -> Sequence[Ticker]:
        """Running tickers in the order of their creation."""
        return self.host.tickers

    def correct(self, utc_ns: int, time_ns: int) -> int:
        """Accept the receiver's UTC (ns) at a monotonic time, and return the error (ns) of the host's UTC."""
        self._offset_ns = utc_ns - time_ns
        return self.host.utc_ns() - self.host.now_ns() - self._offset_ns

    def utc_ns(self) -> int:
        """Return the best known UTC in ns since 1970."""
        host_ns = self.host.utc_ns()
        if self._offset_ns is None:
            return host_ns
        best_ns = self.host.now_ns() + self._offset_ns
        return host_ns if abs(host_ns - best_ns) <= CLOCK_OFF_NS else best_ns


@dataclass(frozen=True, slots=True)
class Services:
    """The clock, the workers, the recorder, and the tables of events, monitored conditions and streams."""

    clock: FlightClock
    jobs: JobRunner
    recorder: Recorder
    events: EventLog
    facts: Facts
    streams: Streams
