"""How a flight stands by the newest of its packets."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import MODES, States
from flight.link.telemetry.packets import PacketArray, to_text
from knightcube.astro.quaternion import angle_between

STREAMS = ("imu", "field", "coils", "power", "camera")
KEPT_EVENTS = 200


@dataclass(frozen=True, slots=True)
class Event:
    """An event of the log; mission time in s."""

    time: float
    severity: int
    name: str
    text: str


@dataclass(slots=True)
class View:
    """The newest packet of each kind, and the newest events.

    Attributes:
        time: mission time of the newest packet, s.
        mode: label of the mode, empty until one is known.
        ended: the reason that the loop gave for its end, empty before.
        events: of all, the newest `KEPT_EVENTS`.
        faults: how many events of severity fault came.
    """

    time: float = 0.0
    mode: str = ""
    ended: str = ""
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=KEPT_EVENTS))
    faults: int = 0
    newest: dict[str, Any] = field(default_factory=dict)

    def update(self, packets: Mapping[str, PacketArray]) -> list[Event]:
        """Take packets in; return the events among them."""
        came = [event_of(row) for row in packets["event"]]
        for name, rows in packets.items():
            if len(rows):
                self.newest[name] = rows[-1]
                self.time = max(self.time, float(rows["time_ns"][-1]) * 1e-9)
        modes = [(int(rows[-1]["time_ns"]), int(rows[-1]["mode"])) for rows in _with_mode(packets)]
        if modes:
            self.mode = named(MODES, max(modes)[1])
        self.events.extend(came)
        self.faults += sum(event.severity >= events.Severity.FAULT for event in came)
        ends = [event.text or event.name for event in came if event.name == events.STOPPED.name]
        self.ended = printable(ends[-1]) if ends else self.ended
        return came

    def value(self, packet: str, name: str) -> Any:
        """Return a field of the newest packet of a kind, None before one came."""
        row = self.newest.get(packet)
        return None if row is None else row[name]

    @property
    def error_deg(self) -> float | None:
        """The angle between the estimated attitude and the target, None where either is unknown."""
        row = self.newest.get("attitude")
        if row is None or not (np.all(np.isfinite(row["quaternion"])) and np.all(np.isfinite(row["target"]))):
            return None
        pair = [np.asarray(row[name], dtype=float) for name in ("quaternion", "target")]
        if not all(0.5 < np.linalg.norm(one) < 2.0 for one in pair):
            return None
        return math.degrees(float(angle_between(*pair)))


def _with_mode(packets: Mapping[str, PacketArray]) -> list[PacketArray]:
    return [packets[name] for name in ("mode", "attitude", "health", "command") if len(packets[name])]


def event_of(row: Any) -> Event:
    """Return the event of a packet."""
    name, text = printable(to_text(row["name"])), printable(to_text(row["text"]))
    return Event(float(row["time_ns"]) * 1e-9, int(row["severity"]), name, text)


def named(states: States, number: Any) -> str:
    """Return the name of a number in a packet, or the number where it has none."""
    return dict(states).get(int(number), str(int(number)))


def printable(text: str) -> str:
    """Return a text for a terminal: a damaged log must not steer it."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
