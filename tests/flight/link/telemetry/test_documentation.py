"""Tests that the telemetry page agrees with the packet tables, and is sufficient to decode a packet."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest

from flight.link.events import EVENTS, Severity
from flight.link.telemetry.definitions import CONTROL, PACKETS
from flight.link.telemetry.packets import Packer
from flight.loop.facts import FACTS
from ground.documentation import database, main, markdown, markdown_of_events, markdown_of_telecommands
from tests.flight.link.published import COMMANDS, DIRECTIVES
from tests.flight.link.telemetry.samples import plain_contents

ROOT = Path(__file__).resolve().parents[4]


def test_the_document_in_the_repository_is_in_step_with_the_table() -> None:
    cure = "run: python -m ground.documentation > docs/telemetry.md"
    assert (ROOT / "docs" / "telemetry.md").read_text(encoding="utf-8") == markdown(), cure


def test_the_telecommands_in_the_repository_are_in_step_with_their_tables() -> None:
    cure = "run: python -m ground.documentation --telecommands > docs/telecommands.md"
    text = (ROOT / "docs" / "telecommands.md").read_text(encoding="utf-8")
    assert text == markdown_of_telecommands(), cure
    for name, apid, _, hazard in (*COMMANDS, *DIRECTIVES):
        section = text.split(f"\n## {name}\n")[1].split("\n## ")[0]
        assert f"0x{apid:03X}" in section
        assert ("Hazard" in section) == hazard


def test_the_page_of_events_names_every_event_and_alarm_with_a_remedy() -> None:
    cure = "run: python -m ground.documentation --events > docs/events.md"
    text = (ROOT / "docs" / "events.md").read_text(encoding="utf-8")
    assert text == markdown_of_events(), cure
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    named = {kind.name for kind in EVENTS} | {fact.name for fact in FACTS}
    assert {row[0] for row in rows} == {f"| `{name}`" for name in named}
    assert all((kind.remedy != "") == (kind.severity > Severity.INFORMATION) for kind in EVENTS)


def test_every_field_of_every_packet_is_documented() -> None:
    text = markdown()
    for packet in PACKETS:
        section = text.split(f"\n## {packet.name}\n")[1].split("\n## ")[0]
        assert f"0x{packet.apid:03X}" in section
        for field in packet.fields:
            assert f"| {field.name} |" in section
            assert field.meaning.replace("|", r"\|") in section


def test_the_ground_database_is_enough_to_read_a_packet() -> None:
    """A field of a packet is read at the offset that the database states, without code of this project."""
    ground = json.loads(json.dumps(database()))
    (control,) = (packet for packet in ground["packets"] if packet["name"] == "control")
    raw = Packer().pack(
        CONTROL, 77, {**plain_contents(CONTROL), "q2": 0.25, "current_written": (1.0, 2.0, 3.0)}
    )
    assert control["bytes"] == len(raw)
    where = {field["name"]: field["offset"] for field in control["fields"]}
    assert struct.unpack_from(">d", raw, where["q2"]) == (0.25,)
    assert struct.unpack_from(">3d", raw, where["current_written"]) == (1.0, 2.0, 3.0)
    assert struct.unpack_from(">q", raw, ground["secondary_header"][1]["offset"]) == (77,)
    assert struct.unpack_from(">H", raw)[0] & 0x7FF == control["apid"]


@pytest.mark.parametrize("arguments", [[], ["--json"], ["--telecommands"]])
def test_the_command_prints_the_page_or_the_database(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["documentation", *arguments])
    main()
    printed = capsys.readouterr().out
    if arguments == ["--json"]:
        assert json.loads(printed) == database()
    else:
        assert printed == (markdown_of_telecommands() if arguments else markdown())
