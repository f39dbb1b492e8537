"""A flight in plain lines: one per period of mission time, and one for each event."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flight.link.telemetry.definitions import SEVERITIES, STEERING
from flight.link.telemetry.packets import PacketArray
from ground.watch.view import Event, View, named

_LATEST = 1e15  # s: beyond it a time is damage, not a moment of a flight


class PlainLines:
    """Writes lines as packets come."""

    def __init__(self, view: View, every: float, write: Callable[[str], object]) -> None:
        """Keep `view` up to date, and write the state about every `every` s of mission time."""
        self._view = view
        self._every = every
        self._write = write
        self._written = -1

    def feed(self, packets: Mapping[str, PacketArray]) -> None:
        """Take packets in, oldest first, and write what they give."""
        slots = {name: _slots(rows, self._every) for name, rows in packets.items()}
        for slot in sorted(set().union(*(found.tolist() for found in slots.values()))):
            inside = {name: rows[slots[name] == slot] for name, rows in packets.items()}
            for event in self._view.update(inside):
                self._write(event_line(event) + "\n")
            if slot > self._written:
                self._written = slot
                self._write(state_line(self._view) + "\n")


def _slots(rows: PacketArray, every: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    time = np.clip(rows["time_ns"] * 1e-9, -_LATEST, _LATEST)
    return np.asarray(np.floor(time / every), dtype=np.int64)


def event_line(event: Event) -> str:
    """Return an event in a line."""
    return f"{event.time:9.3f} s  {named(SEVERITIES, event.severity):8} {event.name}: {event.text}"


def state_line(view: View) -> str:
    """Return how a flight stands, in a line."""
    parts = [f"{view.time:9.3f} s ", f"{view.mode or 'mode not known'}", attitude_text(view)]
    parts += [currents_text(view)]
    if (state := view.value("control", "state")) is not None:
        parts.append(f"coils {named(STEERING, state)}")
    if (slips := view.value("health", "slips")) is not None:
        parts.append(f"slips {int(slips)}")
    if view.faults:
        parts.append(f"faults {view.faults}")
    return "  ".join(part for part in parts if part)


def attitude_text(view: View) -> str:
    """Return the attitude and the rate; empty without an estimate."""
    rate = view.value("attitude", "rate")
    parts = []
    if (q2 := view.value("control", "q2")) is not None and np.isfinite(q2):
        parts.append(f"q2 {q2:+.4f} -> {view.value('control', 'target_q2'):+.2f}")
    if (error := view.error_deg) is not None:
        parts.append(f"{error:.2f} deg off")
    if rate is not None and np.all(np.isfinite(rate)):
        parts.append(f"{1e3 * float(np.linalg.norm(rate)):.2f} mrad/s")
    return "  ".join(parts)


def currents_text(view: View) -> str:
    """Return the coils' currents, where they are known, else the dipole that is wanted."""
    written, dipole = view.value("control", "current_written"), view.value("attitude", "dipole")
    if written is not None:
        return "coils " + " ".join(f"{1e3 * current:+.1f}" for current in written) + " mA"
    if dipole is not None:
        return "dipole " + " ".join(f"{1e3 * part:+.2f}" for part in dipole) + " mA m^2"
    return ""
