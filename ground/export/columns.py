"""The columns of a packet's table, whatever the format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link.telemetry.packets import LAYOUTS, Layout, PacketArray, to_text
from ground.telemetry import Run


@dataclass(frozen=True, slots=True)
class Column:
    """A column: texts as a list, numbers as an array (n,) in the machine's own order of bytes."""

    name: str
    unit: str
    meaning: str
    values: list[str] | npt.NDArray[Any]


def tables(run: Run) -> Iterator[tuple[str, list[Column]]]:
    """Yield name and columns of every kind of packet that came."""
    for name, layout in LAYOUTS.items():
        if len(run[name]):
            yield name, list(_columns(layout, run[name]))


def _columns(layout: Layout, packets: PacketArray) -> Iterator[Column]:
    yield Column("time_s", "s", "mission time", np.asarray(packets["time_ns"] / 1e9))
    for field in layout.packet.fields:
        values = packets[field.name]
        if field.kind.startswith("S"):
            yield Column(field.name, field.unit, field.meaning, [to_text(value) for value in values])
            continue
        native = values.astype(values.dtype.newbyteorder("="))
        spread = {field.name: native}
        if field.count > 1:
            spread = {f"{field.name}_{i + 1}": native[:, i] for i in range(field.count)}
        for column, own in spread.items():
            yield Column(column, field.unit, field.meaning, own)
