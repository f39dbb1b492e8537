"""Short simulated flights whose packets are recorded in `recorded_flights.json`.

After an intended change of the behaviour, `python -m tests.support.recorded_flights` writes the record again.
The record of a number contains the count of finite values, and their mean, root mean square and last value
over the flight. The components of an array are weighted by 1, 2, 3, ..., so that an exchange of two
components changes the recorded values. Only texts that are names are recorded, because the wording of
messages may change. Values that depend on the computer are omitted.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flight.link.telemetry.definitions import Packet
from flight.link.telemetry.packets import LAYOUTS, to_text
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, TestbedConfig, as_orbit
from flight.schema.document import config_path
from flight.schema.sections import Commands, CommandStep, Config
from ground.telemetry import Run
from sim_hal.settings import FaultEntry, Simulation
from tests.support.flights import demo_config, demo_world, fly, thesis_config
from tests.support.shared_results import made_once

RECORD = Path(__file__).with_suffix(".json")
TOLERANCE = 1e-5
"""Largest accepted relative difference from the record, for rounding in another order."""
NAMES = {
    ("event", "name"),
    ("mode", "trigger"),
    ("plan", "status"),
    ("streak", "status"),
    ("stars", "status"),
}
"""Text fields that are recorded, because they contain names."""
OF_THE_COMPUTER = {
    "run": {"config_name", "config_crc", "software", "utc_ns", "seed"},
    "health": {"cpu_share", "proportional", "memory_slope", "disk_free", "temperature"},
    "event": {"code"},
    "plan": {"evaluations"},
}
"""Fields that depend on the computer, or on the text of the configuration, and are not recorded.

For instance, the number of evaluations in an optimisation depends on the processor's rounding.
"""
UNTIMED = {"cycle_timing", "job_timing", "rate_group"}
"""Packets that contain elapsed times measured on the computer."""

Record = dict[str, dict[str, Any]]


def record_of(run: Run) -> Record:
    """Return the record of a flight: the number of packets of each type, and the statistics of each field."""
    found: Record = {}
    for name, layout in LAYOUTS.items():
        rows = run[name]
        if len(rows) and name not in UNTIMED:
            found[name] = {"count": len(rows), **_fields(layout.packet, rows)}
    return found


def _fields(packet: Packet, rows: Any) -> dict[str, Any]:
    omitted = OF_THE_COMPUTER.get(packet.name, set())
    figures: dict[str, Any] = {"time_ns": _figures(rows["time_ns"] * 1e-9)}
    for field in packet.fields:
        if field.name in omitted:
            continue
        if not field.kind.startswith("S"):
            figures[field.name] = _figures(rows[field.name])
        elif (packet.name, field.name) in NAMES:
            figures[field.name] = [to_text(text) for text in rows[field.name]]
    return figures


def _figures(values: Any) -> list[float]:
    """Return the number of finite values, and the mean, root mean square and last finite value."""
    weighted = values.astype(float).reshape(len(values), -1)
    weighted = weighted * np.arange(1, weighted.shape[1] + 1)
    finite = weighted[np.isfinite(weighted)]
    if not len(finite):
        return [0, 0.0, 0.0, 0.0]
    mean, rms = float(finite.mean()), float(np.sqrt(np.mean(finite**2)))
    return [len(finite), float(f"{mean:.7g}"), float(f"{rms:.7g}"), float(f"{finite[-1]:.7g}")]


def differences(record: Record, found: Record) -> list[str]:
    """Return the packets and fields of a flight that differ from the record, one text per field."""
    lines = [f"{name}: in one of them only" for name in sorted(record.keys() ^ found.keys())]
    for name in sorted(record.keys() & found.keys()):
        for field, known in record[name].items():
            now = found[name].get(field)
            if not _alike(known, now):
                lines.append(f"{name}.{field}: {now}, recorded {known}")
    return lines


def _alike(known: Any, now: Any) -> bool:
    if not isinstance(known, list) or not isinstance(now, list) or isinstance((known or [""])[0], str):
        return bool(known == now)
    scale = TOLERANCE * abs(known[2]) + 1e-300
    return known[0] == now[0] and all(
        math.isclose(a, b, abs_tol=scale) for a, b in zip(known, now, strict=True)
    )


def recorded(name: str) -> Record:
    """Return the stored record of a flight."""
    record: Record = json.loads(RECORD.read_text(encoding="utf-8"))[name]
    return record


def faults(*entries: tuple[str, float, float]) -> tuple[FaultEntry, ...]:
    """Return fault entries. Each fault is given by its text, start (s) and duration (s)."""
    return tuple(FaultEntry(fault=text, at=at, span=span) for text, at, span in entries)


def commanded(config: Any, *steps: dict[str, Any], **modes: Any) -> Any:
    """Return a configuration with scheduled commands, and with changed settings of the modes."""
    timeline = tuple(CommandStep(**step) for step in steps)
    section = configuration.replace(config.modes, **modes)
    return configuration.replace(config, modes=section, commands=Commands(timeline=timeline))


IMPATIENT = {"arrived_for": 0.3, "boot_patience": 1.0, "hold_patience": 1.0, "blind_limit": 1.0}
"""Short timeouts (s) of the modes."""


def _orbit_config(duration: float) -> OrbitConfig:
    """Return the configuration of the orbit demonstration without cameras."""
    config = as_orbit(configuration.load(config_path("orbit")))
    return configuration.replace(config, wide_cameras=(), camera=None, duration=duration)


def _orbit_world(speed: float, *entries: tuple[str, float, float]) -> Simulation:
    text = config_path("orbit").read_text(encoding="utf-8")
    section = configuration.simulation_section(text, "orbit", Simulation)
    assert section is not None
    assert section.free_body is not None
    release = configuration.replace(section.free_body.release, speed=speed)
    body = configuration.replace(section.free_body, release=release)
    return configuration.replace(section, free_body=body, faults=faults(*entries))


def _demo_with(*entries: tuple[str, float, float]) -> Simulation:
    return configuration.replace(demo_world(), faults=faults(*entries))


def _cage() -> tuple[Config, Simulation]:
    text = config_path("cage").read_text(encoding="utf-8")
    section = configuration.simulation_section(text, "cage", Simulation)
    assert section is not None
    return configuration.parse(text).shortened(1.0), section


def _demo(duration: float) -> TestbedConfig:
    return demo_config(duration, camera=False)


FLIGHTS: dict[str, Callable[[], tuple[Config, Simulation | None]]] = {
    "steps": lambda: (_demo(3.0), None),
    "thesis": lambda: (thesis_config(3.0), None),
    "cage": _cage,
    "commands": lambda: (
        commanded(
            _demo(3.5),
            {"at": 0.5, "slew": 0.15},
            {"at": 1.5, "mode": "hold"},
            {"at": 2.2, "mode": "detumble"},
            {"at": 3.0, "mode": "safe"},
            **IMPATIENT,
        ),
        None,
    ),
    "blind": lambda: (
        commanded(_demo(4.0), **IMPATIENT),
        _demo_with(("imu: silent", 0.8, 0.3), ("imu: garbage", 1.4, 0.3), ("imu: off", 2.0, 1.6)),
    ),
    "doubtful": lambda: (
        _demo(4.0),
        _demo_with(
            ("imu: wrong (angle=0.3, rate=0.4)", 0.7, 0.3),
            ("imu: bits (chance=0.002)", 1.3, 0.4),
            ("imu: cut (chance=0.3)", 2.0, 0.4),
            ("imu: slow (n=3)", 2.6, 0.3),
            ("imu: delayed (delay=0.2)", 3.1, 0.3),
            ("magnetometer: false (field=1e-4)", 3.6, 0.3),
        ),
    ),
    "coils": lambda: (
        _demo(4.0),
        _demo_with(
            ("pwm: stuck", 0.6, 0.3),
            ("bus: nack (chance=0.6)", 1.2, 0.4),
            ("monitor: wrong (gain=2)", 1.8, 0.4),
            ("bus: off", 2.4, 0.2),
            ("pwm: delayed (delay=0.1)", 2.9, 0.4),
            ("monitor: stuck", 3.4, 0.4),
        ),
    ),
    "detumbling": lambda: (_orbit_config(2.5), _orbit_world(0.1745)),
    "navigation": lambda: (
        configuration.replace(
            _orbit_config(4.5),
            detumble=configuration.replace(_orbit_config(4.5).detumble, low_rate=0.0175, low_for=0.5),
        ),
        _orbit_world(0.00524),
    ),
    "receivers": lambda: (
        _orbit_config(4.0),
        _orbit_world(
            0.02,
            ("gps: bits (chance=0.003)", 1.0, 1.0),
            ("gps: false (distance=5e4)", 2.0, 1.0),
            ("strings: wrong (gain=0.5)", 1.0, 1.5),
            ("strings: garbage", 2.5, 1.0),
            ("gps: silent", 3.0, 0.8),
        ),
    ),
}
"""Functions that return the configuration and the world of a flight, by the name of the flight.

If the world is None, the world of the demonstration is used.
"""


def flown(name: str, folder: Path) -> Run:
    """Run a recorded flight again, and return its log."""
    config, section = FLIGHTS[name]()
    return fly(config, folder, section=section)


def unlike_record(name: str, session_folder: Path) -> list[str]:
    """Return the differences of a flight from its record. The flight runs once per test session."""
    folder = session_folder / "recorded_flights"
    folder.mkdir(exist_ok=True)
    found = made_once(folder, name, lambda: record_of(flown(name, folder / name)))
    return differences(recorded(name), found)


def main() -> None:
    """Write the record of all flights."""
    with tempfile.TemporaryDirectory() as folder:
        made = {name: record_of(flown(name, Path(folder) / name)) for name in FLIGHTS}
    lines = [
        f" {json.dumps(name)}: {{\n"
        + ",\n".join(f"  {json.dumps(packet)}: {json.dumps(fields)}" for packet, fields in record.items())
        + "\n }"
        for name, record in made.items()
    ]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    sys.stdout.write(f"wrote {RECORD}\n")


if __name__ == "__main__":
    main()
