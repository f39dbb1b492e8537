"""Packet and telecommand definitions as XTCE (OMG, XTCE 1.2), for third-party ground stations.

`python -m ground.xtce [--epoch UTC] [--verified] > knightcube.xml`

The document uses only features that the tested ground station programs can read. The document has one flat
space system, one parameter per array element (`rate_1`) and per bit of a bit field
(`health_facts_gyro_lost`), names without `. / : [ ]`, zero-terminated texts, and a header of fixed values in
each telecommand. A parameter is named `<packet>_<field>`. The command `point` has one form for each pointing
goal, such as `point-ground`. The arguments of `point` are named after the goal's parameters, with angles in
degrees. Yamcs counts mission time from the epoch that the document states.
"""

from __future__ import annotations

import argparse
import math
import struct
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from flight.link.commands import LAYOUTS as COMMANDS
from flight.link.commands import POINT
from flight.link.process.commanding import Stage
from flight.link.process.directives import LAYOUTS as DIRECTIVES
from flight.link.process.directives import NEW_KEY, PORTION
from flight.link.telemetry.definitions import NO_YES, STAGES, Field
from flight.link.telemetry.packets import CRC_BYTES, HEADER_BYTES, LAYOUTS, Layout
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import (
    ARGUMENTS,
    NUMBERS,
    ROLLS,
    Goal,
)

SPACE = "KnightCube"
_OF_THE_LINK = (NEW_KEY.name, PORTION.name)
TELECOMMANDS = {
    **COMMANDS,
    **{name: layout for name, layout in DIRECTIVES.items() if name not in _OF_THE_LINK},
}
"""Telecommands that a third-party ground station may send, which excludes changes of keys."""
_XTCE = "http://www.omg.org/spec/XTCE/20180204"
EPOCH = "2000-01-01T00:00:00"
_BITS_OF = {"u1": 8, "u2": 16, "u4": 32, "u8": 64, "i8": 64, "f4": 32, "f8": 64}
UNUSED = "_spare"
"""Suffix of the name of a parameter for the unused bits of a bit field."""
_DEGREES = "deg"  # unit of an angle argument, which is encoded in rad
_NAN = struct.pack(">d", math.nan).hex()
"""Hexadecimal encoding of NaN, the value of an unused number of the command `point`."""
_PRIMARY = (
    ("VERSION", 3),
    ("TYPE", 1),
    ("SEC_HDR_FLG", 1),
    ("PKT_APID", 11),
    ("SEQ_FLGS", 2),
    ("SRC_SEQ_CTR", 14),
    ("PKT_LEN", 16),
)
"""Fields of the primary header in the order of their bits, with the names that clients expect."""
_VERIFIERS = (
    ("Accepted", "PT20S", (Stage.ACCEPTED,)),
    ("Execution", "PT20S", (Stage.STARTED,)),
    ("Complete", "PT1H", (Stage.COMPLETED,)),
    ("Failed", "PT1H", (Stage.REFUSED, Stage.FAILED)),
)
"""Verifiers of a command: XTCE name, Yamcs's timeout after the release, and stages in this software."""
_SENT_SEQUENCE = "/yamcs/cmdHist/ccsds-seqcount"  # Yamcs's name for the sequence count of a sent command


def epoch_of(text: str) -> str:
    """Return a UTC as a text without time zone, from any text in ISO 8601. Raises UsageError."""
    try:
        time = datetime.fromisoformat(text)
        utc = time if time.tzinfo is None else time.astimezone(UTC).replace(tzinfo=None)
    except (ValueError, OverflowError) as error:
        raise UsageError(f"--epoch {text}: give a UTC such as {EPOCH}") from error
    return utc.isoformat()


def document(
    telemetry: Mapping[str, Layout] = LAYOUTS,
    commands: Mapping[str, Layout] = TELECOMMANDS,
    epoch: str = EPOCH,
    verified: bool = False,
) -> str:
    """Return the packet tables in XTCE. The text `epoch` is the UTC of mission time zero, in ISO 8601.

    If `verified` is true, each command contains its verification by Yamcs, with a parameter name that only
    Yamcs knows.
    """
    root = Element("SpaceSystem", {"xmlns": _XTCE, "name": SPACE})
    meta = SubElement(root, "TelemetryMetaData")
    types, parameters = SubElement(meta, "ParameterTypeSet"), SubElement(meta, "ParameterSet")
    containers = SubElement(meta, "ContainerSet")
    _add_headers(types, parameters, containers, epoch)
    for layout in telemetry.values():
        _add_packet(layout, types, parameters, containers)
    meta = SubElement(root, "CommandMetaData")
    arguments, listed = SubElement(meta, "ArgumentTypeSet"), SubElement(meta, "MetaCommandSet")
    for layout in commands.values():
        for name, entries in _forms(layout):
            command = _add_command(name, layout, entries, arguments, listed)
            if verified:
                _add_verifiers(command, layout)
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def spread(layout: Layout) -> Iterator[tuple[str, Field]]:
    """Yield the name and the field of each parameter of a packet.

    Array elements are numbered from 1. Each named bit of a bit field is a parameter, so that it can have an
    alarm of its own.
    """
    for field in layout.packet.fields:
        base = f"{layout.packet.name}_{field.name}"
        if field.bits:
            yield from ((f"{layout.packet.name}_{bit.name}", bit) for bit in _bits_of(field))
        else:
            yield from ((base if field.count == 1 else f"{base}_{i + 1}", field) for i in range(field.count))


def _bits_of(field: Field) -> Iterator[Field]:
    """Yield a field for the unused bits of a bit field, and one for each named bit, the highest bit first."""
    spare = _size(field.kind) - len(field.bits)
    levels = dict(field.alarms)
    if spare:
        yield Field(f"{field.name}{UNUSED}", f"b{spare}", "-", "unused bits")
    for bit, label in reversed(field.bits):
        alarms = ((1, levels[bit]),) if bit in levels else ()
        name = f"{field.name}_{label.replace('-', '_')}"
        yield Field(name, "b1", "-", f"{label}, one of the {field.meaning}", states=NO_YES, alarms=alarms)


def _size(kind: str) -> int:
    """Return the size in bits of a number of the given kind; for example, `b3` has three bits."""
    return int(kind[1:]) if kind.startswith("b") else _BITS_OF[kind]


def _add_headers(types: Element, parameters: Element, containers: Element, epoch: str) -> None:
    for name, bits in (*_PRIMARY, ("definition_version", 8), ("error_control", 16)):
        _add_integer(types, f"{name}_Type", "u", bits)
        SubElement(parameters, "Parameter", {"name": name, "parameterTypeRef": f"{name}_Type"})
    time = SubElement(types, "AbsoluteTimeParameterType", {"name": "time_ns_Type"})
    scale = SubElement(time, "Encoding", {"units": "seconds", "scale": "1e-9"})
    SubElement(scale, "IntegerDataEncoding", {"sizeInBits": "64", "encoding": "twosComplement"})
    SubElement(SubElement(time, "ReferenceTime"), "Epoch").text = epoch
    SubElement(parameters, "Parameter", {"name": "time_ns", "parameterTypeRef": "time_ns_Type"})
    header = SubElement(containers, "SequenceContainer", {"name": "CCSDSPacket", "abstract": "true"})
    entries = SubElement(header, "EntryList")
    for name in (*(name for name, _ in _PRIMARY), "definition_version", "time_ns"):
        SubElement(entries, "ParameterRefEntry", {"parameterRef": name})


def _add_packet(layout: Layout, types: Element, parameters: Element, containers: Element) -> None:
    packet = layout.packet
    container = SubElement(containers, "SequenceContainer", {"name": packet.name})
    _describe(container, packet.meaning)
    entries = SubElement(container, "EntryList")
    typed: set[str] = set()
    for name, field in spread(layout):
        type_name = f"{packet.name}_{field.name}_Type"
        if type_name not in typed:
            _add_type(types, type_name, field, "Parameter")
            typed.add(type_name)
        parameter = SubElement(parameters, "Parameter", {"name": name, "parameterTypeRef": type_name})
        _describe(parameter, field.meaning)
        SubElement(entries, "ParameterRefEntry", {"parameterRef": name})
    SubElement(entries, "ParameterRefEntry", {"parameterRef": "error_control"})
    base = SubElement(container, "BaseContainer", {"containerRef": "CCSDSPacket"})
    comparisons = SubElement(SubElement(base, "RestrictionCriteria"), "ComparisonList")
    for name, value in (("TYPE", 0), ("PKT_APID", packet.apid), ("definition_version", packet.version)):
        SubElement(comparisons, "Comparison", {"parameterRef": name, "value": str(value)})


def _describe(element: Element, text: str) -> None:
    if text:
        element.set("shortDescription", text)


def _add_type(types: Element, name: str, field: Field, role: str) -> None:
    """Add the type of a parameter, or of an argument if `role` is "Argument"."""
    kind = field.kind
    if kind.startswith("S"):
        text = SubElement(types, f"String{role}Type", {"name": name})
        in_bits = SubElement(SubElement(text, "StringDataEncoding", {"encoding": "UTF-8"}), "SizeInBits")
        SubElement(SubElement(in_bits, "Fixed"), "FixedValue").text = str(8 * int(kind[1:]))
        SubElement(in_bits, "TerminationChar").text = "00"
    elif field.states:
        _add_enumeration(types, name, field, role)
    elif kind.startswith("f"):
        bits = str(_size(kind))
        number = SubElement(types, f"Float{role}Type", {"name": name, "sizeInBits": bits})
        _add_unit(number, field.unit)
        encoding = SubElement(number, "FloatDataEncoding", {"sizeInBits": bits, "encoding": "IEEE754_1985"})
        if role == "Argument" and field.unit == _DEGREES:
            polynomial = SubElement(SubElement(encoding, "DefaultCalibrator"), "PolynomialCalibrator")
            factor = repr(math.radians(1.0))
            SubElement(polynomial, "Term", {"coefficient": factor, "exponent": "1"})
        _add_ranges(number, field, role)
    else:
        number = _add_integer(types, name, kind[0], _size(kind), role, field.unit)
        _add_ranges(number, field, role)


def _add_enumeration(types: Element, name: str, field: Field, role: str) -> None:
    states = SubElement(types, f"Enumerated{role}Type", {"name": name})
    bits = str(_size(field.kind))
    SubElement(states, "IntegerDataEncoding", {"sizeInBits": bits, "encoding": "unsigned"})
    listed = SubElement(states, "EnumerationList")
    for number, label in field.states:
        SubElement(listed, "Enumeration", {"value": str(number), "label": label})
    if field.alarms and role == "Parameter":
        alarms = SubElement(SubElement(states, "DefaultAlarm"), "EnumerationAlarmList")
        labels = dict(field.states)
        for number, level in field.alarms:
            word = {"warning": "warning", "fault": "critical"}[level]
            SubElement(alarms, "EnumerationAlarm", {"alarmLevel": word, "enumerationLabel": labels[number]})


def _add_integer(
    types: Element, name: str, sign: str, bits: int, role: str = "Parameter", unit: str = "-"
) -> Element:
    signed = sign == "i"
    sizes = {"sizeInBits": str(bits), "signed": str(signed).lower()}
    number = SubElement(types, f"Integer{role}Type", {"name": name, **sizes})
    _add_unit(number, unit)
    coding = "twosComplement" if signed else "unsigned"
    SubElement(number, "IntegerDataEncoding", {"sizeInBits": str(bits), "encoding": coding})
    return number


def _add_unit(number: Element, unit: str) -> None:
    units = SubElement(number, "UnitSet")
    if unit != "-":
        SubElement(units, "Unit").text = unit


def _add_ranges(number: Element, field: Field, role: str) -> None:
    """Add the alarms of a parameter, or the valid range of an argument."""
    if role == "Argument":
        if field.valid is not None:
            _add_range(SubElement(number, "ValidRangeSet"), "ValidRange", field.valid)
    elif field.limits is not None:
        ranges = SubElement(SubElement(number, "DefaultAlarm"), "StaticAlarmRanges")
        for word, bounds in (("Warning", field.limits.warning), ("Critical", field.limits.fault)):
            if bounds is not None:
                _add_range(ranges, f"{word}Range", bounds)


def _add_range(parent: Element, name: str, bounds: tuple[float, float]) -> None:
    low, high = bounds
    SubElement(parent, name, {"minInclusive": f"{low:g}", "maxInclusive": f"{high:g}"})


class _Omissible(Field):
    """Argument that is NaN if it is omitted."""


_Entry = Field | str
"""Entry of a telecommand: a field, which is an argument, or fixed bytes in hexadecimal digits."""


def _forms(layout: Layout) -> Iterator[tuple[str, list[_Entry]]]:
    """Yield the name and the entries of each XTCE form of a command.

    The command `point` has one form for each goal, in which unused numbers are NaN. Every command except
    `point` has one form.
    """
    packet = layout.packet
    if packet is not POINT:
        prefix = f"{packet.name}_"
        yield packet.name, [replace(field, name=name.removeprefix(prefix)) for name, field in spread(layout)]
        return
    kind, numbers, roll = packet.fields
    free_roll = _Omissible(roll.name, roll.kind, _DEGREES, roll.meaning)
    for goal in Goal:
        named = [_argument(goal, *one) for one in ARGUMENTS.get(goal, ())]
        unused = [_NAN] * (numbers.count - len(named))
        code = f"{goal:0{_size(kind.kind) // 4}x}"
        yield f"{packet.name}-{goal.label}", [code, *named, *unused, _NAN if goal in ROLLS else free_roll]


def _argument(goal: Goal, name: str, unit: str, low: float, high: float) -> Field:
    """Return the field of one argument of a pointing goal, with angles in degrees."""
    factor, unit = (math.degrees(1.0), _DEGREES) if unit == "rad" else (1.0, unit)
    kind = _Omissible if 0 in NUMBERS[goal] else Field
    meaning = f"{name} of the goal {goal.label}"
    return kind(name.replace(" ", "_"), "f8", unit, meaning, valid=(factor * low, factor * high))


def _add_command(name: str, layout: Layout, form: list[_Entry], types: Element, listed: Element) -> Element:
    packet = layout.packet
    command = SubElement(listed, "MetaCommand", {"name": name})
    _describe(command, packet.meaning)
    arguments = Element("ArgumentList")
    if packet.fields:  # XTCE does not allow an empty argument list
        command.append(arguments)
    container = SubElement(command, "CommandContainer", {"name": f"{name}_packet"})
    entries = SubElement(container, "EntryList")
    header = layout.identifier << 32 | 0xC000 << 16 | layout.length - HEADER_BYTES - 1
    _add_fixed(entries, "primary_header", f"{header:012x}")
    _add_fixed(entries, "secondary_header", f"{packet.version:02x}" + "00" * 8)
    for number, field in enumerate(form):
        if isinstance(field, str):
            _add_fixed(entries, f"fixed_{number}", field)
            continue
        type_name = f"{name}_{field.name}_Argument"
        _add_type(types, type_name, field, "Argument")
        argument = SubElement(arguments, "Argument", {"name": field.name, "argumentTypeRef": type_name})
        _describe(argument, field.meaning)
        if isinstance(field, _Omissible):
            argument.set("initialValue", "NaN")
        SubElement(entries, "ArgumentRefEntry", {"argumentRef": field.name})
    _add_fixed(entries, "error_control", "00" * CRC_BYTES)
    if packet.hazard:
        significance = {"consequenceLevel": "critical", "reasonForWarning": packet.hazard}
        SubElement(command, "DefaultSignificance", significance)
    return command


def _add_verifiers(command: Element, layout: Layout) -> None:
    """Add the verification stages of a command, which `verification` packets report."""
    verifiers = SubElement(command, "VerifierSet")
    for kind, window, stages in _VERIFIERS:
        verifier = SubElement(verifiers, f"{kind}Verifier")
        conditions = SubElement(SubElement(verifier, "BooleanExpression"), "ANDedConditions")
        _add_condition(conditions, "verification_packet", layout.identifier)
        _add_condition(conditions, "verification_sequence", _SENT_SEQUENCE)
        either = SubElement(conditions, "ORedConditions") if len(stages) > 1 else conditions
        for stage in stages:
            _add_condition(either, "verification_stage", dict(STAGES)[stage])
        window_of = {"timeToStopChecking": window, "timeWindowIsRelativeTo": "commandRelease"}
        SubElement(verifier, "CheckWindow", window_of)
        if kind in {"Complete", "Failed"}:  # other verifiers cannot return a parameter
            SubElement(verifier, "ReturnParmRef", {"parameterRef": "verification_text"})


def _add_condition(parent: Element, name: str, value: int | str) -> None:
    """Add the comparison of a parameter with a number, a label, or another parameter ("/NAME")."""
    condition = SubElement(parent, "Condition")
    SubElement(condition, "ParameterInstanceRef", {"parameterRef": name})
    SubElement(condition, "ComparisonOperator").text = "=="
    if str(value).startswith("/"):
        SubElement(condition, "ParameterInstanceRef", {"parameterRef": str(value)})
    else:
        SubElement(condition, "Value").text = str(value)


def _add_fixed(entries: Element, name: str, value: str) -> None:
    """Add fixed bytes. The sender replaces the sequence count, and the gateway replaces time and CRC."""
    size = {"sizeInBits": str(4 * len(value)), "binaryValue": value}
    SubElement(entries, "FixedValueEntry", {"name": name, **size})


def main() -> None:
    """Print the document."""
    parser = argparse.ArgumentParser(prog="python -m ground.xtce", description=__doc__)
    parser.add_argument("--epoch", default=EPOCH, metavar="UTC", help=f"mission time zero (default {EPOCH})")
    parser.add_argument("--verified", action="store_true", help="add the verification of commands by Yamcs")
    options = parser.parse_args()
    try:
        sys.stdout.write(document(epoch=epoch_of(options.epoch), verified=options.verified))
    except UsageError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
