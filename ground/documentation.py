"""Packet definition tables as Markdown for people and as JSON for ground stations.

`python -m ground.documentation [--telecommands | --json]`
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from typing import Any

from flight.link.commands import LAYOUTS as COMMAND_LAYOUTS
from flight.link.process.directives import LAYOUTS as DIRECTIVE_LAYOUTS
from flight.link.telemetry.fields import Field, Range
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, Layout, wraps_at

_FOREWORD = """\
# Telemetry

This page is made from `flight/link/telemetry/definitions.py`.
The command is `python -m ground.documentation > docs/telemetry.md`.
`--json` prints the same content as a database for ground stations.
A flight log is a sequence of these packets, and a downlink is a stream of them.

Every packet is a CCSDS space packet (133.0-B-2) with big-endian numbers:

| byte | type | content |
|---|---|---|
| 0 | u2 | version 0 (3 bits), type 0 = telemetry (1), secondary header 1 (1), APID (11) |
| 2 | u2 | 3 = unsegmented (2 bits), sequence count of this APID (14) |
| 4 | u2 | bytes that follow this word, less one |
| 6 | u1 | version of the packet's definition |
| 7 | i8 | mission time, ns |
| 15 | | the fields below |
| last 2 | u2 | CRC-16: x^16 + x^12 + x^5 + 1, preset to ones, over everything before it |
"""
_TYPES = """
A type is u (unsigned integer), i (signed integer) or f (IEEE 754), with its size in bytes.
The type S with a size in bytes is UTF-8 text, padded with zeros; its last byte is always zero.
"""
_FOREWORD_OF_TELECOMMANDS = """\
# Telecommands

This page is made from `flight/link/commands.py` and `flight/link/process/directives.py`.
The command is `python -m ground.documentation --telecommands > docs/telecommands.md`.
The page [commands and telemetry](fly/commands.md) explains the commands to the flight.
The page [the link](fly/link.md) explains the commands to the link, and the frames of both kinds of commands.

Every telecommand is a CCSDS space packet (133.0-B-2) with big-endian numbers:

| byte | type | content |
|---|---|---|
| 0 | u2 | version 0 (3 bits), type 1 = telecommand (1), secondary header 1 (1), APID (11) |
| 2 | u2 | 3 = unsegmented (2 bits), sequence count, chosen by the sender and repeated in the report (14) |
| 4 | u2 | bytes that follow this word, less one |
| 6 | u1 | version of the packet's definition |
| 7 | i8 | time of the command by the sender's clock, ns since 1970 UTC |
| 15 | | the fields below |
| last 2 | u2 | CRC-16: x^16 + x^12 + x^5 + 1, preset to ones, over everything before it |
"""


def database() -> dict[str, Any]:
    """Return the packet definitions as JSON data, with every field's offset from the packet's first byte."""
    return {
        "byte_order": "big-endian",
        "primary_header_bytes": HEADER_BYTES,
        "secondary_header": [
            {"name": "version", "type": "u1", "offset": HEADER_BYTES},
            {"name": "time_ns", "type": "i8", "offset": HEADER_BYTES + 1},
        ],
        "error_control": {"polynomial": 0x1021, "preset": 0xFFFF, "bytes": CRC_BYTES},
        "packets": [_packet(layout) for layout in LAYOUTS.values()],
    }


def command_table(layouts: Mapping[str, Layout] = COMMAND_LAYOUTS) -> list[dict[str, Any]]:
    """Return the telecommands and their fields as JSON data."""
    return [_packet(layout) for layout in layouts.values()]


def markdown() -> str:
    """Return the table of telemetry packets as Markdown."""
    return _FOREWORD + _TYPES + "".join(_section(layout) for layout in LAYOUTS.values())


def markdown_of_telecommands() -> str:
    """Return the table of the telecommands to the flight process and to the link process, as Markdown."""
    sections = (_section(layout) for layout in (*COMMAND_LAYOUTS.values(), *DIRECTIVE_LAYOUTS.values()))
    return _FOREWORD_OF_TELECOMMANDS + _TYPES + "".join(sections)


def _packet(layout: Layout) -> dict[str, Any]:
    packet = layout.packet
    return {
        "name": packet.name,
        "apid": packet.apid,
        "version": packet.version,
        "rate": packet.rate,
        "bytes": layout.length,
        "meaning": packet.meaning,
        **({"hazard": packet.hazard} if packet.hazard else {}),
        "fields": [
            {
                "name": field.name,
                "type": field.kind,
                "count": field.count,
                "offset": offset,
                "unit": field.unit,
                "meaning": field.meaning,
                **_details(field),
            }
            for field, offset in _offsets(layout)
        ],
    }


def _details(field: Field) -> dict[str, Any]:
    """Return the optional properties of a field: states, bits, limits, and the largest value of a counter."""
    limits = field.limits
    details: dict[str, Any] = {
        "states": [list(state) for state in field.states],
        "bits": [list(bit) for bit in field.bits],
        "alarms": [list(alarm) for alarm in field.alarms],
        "warning_outside": list(limits.warning or ()) if limits else None,
        "fault_outside": list(limits.fault or ()) if limits else None,
        "valid": list(field.valid or ()),
        "wraps_at": wraps_at(field),
    }
    return {name: value for name, value in details.items() if value}


def meaning_of(field: Field) -> str:
    """Return a text about a field: its meaning, states or bits, ranges, and the limit of a counter."""
    parts = [field.meaning] if field.meaning else []
    levels = {number: f" ({level})" for number, level in field.alarms}
    for word, labels in (("", field.states), ("bits: ", field.bits)):
        named = ", ".join(f"{number} {label}{levels.get(number, '')}" for number, label in labels)
        parts += [word + named] if named else []
    ranges = {"valid": field.valid}
    if field.limits is not None:
        ranges |= {"warning outside": field.limits.warning, "fault outside": field.limits.fault}
    parts += [f"{word} {low:g} to {high:g}" for word, (low, high) in _given(ranges)]
    if field.wraps:
        parts.append(f"wraps at 2^{8 * int(field.kind[1:])}")
    return "; ".join(parts)


def _given(ranges: dict[str, Range | None]) -> list[tuple[str, Range]]:
    return [(word, bounds) for word, bounds in ranges.items() if bounds is not None]


def _offsets(layout: Layout) -> list[tuple[Field, int]]:
    where = layout.offsets
    return [(field, where[field.name]) for field in layout.packet.fields]


def _section(layout: Layout) -> str:
    packet = layout.packet
    identity = [f"APID 0x{packet.apid:03X}", f"version {packet.version}", f"{layout.length} bytes"]
    identity += [] if packet.telecommand else [packet.rate]
    hazard = f" Hazard: {packet.hazard}." if packet.hazard else ""
    lines = ["", f"## {packet.name}", "", f"{packet.meaning}. {', '.join(identity)}.{hazard}"]
    if packet.fields:
        lines += ["", "| byte | field | type | unit | meaning |", "|---|---|---|---|---|"]
    for field, offset in _offsets(layout):
        kind = f"{field.kind} x {field.count}" if field.count > 1 else field.kind
        meaning = meaning_of(field).replace("|", r"\|")
        lines.append(f"| {offset} | {field.name} | {kind} | {field.unit} | {meaning} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the documentation."""
    parser = argparse.ArgumentParser(prog="python -m ground.documentation", description=__doc__)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--json", action="store_true", help="print the telemetry database (JSON) instead of Markdown pages"
    )
    kinds.add_argument("--telecommands", action="store_true", help="print the telecommands")
    arguments = parser.parse_args()
    if arguments.json:
        sys.stdout.write(json.dumps(database(), indent=2) + "\n")
    else:
        sys.stdout.write(markdown_of_telecommands() if arguments.telecommands else markdown())


if __name__ == "__main__":
    main()
