"""The state of a flight at an instant, as plain values for the page: the same for live and replay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from flight.link.telemetry.packets import to_text
from ground.console.history import History
from ground.watch.view import printable

Object = dict[str, Any]
LISTED = ("event", "command", "verification", "streak", "stars", "sightings")
"""Packets of which the page lists each; of the others it shows the newest."""
_MOST_LISTED = 500


class Instant:
    """Follows one reader of the page: remembers what the page has, and returns what is new to it."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._shown: dict[str, int] = {}

    def forget(self) -> None:
        """Begin again: the page jumped to another time, and needs everything."""
        self._shown.clear()

    def at(self, time_ns: int, names: Mapping[str, Any]) -> Object:
        """Return what came until a time and was not shown: newest packets, and lists of the `LISTED`."""
        newest: Object = {}
        again = not self._shown
        listed: dict[str, list[Object]] = {}
        for name in names:
            stop = self._history.count(name, time_ns)
            shown = self._shown.get(name, 0)
            if stop == shown:
                continue
            first = max(shown, stop - _MOST_LISTED) if name in LISTED else stop - 1
            rows = [values(row) for row in self._history.rows(name, first, stop)]
            newest[name] = rows[-1] if rows else None
            if name in LISTED:
                listed[name] = rows
            self._shown[name] = stop
        return {"newest": newest, "listed": listed, "again": again}


def values(row: Any) -> Object:
    """Return the fields of a packet as JSON has them: texts printable, numbers that are none as null."""
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
