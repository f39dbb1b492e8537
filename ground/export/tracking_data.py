"""Tracks of objects as a CCSDS Tracking Data Message (503.0-B-2), in keyword = value notation.

One segment an object: right ascension and declination as measured in each frame that shows it, in ICRS at
mid-exposure, as stars at rest there would be seen: the camera's aberration is taken off, the object's light
time is not. The message has no keyword for a standard deviation, neither of angles nor of MAG: comments give
them. A frame's MAG is the mean of the last sightings.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError

_ARCSECONDS = math.degrees(3600.0)
ORIGINATOR = "KNIGHTCUBE"
_SECOND_NS = 1_000_000_000


def write_tracking_data(run: Run, path: Path, now: datetime | None = None) -> list[Path]:
    """Write the measured tracks of a run to `path`; return it in a list.

    `now` is the date of the message. Raises UsageError when no object was tracked, or `path` not writable.
    """
    tracks = run["track"]
    measured = tracks[np.all(np.isfinite(tracks["measured"]), axis=1)] if len(tracks) else tracks
    if not len(measured) or not len(run["run"]):
        raise UsageError(f"{run.folder}: no object was tracked; `camera: {{objects: {{}}}}` looks for them")
    start_ns = int(run["run"]["utc_ns"][-1])
    lines = [
        "CCSDS_TDM_VERS = 2.0",
        f"CREATION_DATE = {ccsds_date(round((now or datetime.now(UTC)).timestamp() * 1e9))}",
        f"ORIGINATOR = {ORIGINATOR}",
    ]
    for number in sorted(set(measured["number"].tolist())):
        lines += _segment(number, measured[measured["number"] == number], start_ns)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="ascii")
    except OSError as error:
        raise UsageError(f"{path}: no message can be written there: {error.strerror or error}") from error
    return [path]


def _segment(number: int, track: PacketArray, start_ns: int) -> list[str]:
    """Return the lines of one object's segment."""
    dates = [ccsds_date(start_ns + int(time)) for time in track["middle_ns"]]
    sigma = track["measured_sigma"] * _ARCSECONDS
    lines = [
        "",
        "META_START",
        f"COMMENT Standard deviation of each angle on the sky {np.median(sigma):.2f} arcsec in the median,",
        f"COMMENT {sigma.min():.2f} to {sigma.max():.2f} arcsec, the attitude's included.",
        *_of_magnitudes(track["magnitude_sigma"]),
        "COMMENT Stellar aberration of the camera removed, light time not.",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {dates[0]}",
        f"STOP_TIME = {dates[-1]}",
        f"PARTICIPANT_1 = {ORIGINATOR}",
        f"PARTICIPANT_2 = OBJECT-{number}",
        "MODE = SEQUENTIAL",
        "PATH = 2,1",
        "TIMETAG_REF = RECEIVE",
        "ANGLE_TYPE = RADEC",
        "REFERENCE_FRAME = ICRF",
        "META_STOP",
        "",
        "DATA_START",
    ]
    for date, (x, y, z), magnitude in zip(dates, track["measured"], track["magnitude"], strict=True):
        right_ascension = math.degrees(math.atan2(y, x)) % 360.0
        declination = math.degrees(math.atan2(z, math.hypot(x, y)))
        lines += [f"ANGLE_1 = {date} {right_ascension:.8f}", f"ANGLE_2 = {date} {declination:.8f}"]
        if math.isfinite(magnitude):
            lines.append(f"MAG = {date} {magnitude:.3f}")
    return [*lines, "DATA_STOP"]


def _of_magnitudes(sigma: FloatArray) -> list[str]:
    """Return the comment on MAG, of standard deviations (n,); none where none is known."""
    known = sigma[np.isfinite(sigma)]
    if not len(known):
        return []
    return [
        f"COMMENT Standard deviation of MAG {np.median(known):.3f} in the median, {known.max():.3f} at most:",
        "COMMENT the scatter of the sightings; what colours of the stars shift all by is not in it.",
    ]


def ccsds_date(utc_ns: int) -> str:
    """Return a time in ns since 1970 as CCSDS writes it, to the microsecond."""
    seconds, rest = divmod(utc_ns, _SECOND_NS)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest // 1000:06d}"
