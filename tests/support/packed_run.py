"""A run of a few packets. A test gives some values, and all other fields are zero."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flight.link.telemetry.packets import LAYOUTS, Packer
from ground.telemetry import Run, scan

Rows = Sequence[tuple[float, Mapping[str, Any]]]


class WritablePackets(dict[str, Any]):
    """Changeable packets that replace the packets of a run in tests."""

    logs: Any


def packed_run(folder: Path = Path("run"), **packets: Rows) -> Run:
    """Return a run from rows (mission time in s, values by field) of each packet type."""
    packer, raw = Packer(), []
    for name, rows in packets.items():
        packet = LAYOUTS[name].packet
        for time, values in rows:
            filled: dict[str, Any] = {}
            for field in packet.fields:
                zero: Any = "" if field.kind.startswith("S") else 0
                filled[field.name] = [zero] * field.count if field.count > 1 else zero
            raw.append(packer.pack(packet, round(time * 1e9), {**filled, **values}))
    return Run(folder, scan(b"".join(raw)), scan(b""), scan(b""))
