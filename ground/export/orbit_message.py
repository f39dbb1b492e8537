"""An object's orbit as a CCSDS Orbit Parameter Message (502.0-B-3), in keyword = value notation."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from ground.export.tracking_data import ORIGINATOR, ccsds_date
from ground.orbits.from_run import ObjectOrbit
from knightcube.errors import UsageError

_AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")


def write_orbit_messages(found: list[ObjectOrbit], folder: Path, now: datetime | None = None) -> list[Path]:
    """Write one message for each orbit into a folder; return the files. Raises UsageError.

    `now` is the date of the messages.
    """
    paths = []
    for item in found:
        if item.orbit is None:
            continue
        path = folder / f"object-{item.number}.opm"
        lines = _message(item, now or datetime.now(UTC))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text("\n".join(lines) + "\n", encoding="ascii")
        except OSError as error:
            raise UsageError(f"{path}: no message can be written there: {error.strerror or error}") from error
        paths.append(path)
    return paths


def _message(item: ObjectOrbit, now: datetime) -> list[str]:
    orbit = item.orbit
    assert orbit is not None
    assert item.utc_ns is not None
    low, high = (1e-3 * end for end in orbit.interval)
    units = ["km"] * 3 + ["km/s"] * 3
    state = [
        f"{axis} = {1e-3 * value:.9f} [{unit}]"
        for axis, value, unit in zip(_AXES, orbit.state, units, strict=True)
    ]
    covariance = []
    for row, first in enumerate(_AXES):
        for column, second in enumerate(_AXES[: row + 1]):
            unit = ("km**2", "km**2/s", "km**2/s**2")[(row > 2) + (column > 2)]
            covariance.append(f"C{first}_{second} = {1e-6 * orbit.covariance[row, column]:.9e} [{unit}]")
    return [
        "CCSDS_OPM_VERS = 3.0",
        f"COMMENT First orbit by angles only: {item.sightings} sightings in {item.span:.0f} s.",
        f"COMMENT Distance {1e-3 * orbit.distance:.1f} km at the epoch, {low:.1f} to {high:.1f} km by 95 %.",
        f"CREATION_DATE = {ccsds_date(round(now.timestamp() * 1e9))}",
        f"ORIGINATOR = {ORIGINATOR}",
        f"OBJECT_NAME = OBJECT-{item.number}",
        "OBJECT_ID = UNKNOWN",
        "CENTER_NAME = EARTH",
        "REF_FRAME = ICRF",
        "TIME_SYSTEM = UTC",
        f"EPOCH = {ccsds_date(item.utc_ns)}",
        *state,
        "COV_REF_FRAME = ICRF",
        *covariance,
    ]
