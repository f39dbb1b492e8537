"""CSV of a run, a file for each kind of packet, for spreadsheets and other people's tools.

The first row names the columns, mission time `time_s` first; arrays are spread out as quaternion_1 ..
quaternion_4. The second row begins with '#' and gives the units. Numbers are written to full precision.
"""

from __future__ import annotations

import csv
from pathlib import Path

from flight.gnc.errors import UsageError
from flight.link.telemetry.packets import LAYOUTS, Layout, PacketArray, to_text
from flight.link.telemetry.reader import Run


def export(run: Run, out_folder: Path) -> list[Path]:
    """Write `<packet>.csv` for every kind of packet that came; returns the files.

    Raises UsageError when the folder cannot be written.
    """
    try:
        out_folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for name, layout in LAYOUTS.items():
            if len(run[name]):
                paths.append(out_folder / f"{name}.csv")
                _write_table(paths[-1], layout, run[name])
    except OSError as error:
        raise UsageError(f"{out_folder}: no CSV can be written there: {error.strerror or error}") from error
    return paths


def _write_table(path: Path, layout: Layout, packets: PacketArray) -> None:
    names, units = ["time_s"], ["# s"]
    columns: list[list[object]] = [(packets["time_ns"] / 1e9).tolist()]
    for field in layout.packet.fields:
        spread: dict[str, list[object]]
        if field.kind.startswith("S"):
            spread = {field.name: [to_text(value) for value in packets[field.name]]}
        elif field.count == 1:
            spread = {field.name: packets[field.name].tolist()}
        else:
            spread = {f"{field.name}_{i + 1}": packets[field.name][:, i].tolist() for i in range(field.count)}
        names += spread.keys()
        columns += spread.values()
        units += [field.unit] * len(spread)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerow(units)
        writer.writerows(zip(*columns, strict=True))
