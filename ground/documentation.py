"""Packet definition tables as Markdown for people and as JSON for ground stations.

`python -m ground.documentation [--telecommands | --events | --json]`
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping
from typing import Any, Literal

from flight.link.commands import DUMP_PARAMETERS, LOAD_PARAMETERS, POINT, SLEW
from flight.link.commands import LAYOUTS as COMMAND_LAYOUTS
from flight.link.events import EVENTS, FOREIGN_MODES, Mode, Reaction, Severity
from flight.link.process.directives import LAYOUTS as DIRECTIVE_LAYOUTS
from flight.link.process.directives import SCHEDULE
from flight.link.telemetry.definitions import Field, Packet
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, Layout, wraps_at
from flight.loop.facts import FACTS
from hal.interfaces.devices import COIL_NAMES
from knightcube.gnc.guidance.pointing_target import ARGUMENTS, NUMBERS, ROLLS, Goal

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
| 4 | u2 | bytes that follow this word, minus one |
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
| 4 | u2 | bytes that follow this word, minus one |
| 6 | u1 | version of the packet's definition |
| 7 | i8 | time of the command by the sender's clock, ns since 1970 UTC |
| 15 | | the fields below |
| last 2 | u2 | CRC-16: x^16 + x^12 + x^5 + 1, preset to ones, over everything before it |
"""
_FOREWORD_OF_EVENTS = """\
# Events and alarms

This page is made from `flight/link/events.py` and `flight/loop/facts.py`.
The command is `python -m ground.documentation --events > docs/events.md`.

An event has a name, a severity, and a text with values, which `knightcube watch` shows.
The text names the device and the reason; search for the name of the event on this page.
Of each kind of event, at most one is written in 5 s, with the number of those that were held back.
The last event held back is written up to 5 s after its time, so that it follows later events of other kinds.
`report`, `export` and `watch` sort the events of a log by their times.
An alarm is a monitored condition that is active now; the last table names the event that each alarm reports.
In a remedy, `clear`, `mode` and `safe` are [commands](fly/commands.md) to the flight.
The words `bringup`, `identify` and `calibrate` are [commands of the ground](fly/command-line.md).
The remedy "none" means that the flight deals with the cause by itself.
"""
_REACTIONS = {
    Reaction.NOTE: "",
    Reaction.COILS_OFF: "coils at zero",
    Reaction.ISOLATE: "isolates the coil",
    Reaction.HOLD: "mode HOLD",
    Reaction.DETUMBLE: "mode DETUMBLE",
    Reaction.SAFE: "mode SAFE",
    Reaction.RESTART: "restarts",
    Reaction.RETURN: "leaves SAFE",
}


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


def markdown_of_events() -> str:
    """Return the table of all events and the table of all alarms as Markdown."""
    lines = [_FOREWORD_OF_EVENTS]
    for severity, title in ((Severity.FAULT, "Faults"), (Severity.WARNING, "Warnings")):
        lines += [
            f"## {title}",
            "",
            "| event | meaning | reaction of the flight | remedy |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| `{kind.name}` | {kind.meaning} | {_REACTIONS[kind.reaction]} | {kind.remedy} |"
            for kind in sorted(EVENTS, key=lambda kind: kind.name)
            if kind.severity is severity
        ]
        lines.append("")
    lines += ["## Information", "", "| event | meaning |", "|---|---|"]
    lines += [
        f"| `{kind.name}` | {kind.meaning} |"
        for kind in sorted(EVENTS, key=lambda kind: kind.name)
        if kind.severity is Severity.INFORMATION
    ]
    lines += ["", "## Alarms", "", "| alarm | event | ends |", "|---|---|---|"]
    for fact in sorted(FACTS, key=lambda fact: fact.name):
        ends = "by itself" if fact.ends is None else f"with `{fact.ends.name}`"
        ends = f"by the command `clear {fact.begins.name}`" if fact.latching else ends
        lines.append(f"| `{fact.name}` | `{fact.begins.name}` | {ends} |")
    return "\n".join(lines) + "\n"


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
                "offset": layout.offsets[field.name],
                "unit": field.unit,
                "meaning": field.meaning,
                **_details(field),
            }
            for field in packet.fields
        ],
    }


def _details(field: Field) -> dict[str, Any]:
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
    parts += [f"{word} {bounds[0]:g} to {bounds[1]:g}" for word, bounds in ranges.items() if bounds]
    if field.wraps:
        parts.append(f"wraps at 2^{8 * int(field.kind[1:])}")
    return "; ".join(parts)


def _section(layout: Layout) -> str:
    packet = layout.packet
    identity = [f"APID 0x{packet.apid:03X}", f"version {packet.version}", f"{layout.length} bytes"]
    identity += [] if packet.telecommand else [packet.rate]
    hazard = f" Hazard: {packet.hazard}." if packet.hazard else ""
    lines = ["", f"## {packet.name}", "", f"{packet.meaning}. {', '.join(identity)}.{hazard}"]
    if packet.fields:
        lines += ["", "| byte | field | type | unit | meaning |", "|---|---|---|---|---|"]
    for field in packet.fields:
        kind = f"{field.kind} x {field.count}" if field.count > 1 else field.kind
        meaning = meaning_of(field).replace("|", r"\|")
        lines.append(f"| {layout.offsets[field.name]} | {field.name} | {kind} | {field.unit} | {meaning} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the documentation."""
    parser = argparse.ArgumentParser(prog="python -m ground.documentation", description=__doc__)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--json", action="store_true", help="print the telemetry database (JSON) instead of Markdown pages"
    )
    kinds.add_argument("--telecommands", action="store_true", help="print the telecommands")
    kinds.add_argument("--events", action="store_true", help="print the events with meanings and remedies")
    arguments = parser.parse_args()
    if arguments.json:
        sys.stdout.write(json.dumps(database(), indent=2) + "\n")
    elif arguments.events:
        sys.stdout.write(markdown_of_events())
    else:
        sys.stdout.write(markdown_of_telecommands() if arguments.telecommands else markdown())


Object = dict[str, Any]
Body = Literal["testbed", "orbit"]
"""Kind of the controlled body: a body on a thread (testbed), or a satellite in orbit."""
_FOREIGN = {"testbed": POINT.name, "orbit": SLEW.name}
"""For each kind of body, a command that it refuses."""
_TENSOR = re.compile(r"(?:[xyz]{2} ){5}[xyz]{2}")
"""Pattern of the component names of a symmetric matrix in the description of a field."""
_COMPONENTS = {3: list("xyz"), 4: list("xyzw"), 9: [a + b for a in "xyz" for b in "xyz"]}
"""Names of the components of an array by its length."""
_LIMITED_BY: Mapping[str, tuple[tuple[str, str, str], ...]] = {
    "health.cpu_share": (("health_cpu_share", "above", "warning"),),
    "health.proportional": (("health_memory", "above", "fault"),),
    "health.disk_free": (("health_disk_free", "below", "warning"),),
    "health.temperature": (("health_temperature", "above", "warning"), ("health_hottest", "above", "fault")),
}
"""Limits of telemetry fields: parameter that contains the limit, side (above or below), and severity."""
_OWN_FORM = frozenset({LOAD_PARAMETERS.name, DUMP_PARAMETERS.name})


def layouts_for(body: Body | None, layouts: Mapping[str, Layout]) -> dict[str, Layout]:
    """Return the commands that a kind of body accepts; all commands if the kind of body is not known."""
    foreign = _FOREIGN[body] if body is not None else ""
    return {name: layout for name, layout in layouts.items() if name != foreign}


def foreign_modes(body: Body | None) -> frozenset[Mode]:
    """Return the modes that a kind of body does not have; the set is empty if the body is not known."""
    return FOREIGN_MODES[body] if body is not None else frozenset()


def commands_for(body: Body | None, layouts: Mapping[str, Layout]) -> list[Object]:
    """Return the commands that a kind of body accepts, each with the inputs of its web form."""
    chosen = layouts_for(body, layouts)
    table = {entry["name"]: entry for entry in command_table(chosen)}
    for name, layout in chosen.items():
        table[name]["inputs"] = _inputs(layout.packet, body)
        table[name]["own_form"] = name in _OWN_FORM
    return list(table.values())


def _inputs(packet: Packet, body: Body | None) -> list[Object]:
    """Return the inputs of a command's form: name, field, unit, range, and when the input is shown."""
    foreign = foreign_modes(body)
    found: list[Object] = []
    for field in packet.fields:
        if packet is POINT and field.name == "numbers":
            found += _target_inputs(field.name)
            continue
        one = _input(field)
        if field.name == "mode":
            one["states"] = [list(state) for state in field.states if state[0] not in foreign]
        if packet is POINT and field.name == "roll":
            one |= {"optional": True, "hint": "free"}
            one["only"] = ["goal", [int(goal) for goal in Goal if goal not in ROLLS]]
        found.append(one)
    return found


def _target_inputs(field: str) -> list[Object]:
    """Return the inputs of a web form for the numbers of each pointing goal, such as latitude."""
    return [
        {
            "name": name,
            "field": field,
            "index": index,
            "type": "f8",
            "unit": unit,
            "valid": [low, high],
            "optional": 0 in NUMBERS[goal],
            "hint": "field of view" if 0 in NUMBERS[goal] else "",
            "only": ["goal", [int(goal)]],
            "meaning": f"{name} of the goal {goal.label}",
        }
        for goal, numbers in ARGUMENTS.items()
        for index, (name, unit, low, high) in enumerate(numbers)
    ]


def _input(field: Field) -> Object:
    one: Object = {
        "name": field.name.replace("_", " "),
        "field": field.name,
        "type": field.kind,
        "unit": field.unit,
        "meaning": field.meaning,
        "states": [list(state) for state in field.states],
        "valid": list(field.valid or ()),
    }
    if field.kind.startswith("u") and not field.valid:
        one["valid"] = [0, 2 ** (8 * int(field.kind[1:])) - 1]
    if field.kind.startswith("S"):
        one |= {"length": int(field.kind[1:]) - 1, "optional": field.name in {"reason", "under"}}
    if field.count > 1 and field.kind == "u1":
        one["hex"] = field.count
    if field.name == "event":
        one["suggestions"] = sorted(kind.name for kind in EVENTS)
    if field.name == SCHEDULE.fields[0].name:
        one["hint"] = "2026-11-23T21:00:00"
    return one


def components(packet: str, field: Field) -> list[str]:
    """Return the names of the components of an array, or an empty list for a single value."""
    if field.count == 1:
        return []
    if "coil_currents" in packet:
        return list(COIL_NAMES)
    stated = _TENSOR.search(field.meaning)
    names = stated[0].split() if stated else _COMPONENTS.get(field.count)
    return list(names) if names else [str(k) for k in range(1, field.count + 1)]


def add_components(packets: list[Object]) -> list[Object]:
    """Add to each field of the packet table the names of its components and the parameters that limit it."""
    for packet in packets:
        fields = LAYOUTS[packet["name"]].packet.fields
        for entry, field in zip(packet["fields"], fields, strict=True):
            entry["components"] = components(packet["name"], field)
            if limited := _LIMITED_BY.get(f"{packet['name']}.{field.name}"):
                entry["limited_by"] = [list(one) for one in limited]
    return packets


def endings() -> dict[str, list[str]]:
    """Return, for each event that ends a condition, the events that begin this condition."""
    found: dict[str, list[str]] = {}
    for fact in FACTS:
        if fact.ends is not None and fact.begins.name not in found.setdefault(fact.ends.name, []):
            found[fact.ends.name].append(fact.begins.name)
    return found


if __name__ == "__main__":
    main()
