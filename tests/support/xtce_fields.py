"""Compares all packet fields that `space-packet-parser` reads by the XTCE file with the fields of our reader.

`python -m tests.support.xtce_fields RUN...` prints the number of equal fields in the logs of the runs. The
exit status is 1 if a field differs, a packet is not read, or a deliberately shifted field is not detected.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import space_packet_parser as other
from space_packet_parser.xtce.definitions import XtcePacketDefinition

from flight.link.telemetry.definitions import Field
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, Layout, to_text
from ground.telemetry import scan
from ground.xtce import document, spread

_BY_APID = {layout.packet.apid: layout for layout in LAYOUTS.values()}


def definition_of(text: str) -> XtcePacketDefinition:
    """Return the packet definition that `space-packet-parser` reads from an XTCE document."""
    return XtcePacketDefinition.from_xtce(io.BytesIO(text.encode()))


def compare(data: bytes, text: str) -> dict[str, int]:
    """Return the numbers of packets, unread packets, compared fields and different fields of `data`.

    Sequence count, mission time and version of each packet are compared too.
    """
    definition = definition_of(text)
    rows = {name: iter(array) for name, array in scan(data).packets.items()}
    counts = {"fields": 0, "different": 0, "packets": 0, "unread": 0}
    for raw in other.ccsds_generator(io.BytesIO(data)):
        layout = _BY_APID[raw.apid]
        counts["packets"] += 1
        try:
            read = definition.parse_bytes(raw)
        except Exception:  # noqa: BLE001 - whatever the other client raises, the packet was not read
            counts["unread"] += 1
            next(rows[layout.packet.name])
            continue
        wanted = _wanted(layout, next(rows[layout.packet.name]), bytes(raw))
        counts["fields"] += len(wanted)
        counts["different"] += sum(not _alike(read.get(name), value) for name, value in wanted.items())
    counts["unread"] += sum(len(list(left)) for left in rows.values())
    return counts


def _wanted(layout: Layout, row: Any, raw: bytes) -> dict[str, Any]:
    """Return the values that our reader finds in a packet, by their names in the XTCE file."""
    sequence = int(layout.sequence_counts(raw)[0])
    values: dict[str, Any] = {
        "time_ns": int(row["time_ns"]),
        "SRC_SEQ_CTR": sequence,
        "definition_version": layout.packet.version,
    }
    flat: list[Any] = []
    for field in layout.packet.fields:
        value: Any = to_text(row[field.name]) if field.kind.startswith("S") else row[field.name].tolist()
        flat += single_bits(field, value) if field.bits else value if field.count > 1 else [value]
    return values | dict(zip((name for name, _ in spread(layout)), flat, strict=True))


def single_bits(field: Field, value: int) -> list[int]:
    """Return the unused bits of a bit field as one value, if any, then its named bits, highest first."""
    used, size = len(field.bits), 8 * int(field.kind[1:])
    spare = [value >> used] if size > used else []
    return spare + [value >> bit & 1 for bit in reversed(range(used))]


def _alike(read: Any, wanted: Any) -> bool:
    """Return whether both readers found the same value. Named or scaled fields are compared as raw values."""
    if read is None:
        return False
    value = read if isinstance(wanted, str) else read.raw_value
    if isinstance(wanted, float) and math.isnan(wanted):
        return math.isnan(value)
    return bool(value == wanted)


def shifted(text: str) -> str:
    """Return an XTCE document in which a field of `imu` is one byte too late, and the CRC has one byte."""
    entry = '<ParameterRefEntry parameterRef="{}" />'
    before, after = text.split(entry.format("imu_device_time_ns"))
    pads = [
        f'<Parameter name="{name}" parameterTypeRef="definition_version_Type" />' for name in ("pad", "rest")
    ]
    before = before.replace("</ParameterSet>", "".join(pads) + "</ParameterSet>")
    after = after.replace(entry.format("error_control"), entry.format("rest"), 1)
    return before + entry.format("pad") + entry.format("imu_device_time_ns") + after


def logs_of(run: Path) -> bytes:
    """Return the bytes of all logs of a run."""
    stems = ("flight", "truth", "performance")
    return b"".join(path.read_bytes() for stem in stems for path in find_segments(run, stem))


def main() -> int:
    """Print the comparison of each run."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.xtce_fields", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    sound = True
    for run in parser.parse_args().runs:
        data = logs_of(run)
        counts = compare(data, document())
        some = islice(other.ccsds_generator(io.BytesIO(data)), 1000)
        noticed = compare(b"".join(bytes(raw) for raw in some), shifted(document()))["different"]
        sound &= counts["fields"] > 0 and counts["different"] == counts["unread"] == 0
        sound &= noticed > 0
        line = {"run": str(run), **counts, "different_when_shifted": noticed}
        sys.stdout.write(json.dumps(line) + "\n")
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
