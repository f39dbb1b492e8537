"""Table of the parameters that an operator can change in flight, all of them at once.

Each parameter has a key of the configuration, whose value is used until a table is loaded. `valid` is the
range that a command accepts; the bounds of the configuration's schema apply as well.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence

from flight.link.telemetry.form import Field


def _parameter(key: str, unit: str, low: float, high: float, meaning: str) -> Field:
    return Field(key.replace(".", "_", 1), "f8", unit, f"{key}: {meaning}", valid=(low, high))


FIELDS: tuple[Field, ...] = (
    _parameter("modes.arrived_angle", "rad", 1e-4, 0.5, "a slew has arrived within this angle"),
    _parameter("modes.arrived_rate", "rad/s", 1e-5, 0.5, "and below this rate"),
    _parameter("modes.arrived_for", "s", 0.1, 600.0, "for this time"),
    _parameter("modes.slew_limit", "s", 1.0, 1e5, "a slew that takes longer is late"),
    _parameter("modes.hold_error", "rad", 1e-3, math.pi, "a hold that is off by more is impossible"),
    _parameter("modes.hold_patience", "s", 0.1, 3600.0, "once it was for this time"),
    _parameter("modes.tumble_rate", "rad/s", 1e-3, 10.0, "a faster body is braked"),
    _parameter("modes.blind_limit", "s", 1.0, 1e5, "without an estimate for longer the mode is safe"),
    _parameter("modes.known_for", "s", 0.1, 3600.0, "attitude known for this time ends the acquisition"),
    _parameter("modes.lost_for", "s", 0.1, 3600.0, "attitude lost for this time begins it again"),
    _parameter("health.cpu_share", "-", 0.01, 64.0, "of one core: the control process takes more"),
    _parameter("health.memory", "B", 1e6, 1e12, "the flight processes take more memory"),
    _parameter("health.memory_slope", "B/h", 1e3, 1e12, "it grows faster"),
    _parameter("health.disk_free", "B", 1.0, 1e13, "the disk has less left"),
    _parameter("health.temperature", "degree C", -40.0, 150.0, "the board is warm beyond it"),
    _parameter("health.hottest", "degree C", -40.0, 150.0, "and too hot beyond it"),
)
"""Fields of the parameters, in their order in the packets."""

KEYS: tuple[str, ...] = tuple(field.name.replace("_", ".", 1) for field in FIELDS)
"""Keys of the parameters in a configuration, in the same order."""


def crc_of(values: Sequence[float]) -> int:
    """Return the CRC-32 of a table's values, as big-endian doubles in the order of `KEYS`."""
    return zlib.crc32(struct.pack(f">{len(FIELDS)}d", *values))


def problem_of(values: Mapping[str, float]) -> str:
    """Return the problem of a table (missing or unknown key, value out of range), else an empty text."""
    if lacking := [key for key in KEYS if key not in values]:
        return f"{lacking[0]} is missing: a table is loaded as a whole"
    if unknown := sorted(set(values) - set(KEYS)):
        return f"{unknown[0]} is no parameter: {', '.join(KEYS)}"
    for key, field in zip(KEYS, FIELDS, strict=True):
        low, high = field.valid or (-math.inf, math.inf)
        if not low <= values[key] <= high:  # NaN compares false
            return f"{key} = {values[key]:g} must lie within {low:g} to {high:g} {field.unit}"
    return ""
