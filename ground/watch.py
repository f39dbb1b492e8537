"""State of a flight from its log or its command socket, as lines of text or as a panel in the terminal."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from flight.app.run import utc_ns
from flight.link import events
from flight.link.commands import CommandPacker, Ping
from flight.link.process.commanding import Stage
from flight.link.telemetry.definitions import (
    ATTITUDE,
    COMMAND,
    EVENT,
    FACTS,
    HEALTH,
    LINK,
    MODES,
    SEVERITIES,
    STEERING,
    TRANSFER,
    VERIFICATION,
)
from flight.link.telemetry.definitions import STREAMS as STREAM_STATES
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import PacketArray, TelemetryError, to_text
from ground.link.commanding import exchange
from ground.telemetry import (
    date_of,
    decode,
    flight_segments,
    is_first,
    named,
    not_a_folder,
    scan,
    with_sorted_events,
)
from knightcube.astro.quaternion import angle_between
from knightcube.errors import KnightCubeError, UsageError, reason_of

if TYPE_CHECKING:
    from rich.console import RenderableType

STREAMS = ("imu", "field", "coils", "power", "camera")
LISTED_EVENTS = 12
SILENT_S = 3.0  # time (s) without a packet of a flight above which the silence is reported
_KEPT_EVENTS = 200
_MAX_TIME = 1e15  # mission time (s) above which a packet is assumed to be damaged
_TIMEOUT_S = 2.0  # longest time (s) to wait for the answer to a ping
_FROM_START_S = 0.1  # latest mission time (s) of the first packet of a complete log
_REPEATED = frozenset({"run", "parameters"})  # packets that a flight sends at its start and repeats later
_OF_LINK = frozenset({LINK.name, VERIFICATION.name, TRANSFER.name, "run"})
"""Packets that the link process sends even if no flight runs."""
_OF_EACH_FLIGHT = frozenset({ATTITUDE.name, HEALTH.name})
"""Periodic packets of a flight; a decrease of their times by more than `_REORDERED_S` shows a restart."""
_REORDERED_S = 5.0
"""Largest decrease (s) of packet times that is attributed to frames that a network has reordered."""
_BAD_STAGES = frozenset({Stage.REFUSED, Stage.FAILED})


class PacketSource(Protocol):
    """A source of the packets of a flight, such as its log or its link."""

    behind: bool
    """Whether the last call of `new` returned only a part of the packets that are available."""

    @property
    def silence(self) -> float:
        """Time (s) since the last packet."""

    def new(self) -> dict[str, PacketArray]:
        """Return the packets that arrived since the last call, by their names.

        Raises KnightCubeError or UsageError.
        """


_PORTION = 1 << 26
"""Number of bytes of a log after which a call of `LogTail.new` returns the packets that it has read."""


class LogTail:
    """Reader of a flight log that may be growing and may end in an incomplete packet."""

    restarts = 0  # a restart of the flight software begins a new log

    def __init__(self, folder: Path) -> None:
        """Start at the oldest segment of the log. Raises UsageError for a folder without a flight log."""
        if not folder.is_dir():
            if folder.exists():
                raise not_a_folder(folder)
            cure = "give the folder of a run, or the socket of a flight in progress"
            raise UsageError(f"{folder}: no such folder or socket; {cure}")
        segments = flight_segments(folder)
        self._folder = folder
        self._path = segments[0]
        self._begins = is_first(segments[0])
        self._offset = 0
        self._rest = b""
        self.behind = False
        self._bytes = self._outside = self._missing = self._others = self._packets = 0
        try:
            age = max(0.0, time.time() - segments[-1].stat().st_mtime)
        except OSError:  # deleted meanwhile
            age = 0.0
        self._grew = time.monotonic() - age

    @property
    def silence(self) -> float:
        """Time (s) since the log last grew, initially from the modification time of its file.

        While the reader is behind the end of the log, the time is zero.
        """
        return 0.0 if self.behind else time.monotonic() - self._grew

    def new(self) -> dict[str, PacketArray]:
        """Return the packets that were written since the last call, by name. Raises UsageError.

        The events are sorted by time. An event that the flight wrote late may be older than events that an
        earlier call returned. A long log is returned in portions by several calls, and `behind` is true until
        its end is reached.
        """
        # After an error, the bytes that were already read remain in `_rest`.
        self._rest += self._read()
        while len(self._rest) < _PORTION and (following := self._following()) is not None:
            # The old segment is complete now, but its last packets may have been written after the last read.
            self._rest += self._read()
            self._path, self._offset = following, 0
            self._rest += self._read()
        self.behind = len(self._rest) >= _PORTION
        found = scan(self._rest, self._begins)
        self._begins = self._begins and not found.counts
        self._rest = self._rest[found.total_bytes - found.truncated_bytes :]
        self._bytes += found.total_bytes - found.truncated_bytes
        self._outside += found.skipped_bytes
        self._missing += sum(found.missing.values())
        self._others += found.other_versions
        self._packets += sum(found.counts.values())
        return with_sorted_events(found.packets)

    @property
    def problem(self) -> str:
        """Damage of the log, or an empty text; packets that are missing between two reads do not count."""
        if not self._packets:
            total = self._bytes + len(self._rest)
            return f"{self._folder}: no valid packet in the {total} bytes of the flight log"
        counts = (
            (self._outside, "bytes are damaged"),
            (self._missing, "packets are missing"),
            (self._others, "packets have another version and are not shown"),
        )
        found = ", ".join(f"{count} {what}" for count, what in counts if count)
        return f"{self._folder}: the flight log is damaged: {found}" if found else ""

    def _read(self) -> bytes:
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read(_PORTION)
        except FileNotFoundError:  # the segment was deleted because the log was too large
            data = b""
        except OSError as error:
            raise UsageError(f"{self._path}: cannot be read: {reason_of(error)}") from error
        if data and self._offset and not self.behind:
            self._grew = time.monotonic()
        self._offset += len(data)
        return data

    def _following(self) -> Path | None:
        def number(path: Path) -> int:
            return int(path.stem.rpartition("-")[2])

        segments = find_segments(self._folder, "flight")
        return next((path for path in segments if number(path) > number(self._path)), None)


@dataclass(frozen=True, slots=True)
class PingAnswer:
    """Answer of a flight to a ping.

    Attributes:
        packets: packets by name; events that an earlier answer contained are omitted.
        count: number of commands that the flight has received since its start.
        delay: time from the ping to the answer, s.
    """

    packets: Mapping[str, PacketArray]
    count: int
    delay: float


def answers(to: str, patience: float, ended: threading.Event) -> Iterator[PingAnswer]:
    """Yield the answers to pings until no answer has been received for `patience` s. Raises UsageError."""
    packer, answered = CommandPacker(), time.monotonic()
    shown: frozenset[bytes] = frozenset()  # events in the previous answer
    while not ended.is_set():
        asked = time.monotonic()
        ping = packer.pack(Ping(int(asked * 1e3) & 0xFFFFFFFF), utc_ns())
        try:
            packets = decode(exchange(to, ping, min(_TIMEOUT_S, patience)))
            (row,) = packets[COMMAND.name]
        except UsageError:
            raise
        except (KnightCubeError, TelemetryError, ValueError):
            if time.monotonic() - answered > patience or ended.wait(min(1.0, patience)):
                return
            continue
        answered = time.monotonic()
        found = packets[EVENT.name]
        # An event may be older than the events before it, because it was held back or the flight restarted.
        packets[EVENT.name] = found[[row.tobytes() not in shown for row in found]]
        shown = frozenset(row.tobytes() for row in found)
        yield PingAnswer(packets, int(row["count"]), answered - asked)


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """An event of the flight log at mission time `time` (s).

    `suppressed` is the number of events of the same kind that were not recorded since the last recorded one.
    """

    time: float
    severity: int
    name: str
    text: str
    suppressed: int = 0


@dataclass(slots=True)
class FlightState:
    """State of a flight: the newest packet of each type, and the newest events.

    Attributes:
        time: mission time of the newest packet, s.
        mode: label of the flight's mode, or an empty text until the mode is known.
        ended: reason for the end of the flight, or an empty text before the end.
        events: newest events.
        faults: number of faults: received events of this severity, and the unrecorded events that these
            count.
        since: mission time of the first packet, s, or None before the first packet. No packet contains the
            number of faults since the start, so faults before this time are not counted.
        newest: newest packets by name.
    """

    time: float = 0.0
    mode: str = ""
    ended: str = ""
    events: deque[LoggedEvent] = field(default_factory=lambda: deque(maxlen=_KEPT_EVENTS))
    faults: int = 0
    since: float | None = None
    newest: dict[str, Any] = field(default_factory=dict)
    _received: float = field(init=False)

    def __post_init__(self) -> None:
        """Begin to measure the time without packets."""
        self._received = time.monotonic()

    def update(self, packets: Mapping[str, PacketArray]) -> list[LoggedEvent]:
        """Update the state with new packets and return the events and failed commands among them.

        If the flight has restarted, mission time and number of faults begin at zero again.
        """
        for name in _OF_EACH_FLIGHT & packets.keys() & self.newest.keys():
            times = packets[name]["time_ns"][-1:] * 1e-9
            if np.any(times < float(self.newest[name]["time_ns"]) * 1e-9 - _REORDERED_S):
                self.time, self.ended, self.faults, self.since = 0.0, "", 0, None
        found = [
            LoggedEvent(
                float(row["time_ns"]) * 1e-9,
                int(row["severity"]),
                printable(to_text(row["name"])),
                printable(to_text(row["text"])),
                int(row["suppressed"]),
            )
            for row in packets["event"]
        ]
        times = [rows["time_ns"][0] for name, rows in packets.items() if len(rows) and name not in _REPEATED]
        if self.since is None and times:
            self.since = float(min(times)) * 1e-9
        for name, rows in packets.items():
            if len(rows):
                self.newest[name] = rows[-1]
                self.time = max(self.time, float(rows["time_ns"][-1]) * 1e-9)
        with_mode = [packets[name][-1:] for name in ("mode", "attitude", "health", "command")]
        modes = [(int(row["time_ns"]), int(row["mode"])) for rows in with_mode for row in rows]
        if modes:
            self.mode = named(MODES, max(modes)[1])
        self.faults += sum(1 + event.suppressed for event in found if event.severity >= events.Severity.FAULT)
        found += _failed_commands(packets.get(VERIFICATION.name, ()))
        self.events.extend(found)
        if any(len(rows) and name not in _OF_LINK for name, rows in packets.items()):
            self._received = time.monotonic()
        ends = [event.text or event.name for event in found if event.name == events.STOPPED.name]
        self.ended = ends[-1] if ends else self.ended
        return found

    @property
    def silence(self) -> float:
        """Time (s) since the last packet of the flight; packets of the link process do not count."""
        return time.monotonic() - self._received

    def value(self, packet: str, name: str) -> Any:
        """Return a field of the newest packet of a type, or None before the first packet."""
        row = self.newest.get(packet)
        return None if row is None else row[name]

    def utc(self, seconds: float) -> str:
        """Return the UTC of a mission time (s) in ISO 8601, or an empty text while the UTC is not known."""
        zero = int(self.value("run", "utc_ns") or 0)
        return date_of(zero + round(seconds * 1e9)) if zero > 0 else ""

    @property
    def alarms(self) -> tuple[str, ...]:
        """Names of the conditions that are active in the newest packet `health`."""
        held = int(self.value("health", "facts") or 0)
        return tuple(name for bit, name in FACTS if held >> bit & 1)

    @property
    def counted_faults(self) -> str:
        """Text with the number of received faults, and the start of the count if the flight began earlier."""
        if self.since is None or self.since <= _FROM_START_S:
            return f"faults {self.faults}"
        return f"faults received {self.faults} since {self.since:.1f} s"

    @property
    def error_deg(self) -> float | None:
        """Angle between the estimated and the target attitude, deg, or None if either is unknown."""
        row = self.newest.get("attitude")
        if row is None or not (np.all(np.isfinite(row["quaternion"])) and np.all(np.isfinite(row["target"]))):
            return None
        pair = [np.asarray(row[name], dtype=float) for name in ("quaternion", "target")]
        if not all(0.5 < np.linalg.norm(one) < 2.0 for one in pair):
            return None
        return math.degrees(float(angle_between(*pair)))


def _failed_commands(rows: Iterable[np.void]) -> list[LoggedEvent]:
    """Return the reports of a link on refused and failed commands, scheduled or not, as warnings."""
    return [
        LoggedEvent(
            float(row["time_ns"]) * 1e-9,
            int(events.Severity.WARNING),
            f"{printable(to_text(row['name'])) or 'command'} {Stage(int(row['stage'])).name.lower()}",
            printable(to_text(row["text"])),
        )
        for row in rows
        if int(row["stage"]) in _BAD_STAGES
    ]


def printable(text: str) -> str:
    """Return a text without control characters, so that a damaged log cannot control the terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


class PlainLines:
    """Writer of text lines: events, and the state once per period of mission time."""

    def __init__(self, state: FlightState, every: float, write: Callable[[str], object]) -> None:
        """Create a writer of all events, and of `state` once in each `every` s of mission time."""
        self._state = state
        self._every = every
        self._write = write
        self._written = -1

    def feed(self, packets: Mapping[str, PacketArray]) -> None:
        """Process new packets in the order of their times, and write their lines."""
        ordered = {}
        for name, arrived in packets.items():
            rows = arrived[np.argsort(arrived["time_ns"], kind="stable")]
            seconds = np.clip(rows["time_ns"] * 1e-9, -_MAX_TIME, _MAX_TIME)
            ordered[name] = np.floor(seconds / self._every).astype(np.int64), rows
        for slot in sorted(set().union(*(np.unique(slots).tolist() for slots, _ in ordered.values()))):
            inside = {
                name: rows[slice(*np.searchsorted(slots, (slot, slot + 1)))]
                for name, (slots, rows) in ordered.items()
            }
            for event in self._state.update(inside):
                self._write(event_line(event, self._state.utc(event.time)) + "\n")
            newest = math.floor(min(self._state.time, _MAX_TIME) / self._every)
            if newest != self._written:
                self._written = newest
                self._write(state_line(self._state) + "\n")


def event_line(event: LoggedEvent, utc: str = "") -> str:
    """Return an event as a line, with its UTC unless the text `utc` is empty."""
    before = f" ({event.suppressed} before it not recorded)" if event.suppressed else ""
    when = f"{event.time:9.3f} s  {utc}{'  ' if utc else ''}"
    return f"{when}{named(SEVERITIES, event.severity):8} {event.name}: {event.text}{before}"


def state_line(state: FlightState) -> str:
    """Return a line with times, mode, attitude, coils, cycle slips, active alarms and faults of a flight."""
    parts = [f"{state.time:9.3f} s", state.utc(state.time), state.mode or "mode not known"]
    parts.append(attitude_text(state))
    written, dipole = state.value("control", "current_written"), state.value("attitude", "dipole")
    if written is not None:
        parts.append("coils " + " ".join(f"{1e3 * current:+.1f}" for current in written) + " mA")
    elif dipole is not None:
        parts.append("dipole " + " ".join(f"{1e3 * value:+.2f}" for value in dipole) + " mA m^2")
    if (steering := state.value("control", "state")) is not None:
        parts.append(f"coils {named(STEERING, steering)}")
    if (slips := state.value("health", "slips")) is not None:
        parts.append(f"slips {int(slips)}")
        parts.append(f"alarms {', '.join(state.alarms) or 'none'}")
    if state.faults or slips is not None:
        parts.append(state.counted_faults)
    return "  ".join(part for part in parts if part)


def attitude_text(state: FlightState) -> str:
    """Return attitude and rate as text, or an empty text without an estimate."""
    rate = state.value("attitude", "rate")
    parts = []
    if (q2 := state.value("control", "q2")) is not None and np.isfinite(q2):
        parts.append(f"q2 {q2:+.4f} -> {state.value('control', 'target_q2'):+.2f}")
    if (error := state.error_deg) is not None:
        parts.append(f"error {error:.2f} deg")
    if rate is not None and np.all(np.isfinite(rate)):
        parts.append(f"{1e3 * float(np.linalg.norm(rate)):.2f} mrad/s")
    return "  ".join(parts)


_BAR = 20  # width (characters) of the bar that shows a coil current
_MODE_COLOURS = {"safe": "bold white on red"} | dict.fromkeys(("boot", "detumble"), "bold black on yellow")
_STREAM_COLOURS = {"good": "green", "no-reading-yet": "dim"}
"""Colours of the stream states that are not alarms."""
_SEVERITY_COLOURS = ("dim", "yellow", "bold red")
_Line = list[tuple[str, str]]
"""Line of the panel as texts with their styles."""


def panel(state: FlightState, silence: float) -> RenderableType:
    """Return the panel of a flight that has sent no packet for `silence` s. Needs the package rich."""
    from rich.console import Group  # noqa: PLC0415 - an extra
    from rich.panel import Panel  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold cyan", no_wrap=True)
    facts.add_column()
    for name, line in _panel_lines(state):
        facts.add_row(name, Text.assemble(*line))
    duration = state.value("run", "duration")
    planned = f" of {duration:.0f}" if duration is not None and math.isfinite(duration) else ""
    times = f"{state.time:.1f} s{planned}  {state.utc(state.time)}".rstrip()
    mode = state.mode or "mode not known"
    colour = _MODE_COLOURS.get(state.mode, "bold black on green")
    title = Text(" ").join([Text(f" {mode} ", colour), Text(times, "bold")])
    silent = f"no packet for {silence:.0f} s" if silence > SILENT_S else ""
    end = Text(f"ended: {state.ended}" if state.ended else silent, "bold")
    listed = Table(box=None, pad_edge=False, show_header=False)
    for column in range(4):
        listed.add_column(no_wrap=column < 3)
    for event in list(state.events)[-LISTED_EVENTS:]:
        colour = _SEVERITY_COLOURS[min(event.severity, len(_SEVERITY_COLOURS) - 1)]
        severity = named(SEVERITIES, event.severity)
        cells = (f"{event.time:9.3f} s  {state.utc(event.time)}", severity, event.name, event.text)
        listed.add_row(*(Text(cell, colour) for cell in cells))
    body = Group(facts, Text(), listed)
    return Panel(body, title=title, title_align="left", subtitle=end, subtitle_align="left")


def _panel_lines(state: FlightState) -> Iterator[tuple[str, _Line]]:
    """Yield the name and the line of each quantity that is known."""
    if (name := state.value("run", "config_name")) is not None:
        kind = "simulated" if state.value("run", "simulated") else "real devices"
        yield "flight", [(f"{printable(to_text(name))}, {kind}", "")]
    yield "attitude", [(attitude_text(state) or "no estimate", "")]
    written, limit = state.value("control", "current_written"), state.value("run", "current_limit")
    for axis, current in zip("xyz", () if written is None else written, strict=False):
        share = abs(current) / limit if limit > 0.0 and math.isfinite(current) else 0.0
        filled = round(_BAR * min(share, 1.0))
        bar = ("█" * filled, "red" if filled == _BAR else "blue")
        yield f"coil {axis}", [(f"{1e3 * current:+8.1f} mA ", ""), bar, ("░" * (_BAR - filled), "")]
    if (steering := state.value("control", "state")) is not None:
        yield "steering", [(named(STEERING, steering), "")]
    if (house := state.newest.get("housekeeping")) is not None:
        volts, amperes, watts = (house[f"coil_{name}"] for name in ("voltage", "current", "power"))
        text = f"{_figure(volts, 2)} V  {_figure(1e3 * amperes, 1)} mA  {_figure(1e3 * watts, 1)} mW"
        yield "coil bus", [(text, "")]
        frames, rates = int(house["frames"]), int(house["streak_rates"])
        yield "camera", [(f"{frames} frames, {rates} rates used by the estimator", "")]
    if (health := state.newest.get("health")) is not None:
        streams = {name: named(STREAM_STATES, health[name]) for name in STREAMS}
        yield (
            "streams",
            [
                (f"{name} {stream}  ", _STREAM_COLOURS.get(stream, "bold red"))
                for name, stream in streams.items()
                if stream != "not-fitted"
            ],
        )
        processor = _figure(100.0 * health["cpu_share"], 0)
        yield "loop", [(f"slips {int(health['slips'])}  processor {processor} %  {state.counted_faults}", "")]


def _figure(value: float, digits: int) -> str:
    """Return a number as text, or "-" if it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
