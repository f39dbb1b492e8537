"""Tests that an independent client reads the XTCE file, and finds all packets and fields."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import pytest
import space_packet_parser
from lxml import etree

from flight.bodies.orbit.body import LEVELS
from flight.link.commands import COMMANDS, POINT, unpack, words_of
from flight.link.events import Severity
from flight.link.process.commanding import Stage
from flight.link.process.directives import DIRECTIVES, NEW_KEY, PORTION
from flight.link.telemetry import definitions
from flight.link.telemetry.definitions import PACKETS, Field, Limits, Packet
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, Packer, compile_layouts, crc16
from flight.loop.body import SteeringState
from flight.loop.facts import FACTS, StreamState
from ground import documentation
from ground.xtce import document, epoch_of, main, spread
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal
from tests.flight.link.telemetry.samples import plain_contents
from tests.support.xtce_fields import compare, definition_of, shifted

SPACE = {"x": "http://www.omg.org/spec/XTCE/20180204"}
DOOR = Packet(
    "door",
    0x1F0,
    "1 Hz",
    "A packet made up",
    (
        Field(
            "leaf", "u1", "-", "of each side", 2, states=((0, "shut"), (7, "ajar")), alarms=((7, "fault"),)
        ),
        Field("gap", "f4", "mm", "between the leaves", limits=Limits(warning=(-1.5, 2.0))),
        Field("locks", "u1", "-", "closed", bits=((0, "top"), (1, "low-end")), alarms=((1, "warning"),)),
    ),
)


def found(root: Element, path: str) -> Element:
    element = root.find(path, SPACE)
    assert element is not None, path
    return element


XML_SCHEMA = (
    '<schema xmlns="http://www.w3.org/2001/XMLSchema" targetNamespace="http://www.w3.org/XML/1998/namespace">'
    '<attribute name="base" type="anyURI"/></schema>'
)
"""Replacement of the schema `xml.xsd` with the only declaration that XTCE needs; the original is on a web
server."""


@pytest.fixture(scope="module")
def schema(tmp_path_factory: pytest.TempPathFactory) -> etree.XMLSchema:
    """Return the OMG schema of XTCE 1.2 from its copy in the package space-packet-parser."""
    original = Path(space_packet_parser.__file__).parent / "xtce" / "schemas" / "SpaceSystem.xsd"
    folder = tmp_path_factory.mktemp("schema")
    (folder / "xml.xsd").write_text(XML_SCHEMA, encoding="utf-8")
    local = re.sub(r'schemaLocation="[^"]*/xml.xsd"', 'schemaLocation="xml.xsd"', original.read_text("utf-8"))
    (folder / "SpaceSystem.xsd").write_text(local, encoding="utf-8")
    return etree.XMLSchema(etree.parse(str(folder / "SpaceSystem.xsd")))


@pytest.mark.parametrize("verified", [False, True])
def test_the_document_is_valid_by_the_schema_of_the_omg(schema: etree.XMLSchema, verified: bool) -> None:
    root = etree.fromstring(document(verified=verified).encode())
    assert schema.validate(root), str(schema.error_log)
    argument = next(root.iter("{*}Argument"))
    argument.attrib.pop("argumentTypeRef")
    assert not schema.validate(root), "the schema notices a missing attribute"


def test_a_field_with_states_appears_everywhere_from_its_row_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    layouts = compile_layouts([DOOR])
    raw = Packer(layouts).pack(DOOR, 5, leaf=[7, 0], gap=1.5, locks=0b10)
    text = document(layouts, {})
    types = found(fromstring(text), "x:TelemetryMetaData/x:ParameterTypeSet")
    assert found(types, ".//x:Enumeration[@value='7']").get("label") == "ajar"
    assert found(types, ".//x:EnumerationAlarm").get("alarmLevel") == "critical"
    assert found(types, ".//x:WarningRange").attrib == {"minInclusive": "-1.5", "maxInclusive": "2"}
    read = definition_of(text).parse_bytes(raw)
    assert (read["door_leaf_1"], read["door_leaf_2"], read["door_gap"]) == ("ajar", "shut", 1.5)
    assert (read["door_locks_low_end"], read["door_locks_top"], read["door_locks_spare"]) == ("yes", "no", 0)
    alarms = {
        each.get("name"): [alarm.attrib for alarm in each.iter(f"{{{SPACE['x']}}}EnumerationAlarm")]
        for each in types
    }
    assert alarms["door_locks_low_end_Type"] == [{"alarmLevel": "warning", "enumerationLabel": "yes"}]
    assert alarms["door_locks_top_Type"] == []
    monkeypatch.setattr(documentation, "LAYOUTS", layouts)
    assert "of each side; 0 shut, 7 ajar (fault)" in documentation.markdown()
    field = documentation.database()["packets"][0]["fields"][0]
    assert (field["states"], field["alarms"]) == ([[0, "shut"], [7, "ajar"]], [[7, "fault"]])


def test_every_packet_is_read_alike_by_the_other_client_and_a_shifted_field_is_noticed() -> None:
    packer = Packer()
    packets = [packer.pack(packet, 77, plain_contents(packet)) for packet in PACKETS]
    total = sum(len(list(spread(layout))) + 3 for layout in LAYOUTS.values())
    raw = b"".join(packets)
    assert compare(raw, document()) == {"fields": total, "different": 0, "packets": len(PACKETS), "unread": 0}
    noticed = compare(raw, shifted(document()))
    assert noticed["unread"] == 0
    assert noticed["different"] > 10, "of the packet imu nearly all"


def test_the_command_prints_the_document_with_its_epoch(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["xtce", "--epoch", "2026-11-23T12:00:00"])
    main()
    printed = capsys.readouterr().out
    assert found(fromstring(printed), ".//x:Epoch").text == "2026-11-23T12:00:00"
    assert printed == document(epoch="2026-11-23T12:00:00")


def test_names_are_plain_and_commands_carry_ranges_and_hazards() -> None:
    root = fromstring(document())
    names = [element.get("name", "") for element in root.iter()]
    assert not [name for name in names if set(name) & set("./:[] ")]
    commands = found(root, "x:CommandMetaData/x:MetaCommandSet")
    assert [command.get("name") for command in commands] == [
        name
        for packet in (*COMMANDS, *DIRECTIVES)
        if packet not in (NEW_KEY, PORTION)
        for name in ([f"point-{goal.label}" for goal in Goal] if packet is POINT else [packet.name])
    ]
    arguments = found(root, "x:CommandMetaData/x:ArgumentTypeSet")
    assert found(arguments, ".//x:ValidRange").attrib == {"minInclusive": "-0.68", "maxInclusive": "0.68"}
    significance = found(commands, "x:MetaCommand[@name='slew']/x:DefaultSignificance")
    assert significance.get("reasonForWarning") == "moves the body"


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("point-sun", {"roll": 90.0}, "point sun roll 90deg"),
        ("point-nadir", {}, "point nadir"),
        (
            "point-ground",
            {"latitude": -52.5, "longitude": 13.4, "roll": 30.0},
            "point ground -52.5deg 13.4deg roll 30deg",
        ),
        ("point-ground", {"latitude": 52.5, "longitude": 13.4}, "point ground 52.5deg 13.4deg"),
        (
            "point-inertial",
            {f"quaternion_{axis}": value for axis, value in zip("xyzw", (0.6, 0.0, 0.0, 0.8), strict=True)},
            "point inertial 0.6 0 0 0.8",
        ),
        ("point-object", {"right_ascension": 120.0, "declination": -5.0}, "point object 120deg -5deg"),
        ("point-object", {}, "point object"),
    ],
)
def test_each_form_of_point_takes_degrees_and_is_the_command_in_words(
    name: str, values: dict[str, float], words: str
) -> None:
    """The flight software reads commands that a client packs by the XTCE document, with angles in deg."""
    root = found(fromstring(document()), "x:CommandMetaData")
    command = found(root, f"x:MetaCommandSet/x:MetaCommand[@name='{name}']")
    arguments = {one.get("name"): one for one in command.iter(f"{{{SPACE['x']}}}Argument")}
    assert set(values) <= set(arguments)
    data = b""
    for entry in found(command, "x:CommandContainer/x:EntryList"):
        if fixed := entry.get("binaryValue"):
            data += bytes.fromhex(fixed)
            continue
        argument = arguments[entry.get("argumentRef")]
        kind = found(root, f"x:ArgumentTypeSet/*[@name='{argument.get('argumentTypeRef')}']")
        value = values.get(str(argument.get("name")), float(argument.get("initialValue", "inf")))
        term = kind.find(".//x:Term", SPACE)
        assert (term is None) is (kind.findtext(".//x:Unit", None, SPACE) is None)
        data += struct.pack(">d", value if term is None else value * float(term.get("coefficient", "")))
    data = data[:-CRC_BYTES]
    assert words_of(unpack(data + crc16(data).to_bytes(CRC_BYTES, "big"))) == words


def test_the_states_of_the_table_are_those_of_the_code() -> None:
    """The state names of the packet table equal the names in the code.

    The link cannot import these names, because loop and bodies define them.
    """
    assert tuple((int(state), state.name.lower()) for state in SteeringState) == definitions.STEERING
    streams = tuple((int(state), state.name.lower().replace("_", "-")) for state in StreamState)
    assert streams == definitions.STREAMS
    assert tuple((int(stage), stage.name.lower()) for stage in Stage) == definitions.STAGES
    assert tuple((i, level.value) for i, level in enumerate(LEVELS)) == definitions.KNOWLEDGE
    assert tuple((i, fact.name) for i, fact in enumerate(FACTS)) == definitions.FACTS
    grave = {fact.name: fact.begins.severity is Severity.FAULT for fact in FACTS}
    named = dict(definitions.FACTS)
    assert {named[bit]: level == "fault" for bit, level in definitions.FACT_ALARMS} == grave


@pytest.mark.parametrize("stream", ["imu", "field", "coils", "power", "camera"])
def test_a_stream_without_a_reading_yet_raises_no_alarm_and_one_that_never_came_is_critical(
    stream: str,
) -> None:
    types = found(fromstring(document()), "x:TelemetryMetaData/x:ParameterTypeSet")
    kind = found(types, f"x:EnumeratedParameterType[@name='health_{stream}_Type']")
    values = {item.get("label"): int(item.get("value", "")) for item in found(kind, "x:EnumerationList")}
    assert values["no-reading-yet"] == StreamState.NO_READING_YET
    levels = {
        item.get("enumerationLabel"): item.get("alarmLevel")
        for item in found(kind, "x:DefaultAlarm/x:EnumerationAlarmList")
    }
    assert "no-reading-yet" not in levels
    assert levels["never"] == "critical"


def test_each_stage_of_a_command_is_verified_by_identifier_sequence_and_stage() -> None:
    commands = found(fromstring(document(verified=True)), "x:CommandMetaData/x:MetaCommandSet")
    verifiers = found(commands, "x:MetaCommand[@name='ping']/x:VerifierSet")
    seen = {}
    for verifier in verifiers:
        conditions = [
            (
                found(condition, "x:ParameterInstanceRef").get("parameterRef"),
                condition.findtext("x:Value", None, SPACE),
            )
            for condition in verifier.iter("{http://www.omg.org/spec/XTCE/20180204}Condition")
        ]
        window = found(verifier, "x:CheckWindow").get("timeToStopChecking")
        seen[verifier.tag.partition("}")[2]] = (window, conditions)
    same = [("verification_packet", str(0x1A01)), ("verification_sequence", None)]
    assert seen == {
        "AcceptedVerifier": ("PT20S", [*same, ("verification_stage", "accepted")]),
        "ExecutionVerifier": ("PT20S", [*same, ("verification_stage", "started")]),
        "CompleteVerifier": ("PT1H", [*same, ("verification_stage", "completed")]),
        "FailedVerifier": (
            "PT1H",
            [*same, ("verification_stage", "refused"), ("verification_stage", "failed")],
        ),
    }


@pytest.mark.parametrize(
    ("text", "epoch"),
    [
        ("2026-11-23T12:00:00", "2026-11-23T12:00:00"),
        ("2026-11-23T12:00:00Z", "2026-11-23T12:00:00"),
        ("2026-11-23T12:00:00+02:00", "2026-11-23T10:00:00"),
        ("2026-11-23", "2026-11-23T00:00:00"),
        ("20261123T1200", "2026-11-23T12:00:00"),
        ("foo", None),
        ("0001-01-01T00:00+01:00", None),
    ],
)
def test_an_epoch_is_a_utc(text: str, epoch: str | None) -> None:
    if epoch is None:
        with pytest.raises(UsageError, match=r"--epoch .*: give a UTC such as"):
            epoch_of(text)
    else:
        assert epoch_of(text) == epoch
