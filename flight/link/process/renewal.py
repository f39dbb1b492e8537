"""Requests to update release or configuration in orbit (docs/fly/renewal.md), and reports of the execution.

The privileged program `deploy/renewal.py` reads the requests and the record `contact` in the folder of this
module, and writes the status file that this module reads.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from flight.link.events import CONFIG_DAMAGED, Severity
from flight.link.modes import Mode
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import KINDS, PARTS, Activate, Privileged, Restart
from flight.link.regular_files import line_of, overwrite, read_regular, to_record
from flight.link.telemetry.definitions import EVENT, FIX, MODE
from flight.link.telemetry.packets import LAYOUTS, to_text
from hal.interfaces.wires import SECOND_NS

STATUS = Path("/var/lib/knightcube-renewal/status")
CONTACT_NS = 10 * SECOND_NS
"""Minimum time (ns) between two records of the contact with the ground."""
_LARGEST = 1 << 16
_REACTION = "reaction safe"  # trigger in the mode packet after an event (flight.loop.modes)
_MODE_LAYOUT, _EVENT_LAYOUT, _FIX_LAYOUT = (LAYOUTS[packet.name] for packet in (MODE, EVENT, FIX))
_STAGES = {"started": Stage.STARTED, "completed": Stage.COMPLETED, "failed": Stage.FAILED}
_DAMAGED = (ValueError, TypeError, AttributeError, LookupError, RecursionError)


def encoded(values: object) -> bytes:
    """Return values as a line of JSON with a checksum."""
    return to_record(json.dumps(values, sort_keys=True).encode())


def decoded(data: bytes) -> Any:
    """Return the values in a line of JSON with a checksum. Raises ValueError if the line is damaged."""
    return json.loads(line_of(data) or b"")


class Renewal:
    """Interface to the privileged program `deploy/renewal.py`, with which it exchanges files."""

    def __init__(self, folder: Path, status: Path, command_loss: float) -> None:
        """Use `folder` for requests and records, and read the reports in the file `status`.

        The time `command_loss` (s) without an authentic frame is passed on to this program.
        """
        self._folder = folder
        self._status = status
        self._limit = command_loss
        self._session = os.urandom(8).hex()
        self._fault = ""
        self._utc_offset_ns: int | None = None  # receiver's UTC minus the time of the host's clock
        self._recorded = ("", "")
        self._due_ns = 0
        self._modified_ns = 0
        self._reported = self._stored_number()

    def request(self, directive: Privileged, done: Report, now_ns: int) -> str:
        """Store a request for the privileged part. Return the reason for a failure, or an empty text.

        The request to activate an artefact contains the UTC (s) from the GPS receiver, if a fix was used
        since the start of the link. The host's clock may be wrong, so expiry dates are not compared with it.
        """
        if not self._status.exists():
            return "the renewal service is not installed on this board: run deploy/install.sh"
        name = f"{done.spi}-{done.counter}-{done.request.packet}-{done.request.sequence}"
        values: dict[str, Any] = {"do": type(directive).__name__.lower()}
        if isinstance(directive, Activate):
            kind, _, own = directive.name.removeprefix("received/").partition("/")
            values |= {"kind": kind, "name": own, "sum": directive.sum.hex(), "hours": directive.hours}
            values["despite_faults"] = bool(directive.despite_faults)
            if self._utc_offset_ns is not None:
                values["utc"] = (now_ns + self._utc_offset_ns) // SECOND_NS
        elif isinstance(directive, Restart):
            values["part"] = PARTS[directive.part]
        else:
            values["kind"] = KINDS[directive.kind]
        return "" if self._write(name, encoded(values)) else "the request could not be stored"

    def followed(self, packet: bytes, now_ns: int, *, live: bool) -> None:
        """Note a fault, a refused configuration, or a reaction to SAFE that a telemetry packet reports.

        The time of a used GPS fix is also noted if the packet was just written (`live` is true).
        """
        if packet[:2] == _MODE_LAYOUT.identifier.to_bytes(2, "big"):
            (row,) = _MODE_LAYOUT.array(packet)
            if row["mode"] == Mode.SAFE and to_text(row["trigger"]) == _REACTION:
                self._fault = to_text(row["reason"])[:64] or _REACTION
        elif packet[:2] == _EVENT_LAYOUT.identifier.to_bytes(2, "big"):
            (row,) = _EVENT_LAYOUT.array(packet)
            # A flight that refuses the new configuration uses its last valid configuration.
            fails = row["severity"] == Severity.FAULT or row["code"] == CONFIG_DAMAGED.code
            if fails and not self._fault:
                self._fault = f"{to_text(row['name'])}: {to_text(row['text'])}"[:64]
        elif live and packet[:2] == _FIX_LAYOUT.identifier.to_bytes(2, "big"):
            (row,) = _FIX_LAYOUT.array(packet)
            if row["used"]:
                self._utc_offset_ns = int(row["utc_ns"]) - now_ns

    def turn(self, admitted: int, now_ns: int) -> list[Report]:
        """Record the contact with the ground, and return new reports of the privileged part.

        Args:
            admitted: number of authentic frames since the start of the link.
            now_ns: current time of the monotonic clock, ns.
        """
        contact = (str(admitted), self._fault)
        if contact != self._recorded and now_ns >= self._due_ns and self._status.parent.exists():
            self._due_ns = now_ns + CONTACT_NS
            values = {"session": self._session, "frames": contact[0], "fault": contact[1]}
            if self._write("contact", encoded(values | {"limit_s": self._limit})):
                self._recorded = contact
        with suppress(OSError, *_DAMAGED):
            modified_ns = self._status.stat().st_mtime_ns
            if modified_ns != self._modified_ns:
                self._modified_ns = modified_ns
                return self._reports(decoded(read_regular(self._status, _LARGEST) or b"")["reports"])
        return []

    def _reports(self, entries: list[list[Any]]) -> list[Report]:
        """Return the reports that were not sent before, and store the number of the newest report."""
        found = []
        for number, request, result, name, text in entries:
            if number > self._reported:
                spi, counter, packet, sequence = map(int, request.split("-")) if request else (0, 0, 0, 0)
                stage = _STAGES[result]
                found.append(Report(spi, counter, stage, name, text, Request(packet, sequence)))
        newest = max((int(entry[0]) for entry in entries), default=0)
        if newest != self._reported:
            self._reported = newest
            self._write("reported", encoded(newest))
        return found

    def _stored_number(self) -> int:
        with suppress(OSError, *_DAMAGED):
            return int(decoded(read_regular(self._folder / "reported", _LARGEST) or b""))
        return 0

    def _write(self, name: str, data: bytes) -> bool:
        with suppress(OSError):
            self._folder.mkdir(mode=0o700, exist_ok=True)
        return overwrite(self._folder / name, data)
