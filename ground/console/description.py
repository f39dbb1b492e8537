"""Descriptions of commands, fields and events for the console's page that complete the packet tables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal

from flight.link.commands import DUMP_PARAMETERS, LOAD_PARAMETERS, POINT, SLEW
from flight.link.events import EVENTS
from flight.link.modes import ORBITAL, TESTBED, Mode
from flight.link.process.directives import SCHEDULE
from flight.link.telemetry.fields import Field, Packet
from flight.link.telemetry.packets import LAYOUTS, Layout
from flight.loop.facts import FACTS
from ground.documentation import command_table
from hal.interfaces.devices import COIL_NAMES
from knightcube.gnc.guidance.pointing_target import ARGUMENTS, NUMBERS, ROLLS, Goal

Object = dict[str, Any]
Body = Literal["testbed", "orbit"]
"""Kind of the controlled body: a body on a thread (testbed), or a satellite in orbit."""
_FOREIGN = {"testbed": (POINT.name, ORBITAL), "orbit": (SLEW.name, TESTBED)}
"""Command and modes that each kind of body refuses."""
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
"""Limits of telemetry fields: parameter that holds the limit, side (above or below), and severity."""
_OWN_FORM = frozenset({LOAD_PARAMETERS.name, DUMP_PARAMETERS.name})


def layouts_for(body: Body | None, layouts: Mapping[str, Layout]) -> dict[str, Layout]:
    """Return the commands that a kind of body accepts; all commands if the kind of body is not known."""
    foreign = _FOREIGN[body][0] if body is not None else ""
    return {name: layout for name, layout in layouts.items() if name != foreign}


def foreign_modes(body: Body | None) -> frozenset[Mode]:
    """Return the modes that a kind of body does not have; the set is empty if the body is not known."""
    return _FOREIGN[body][1] if body is not None else frozenset()


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
    """Return the description of the form input for one field of a command."""
    one: Object = {
        "name": field.name.replace("_", " "),
        "field": field.name,
        "type": field.kind,
        "unit": field.unit,
        "meaning": field.meaning,
        "states": [list(state) for state in field.states],
        "valid": list(field.valid or _range_of(field.kind)),
    }
    if field.kind.startswith("S"):
        one |= {"length": int(field.kind[1:]) - 1, "optional": field.name in {"reason", "under"}}
    if field.count > 1 and field.kind == "u1":
        one["hex"] = field.count
    if field.name == "event":
        one["suggestions"] = sorted(kind.name for kind in EVENTS)
    if field.name == SCHEDULE.fields[0].name:
        one["hint"] = "2026-11-23T21:00:00"
    return one


def _range_of(kind: str) -> tuple[int, int] | tuple[()]:
    """Return the range of an integer type, or an empty range for another type."""
    return (0, 2 ** (8 * int(kind[1:])) - 1) if kind.startswith("u") else ()


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
    """Extend each field of the packet table by its components' names and by the parameters of its limits."""
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
