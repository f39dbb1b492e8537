"""History of a flight for the console: all packets by time, and the state at a chosen time.

The packets of hours of flight at 40 Hz do not fit into the memory of a ground computer. The packets are
therefore stored in temporary files, and only their times (8 bytes each) are in memory.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.packets import LAYOUTS, Layout, PacketArray, to_text
from ground.watch import printable
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]
LISTED = ("event", "command", "verification", "streak", "stars", "sightings")
"""Packet types that the page lists one by one; of all other types the page shows only the newest packet."""
MAX_SPEED = 1000.0
"""Highest speed of a replay, as multiple of real time."""
MAX_TIME = 1e9
"""Latest mission time (s) that a reader can request: 30 years."""
_MAX_LISTED = 500
_FIRST_CAPACITY = 1024


class History:
    """Packets of a flight by name and time, as a context manager that closes its files at the end.

    The files have no names, so that no program that tidies the temporary folder removes the packets of a long
    flight, and a console that is killed leaves no files.

    The attribute `clears` is the number of times that all packets were removed.
    """

    def __init__(self) -> None:
        """Make a temporary file for each packet type."""
        self.clears = 0
        self._tracks = {name: _Track(layout) for name, layout in LAYOUTS.items()}

    def __enter__(self) -> Self:
        """Return this history."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the files, which removes them."""
        for track in self._tracks.values():
            track.close()

    def append(self, packets: Mapping[str, PacketArray]) -> None:
        """Append packets to the history in order of arrival.

        Raises OSError if a file cannot be written; the history then contains none of the packets.
        """
        added: list[tuple[_Track, int]] = []
        try:
            for name, rows in packets.items():
                if len(rows):
                    track = self._tracks[name]
                    added.append((track, len(track.times)))
                    track.append(rows)
        except OSError:
            for track, count in added:
                track.shorten(count)
            raise

    def clear(self) -> None:
        """Remove all packets."""
        for track in self._tracks.values():
            track.shorten(0)
        self.clears += 1

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and the newest packet, ns; (0, 0) without packets."""
        times = [track.times for track in self._tracks.values() if len(track.times)]
        first, last = min((t[0] for t in times), default=0), max((t[-1] for t in times), default=0)
        return int(first), int(last)

    def count(self, name: str, until_ns: int) -> int:
        """Return the number of packets with a given name up to a time."""
        return int(np.searchsorted(self._tracks[name].times, until_ns, side="right"))

    def rows(self, name: str, first: int, stop: int) -> PacketArray:
        """Return the packets of a name with indices from `first` to `stop` - 1, in order of arrival."""
        return self._tracks[name].rows(first, stop)

    def series(
        self, name: str, field: str, component: int, span_ns: tuple[int, int], points: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return times (n,), s, and values (n,) of a field, or of one component of it, in a time span.

        A series of more than `points` values is reduced to the minimum and maximum of each interval, in order
        of time, so that no peak is lost. A reduced value is NaN only if all values of its interval are NaN.
        """
        first, stop = (self.count(name, time) for time in (span_ns[0] - 1, span_ns[1]))
        rows = self.rows(name, first, stop)
        values = rows[field].astype(float)
        values = values[:, component] if values.ndim > 1 else values
        times = rows["time_ns"].astype(float) * 1e-9
        if len(times) <= points:
            return times, values
        intervals = max(points // 2, 1)
        begins = np.linspace(0, len(values), intervals, endpoint=False).astype(np.intp)
        sizes = np.diff(np.append(begins, len(values)))
        table = np.full((intervals, int(sizes.max())), np.nan)
        inside = np.arange(table.shape[1]) < sizes[:, None]
        table[inside] = values
        lowest = np.argmin(np.where(np.isnan(table), np.inf, table), axis=1)
        highest = np.argmax(np.where(np.isnan(table), -np.inf, table), axis=1)
        chosen = begins[:, None] + np.sort(np.stack([lowest, highest], axis=1), axis=1)
        return times[chosen].ravel(), values[chosen].ravel()


class _Track:
    """Packets with the same name, whose bytes are in a file and whose times are in memory."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._file = tempfile.TemporaryFile(prefix="knightcube-console-")  # noqa: SIM115 - `close` closes it
        self._kept: npt.NDArray[np.int64] = np.zeros(_FIRST_CAPACITY, dtype=np.int64)
        self._count = 0

    @property
    def times(self) -> npt.NDArray[np.int64]:
        """Times (ns), sorted even for a damaged log, because the search needs increasing times."""
        return self._kept[: self._count]

    def append(self, rows: PacketArray) -> None:
        data, place = rows.tobytes(), self._count * self._layout.length
        while data:
            written = os.pwrite(self._file.fileno(), data, place)
            data, place = data[written:], place + written
        stop = self._count + len(rows)
        if stop > len(self._kept):
            grown = np.zeros(max(stop, 2 * len(self._kept)), dtype=np.int64)
            grown[: self._count] = self.times
            self._kept = grown
        times = rows["time_ns"].astype(np.int64)
        times[0] = max(times[0], self._kept[self._count - 1] if self._count else times[0])
        self._kept[self._count : stop] = np.maximum.accumulate(times)
        self._count = stop

    def shorten(self, count: int) -> None:
        """Remove all packets but the first `count`."""
        self._count = count

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def rows(self, first: int, stop: int) -> PacketArray:
        first, stop = max(first, 0), min(stop, self._count)
        if stop <= first:
            return self._layout.array(b"")
        place, end = first * self._layout.length, stop * self._layout.length
        data = b""
        while part := os.pread(self._file.fileno(), end - place - len(data), place + len(data)):
            data += part
        return self._layout.array(data)


@dataclass(slots=True)
class PageCursor:
    """Time that a browser window shows: the newest time, or the time of a replay.

    Attributes:
        live: whether the newest packet is shown.
        speed: ratio of mission time to real time in a replay, 0 while the replay is paused.
    """

    live: bool = True
    speed: float = 1.0
    _time: float = 0.0
    _since: float = 0.0

    def obey(self, text: str, now: float) -> bool:
        """Process a message {"live": true} or {"at": s, "speed": x} and return whether the shown time jumped.

        `now` is the monotonic time, s. Messages of any other form are ignored.
        """
        try:
            message = json.loads(text)
            if message.get("live"):
                jumped = not self.live
                self.live, self.speed = True, 1.0
                return jumped
            at, speed = float(message["at"]), float(message["speed"])
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            return False
        if not (abs(at) <= MAX_TIME and 0.0 <= speed <= MAX_SPEED):
            return False
        self.live, self.speed, self._time, self._since = False, speed, at, now
        return True

    def at_ns(self, span_ns: tuple[int, int], now: float) -> int:
        """Return the time to show, ns, within the span of the history; a replay stops at its end."""
        if self.live:
            return span_ns[1]
        moved = self._time + self.speed * (now - self._since)
        return min(max(round(moved * 1e9), span_ns[0]), span_ns[1])


EMPTY_STATE: Object = {"newest": {}, "listed": {}, "omitted": {}, "again": False}
"""State without new packets."""


class PageState:
    """State of a flight for one reader, who receives only the changes since the previous state."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._clears = history.clears
        self._shown: dict[str, int] = {}

    def reset(self) -> None:
        """Make the next state complete, so that it does not depend on earlier states."""
        self._shown.clear()

    def at(self, time_ns: int, names: Mapping[str, Any]) -> Object:
        """Return the new packets up to a time: the newest of each name, and lists of the `LISTED` types.

        The value `omitted` is the number of older packets of a type that are not in its list.
        """
        if self._history.clears != self._clears:
            self._clears = self._history.clears
            self.reset()
        newest: Object = {}
        omitted: dict[str, int] = {}
        again = not self._shown
        listed: dict[str, list[Object]] = {}
        for name in names:
            stop = self._history.count(name, time_ns)
            shown = self._shown.get(name, 0)
            if stop == shown:
                continue
            first = max(shown, stop - _MAX_LISTED) if name in LISTED else stop - 1
            rows = [values(row) for row in self._history.rows(name, first, stop)]
            newest[name] = rows[-1] if rows else None
            if name in LISTED:
                listed[name] = rows
                if first > shown:
                    omitted[name] = first - shown
            self._shown[name] = stop
        return {"newest": newest, "listed": listed, "omitted": omitted, "again": again}


def values(row: Any) -> Object:
    """Return the fields of a packet for JSON: printable texts, and null for NaN and infinity."""
    return {name: _plain(row[name].tolist()) for name in row.dtype.names}


def _plain(value: Any) -> Any:
    match value:
        case bytes():
            return printable(to_text(value))
        case list():
            return [_plain(item) for item in value]
        case float() if not math.isfinite(value):
            return None
        case _:
            return value
