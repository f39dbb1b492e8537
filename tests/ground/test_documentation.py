"""Tests that a ground station can decode packets from the telemetry documentation alone."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest

from flight.link.telemetry.definitions import HEALTH, Field, Limits, Packet
from flight.link.telemetry.packets import LAYOUTS, Packer, compile_layouts
from ground import documentation
from tests.flight.link.telemetry.samples import plain_contents

EXAMPLE = Packet(
    "example",
    0x123,
    "1 Hz",
    "An example",
    (
        Field(
            "door", "u1", "-", "of each side", 2, states=((0, "shut"), (7, "ajar")), alarms=((7, "fault"),)
        ),
        Field("flags", "u2", "-", "", bits=((0, "first"), (3, "second"))),
        Field("heat", "f4", "K", "of the cell", limits=Limits((1.0, 2.0), (0.5, 4.0)), valid=(0.0, 9.5)),
        Field("count", "u4", "-", "of packets", wraps=True),
    ),
    version=3,
)


def crc(data: bytes, polynomial: int, preset: int) -> int:
    """Return the 16-bit CRC of some bytes, computed bit by bit."""
    value = preset
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ polynomial if value & 0x8000 else value << 1) & 0xFFFF
    return value


def test_a_packet_is_checked_and_read_by_the_database_alone() -> None:
    found = documentation.database()
    (packet,) = [one for one in found["packets"] if one["name"] == "health"]
    raw = Packer().pack(HEALTH, -5, plain_contents(HEALTH))
    assert len(raw) == packet["bytes"]
    control, size = found["error_control"], found["error_control"]["bytes"]
    assert crc(raw[:-size], control["polynomial"], control["preset"]) == int.from_bytes(raw[-size:], "big")
    version, time = found["secondary_header"]
    assert raw[version["offset"]] == packet["version"]
    assert int.from_bytes(raw[time["offset"] : time["offset"] + 8], "big", signed=True) == -5
    assert found["primary_header_bytes"] == version["offset"] == 6
    assert int.from_bytes(raw[:2], "big") & 0x7FF == packet["apid"]
    assert [one["name"] for one in found["packets"]] == list(LAYOUTS)


def test_the_fields_of_a_packet_have_their_places_and_details() -> None:
    (packet,) = documentation.command_table(compile_layouts([EXAMPLE]))
    plain = {key: value for key, value in packet.items() if key != "fields"}
    assert plain == {
        "name": "example", "apid": 0x123, "version": 3, "rate": "1 Hz", "bytes": 6 + 9 + 2 + 2 + 4 + 4 + 2,
        "meaning": "An example",
    }  # fmt: skip
    assert packet["fields"] == [
        {"name": "door", "type": "u1", "count": 2, "offset": 15, "unit": "-", "meaning": "of each side",
         "states": [[0, "shut"], [7, "ajar"]], "alarms": [[7, "fault"]]},
        {"name": "flags", "type": "u2", "count": 1, "offset": 17, "unit": "-", "meaning": "",
         "bits": [[0, "first"], [3, "second"]]},
        {"name": "heat", "type": "f4", "count": 1, "offset": 19, "unit": "K", "meaning": "of the cell",
         "warning_outside": [1.0, 2.0], "fault_outside": [0.5, 4.0], "valid": [0.0, 9.5]},
        {"name": "count", "type": "u4", "count": 1, "offset": 23, "unit": "-", "meaning": "of packets",
         "wraps_at": 2**32},
    ]  # fmt: skip
    (risky,) = documentation.command_table(compile_layouts([replace(EXAMPLE, hazard="it opens")]))
    assert risky["hazard"] == "it opens"
    names = [one["name"] for one in documentation.command_table()]
    assert "ping" in names


def test_the_meaning_of_a_field_in_words() -> None:
    door, flags, heat, count = EXAMPLE.fields
    assert documentation.meaning_of(door) == "of each side; 0 shut, 7 ajar (fault)"
    assert documentation.meaning_of(flags) == "bits: 0 first, 3 second"
    meaning = documentation.meaning_of(heat)
    assert meaning == "of the cell; valid 0 to 9.5; warning outside 1 to 2; fault outside 0.5 to 4"
    assert documentation.meaning_of(count) == "of packets; wraps at 2^32"


def test_the_page_has_a_table_of_each_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documentation, "LAYOUTS", compile_layouts([EXAMPLE]))
    page = documentation.markdown()
    assert page.startswith("# Telemetry\n")
    assert page.endswith(
        "\n## example\n\nAn example. APID 0x123, version 3, 29 bytes, 1 Hz.\n\n"
        "| byte | field | type | unit | meaning |\n|---|---|---|---|---|\n"
        "| 15 | door | u1 x 2 | - | of each side; 0 shut, 7 ajar (fault) |\n"
        "| 17 | flags | u2 | - | bits: 0 first, 3 second |\n"
        "| 19 | heat | f4 | K | of the cell; valid 0 to 9.5; warning outside 1 to 2; "
        "fault outside 0.5 to 4 |\n"
        "| 23 | count | u4 | - | of packets; wraps at 2^32 |\n"
    )


def test_the_command_prints_the_page_or_the_database(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["documentation", "--json"])
    documentation.main()
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(documentation.database()))
    monkeypatch.setattr(sys, "argv", ["documentation"])
    documentation.main()
    assert capsys.readouterr().out == documentation.markdown()
