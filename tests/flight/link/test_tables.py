"""Tests that events, modes, commands and directives keep their published numbers."""

from __future__ import annotations

import pytest

from flight.link import commands, events
from flight.link.events import EVENTS, EventKind, Mode, Reaction, Severity
from flight.link.process import directives
from flight.link.telemetry.definitions import PARAMETER_FIELDS, PARAMETER_KEYS, Packet
from tests.flight.link.published import COMMANDS, DIRECTIVES, PARAMETERS, published_events


def test_every_event_has_its_published_code_severity_and_reaction() -> None:
    found = {
        kind.code: (kind.name, kind.severity.name.lower(), kind.reaction.name.lower()) for kind in EVENTS
    }
    assert found == published_events()
    assert all(kind.meaning for kind in EVENTS)


def test_the_numbers_of_severities_and_reactions_are_those_of_old_logs() -> None:
    assert [(kind.name, int(kind)) for kind in Severity] == [("INFORMATION", 0), ("WARNING", 1), ("FAULT", 2)]
    assert [kind.name for kind in sorted(Reaction)] == [
        "NOTE", "COILS_OFF", "ISOLATE", "HOLD", "DETUMBLE", "SAFE", "RESTART", "RETURN",
    ]  # fmt: skip
    assert [int(kind) for kind in Reaction] == list(range(8))


def test_an_event_is_only_noted_unless_its_row_names_a_reaction() -> None:
    assert EventKind(1, "plain", Severity.FAULT, "-").reaction is Reaction.NOTE
    assert events.CYCLE_SLIP.severity is Severity.WARNING


def test_modes_keep_their_numbers_and_only_some_can_be_commanded() -> None:
    names = ["boot", "safe", "detumble", "hold", "slew", "testbed-demo", "acquire", "sun", "point"]
    assert [(int(mode), mode.label) for mode in Mode] == list(enumerate(names))
    assert [mode.label for mode in events.COMMANDABLE] == [
        "safe", "detumble", "hold", "slew", "testbed-demo", "sun", "point",
    ]  # fmt: skip
    assert {mode.label for mode in events.POINTING} == {"sun", "point"}
    assert {mode.label for mode in events.ORBITAL} == {"sun", "point", "acquire"}
    assert {mode.label for mode in events.STEERING} == {"sun", "point", "hold", "slew", "testbed-demo"}


@pytest.mark.parametrize("mode", Mode)
def test_a_mode_is_found_by_its_label(mode: Mode) -> None:
    assert Mode.named(mode.label) is mode


def test_a_label_of_no_mode_is_refused_with_the_list_of_modes() -> None:
    with pytest.raises(ValueError, match="'drift' is not a mode: use boot, safe, detumble"):
        Mode.named("drift")


def described(packet: Packet) -> tuple[int, int, str, bool]:
    """Return APID, version, field types with ranges and states, and hazard flag of a command."""
    fields = []
    for field in packet.fields:
        text = f"{field.name}:{field.count if field.count > 1 else ''}{field.kind}"
        if field.valid is not None:
            text += f"[{field.valid[0]:g},{field.valid[1]:g}]"
        if field.states:
            text += "{" + ",".join(f"{number}={label}" for number, label in field.states) + "}"
        fields.append(text)
    return packet.apid, packet.version, " ".join(fields), bool(packet.hazard)


def test_every_command_has_its_published_packet() -> None:
    parameters = " ".join(
        f"{key.replace('.', '_', 1)}:f8[{low:g},{high:g}]" for key, _, low, high in PARAMETERS
    )
    found = {packet.name: described(packet) for packet in commands.COMMANDS}
    assert found == {
        name: (apid, 1, fields.replace("PARAMETERS", parameters), hazard)
        for name, apid, fields, hazard in COMMANDS
    }
    assert all(packet.telecommand for packet in commands.COMMANDS)


def test_every_directive_has_its_published_packet() -> None:
    found = {packet.name: described(packet) for packet in directives.DIRECTIVES}
    assert found == {name: (apid, 1, fields, hazard) for name, apid, fields, hazard in DIRECTIVES}
    assert all(packet.telecommand for packet in directives.DIRECTIVES)


def test_a_command_begins_with_version_0_type_1_and_its_apid() -> None:
    """A telecommand begins with version 000, type 1, secondary header flag 1 and its APID.

    CCSDS 133.0-B-2, 4.1.3, defines this primary header.
    """
    for layouts in (commands.LAYOUTS, directives.LAYOUTS):
        for layout in layouts.values():
            assert layout.identifier == 0x1800 | layout.packet.apid


def test_every_parameter_has_its_published_unit_and_bounds() -> None:
    found = [(field.unit, *(field.valid or ())) for field in PARAMETER_FIELDS]
    assert list(zip(PARAMETER_KEYS, found, strict=True)) == [
        (key, (unit, low, high)) for key, unit, low, high in PARAMETERS
    ]
