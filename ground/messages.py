"""Tracked objects, the observer's orbit and the attitude as CCSDS messages.

Tracking Data Messages (503.0-B-2), Orbit Parameter and Ephemeris Messages (502.0-B-3), and Attitude Ephemeris
Messages (504.0-B-1) are in keyword = value notation, or in XML (505.0-B).
The initial orbits of tracked objects are determined from the sightings and the satellite's positions in the
`track` packets.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH, earth_velocity
from knightcube.errors import UsageError, reason_of
from knightcube.gnc.first_orbit import (
    MINIMUM_SIGHTINGS,
    ArcError,
    Bearings,
    FirstOrbit,
    first_orbit,
    smoothed,
)

_ARCSECONDS = math.degrees(3600.0)
ORIGINATOR = "KNIGHTCUBE"
_OF_SATELLITE = (f"OBJECT_NAME = {ORIGINATOR}", "OBJECT_ID = UNKNOWN", "CENTER_NAME = EARTH")
_SECOND_NS = 1_000_000_000


def write_tracking_data(run: Run, path: Path, as_xml: bool = False) -> list[Path]:
    """Write the measured tracks of a run to the file `path`, and return the written files.

    Each object has one segment, which contains the measured right ascension and declination (ICRS) at
    mid-exposure of each frame. Stellar aberration due to the camera's velocity is corrected, but light time
    is not. Standard deviations are written as comments, because the message format has no keyword for them.
    The keyword MAG gives the mean magnitude of the last sightings. If the satellite's own orbit was known, an
    Orbit Ephemeris Message with the positions of the camera at the sightings is written beside `path`, with
    the suffix `.oem`. Raises UsageError if no object was tracked, or if `path` has the suffix `.oem` or
    cannot be written.
    """
    tracks = run["track"]
    measured = tracks[np.all(np.isfinite(tracks["measured"]), axis=1)] if len(tracks) else tracks
    if not len(measured):
        raise _no_object(run)
    if path.suffix == ".oem":
        raise UsageError(f"{path}: the suffix .oem is for the orbit beside the tracks: give another suffix")
    start_ns = _start_ns(run)
    lines = _header("CCSDS_TDM_VERS = 2.0")
    for number in sorted(set(measured["number"].tolist())):
        lines += _segment(number, measured[measured["number"] == number], start_ns)
    _write(path, lines, as_xml)
    _, first = np.unique(measured["middle_ns"], return_index=True)
    placed = measured[first]
    placed = placed[np.isfinite(np.hstack([placed["place"], placed["velocity"]])).all(axis=1)]
    if len(placed) < 2:  # an ephemeris needs at least two states
        return [path]
    observer = path.with_suffix(".oem")
    _write(observer, _ephemeris(placed, start_ns), as_xml)
    return [path, observer]


def _ephemeris(placed: PacketArray, start_ns: int) -> list[str]:
    """Return the lines of an Orbit Ephemeris Message of the camera, from `track` packets in order of time."""
    dates = [ccsds_date(start_ns + int(time)) for time in placed["middle_ns"]]
    states = 1e-3 * np.hstack([placed["place"], placed["velocity"]])
    return [
        *_header("CCSDS_OEM_VERS = 2.0"),
        "",
        "META_START",
        "COMMENT Orbit as the satellite knew it at each sighting; standard deviation per axis "
        f"{1e-3 * float(np.max(placed['place_sigma'])):.3f} km or less.",
        *_OF_SATELLITE,
        "REF_FRAME = ICRF",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {dates[0]}",
        f"STOP_TIME = {dates[-1]}",
        "META_STOP",
        "",
        *(
            f"{date} " + " ".join(f"{value:.9f}" for value in state)
            for date, state in zip(dates, states, strict=True)
        ),
    ]


def write_attitudes(run: Run, path: Path, as_xml: bool = False) -> list[Path]:
    """Write the estimated attitudes of a satellite as an Attitude Ephemeris Message, and return its file.

    The quaternions rotate from ICRS into the body frame. Raises UsageError for a run without attitudes in
    ICRS, such as a testbed's, and if `path` cannot be written.
    """
    packets = run["attitude"]
    packets = packets[np.isfinite(packets["quaternion"]).all(axis=1)]
    # Readers of the message refuse two attitudes with the same time.
    packets = packets[np.unique(packets["time_ns"], return_index=True)[1]]
    if not len(packets) or not len(run["navigation"]):
        raise UsageError(
            f"{run.folder}: has no attitude with respect to the stars: give the run of a satellite"
        )
    start_ns = _start_ns(run)
    dates = [ccsds_date(start_ns + int(time)) for time in packets["time_ns"]]
    lines = [
        *_header("CCSDS_AEM_VERS = 1.0"),
        "",
        "META_START",
        "COMMENT Largest standard deviation about a body axis "
        f"{math.degrees(float(np.nanmax(packets['angle_sigma']))):.4f} deg.",
        *_OF_SATELLITE,
        "REF_FRAME_A = ICRF",
        "REF_FRAME_B = SC_BODY_1",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {dates[0]}",
        f"STOP_TIME = {dates[-1]}",
        "ATTITUDE_TYPE = QUATERNION",
        "QUATERNION_TYPE = LAST",
        "META_STOP",
        "",
        "DATA_START",
        *(
            f"{date} " + " ".join(f"{value:.10f}" for value in quaternion)
            for date, quaternion in zip(dates, packets["quaternion"], strict=True)
        ),
        "DATA_STOP",
    ]
    _write(path, lines, as_xml)
    return [path]


def _header(version: str) -> list[str]:
    now = ccsds_date(round(datetime.now(UTC).timestamp() * 1e9))
    return [version, f"CREATION_DATE = {now}", f"ORIGINATOR = {ORIGINATOR}"]


def _write(path: Path, lines: list[str], as_xml: bool) -> None:
    text = xml_of(lines) if as_xml else "\n".join(lines)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="ascii")
    except OSError as error:
        raise UsageError(f"{path}: the message cannot be written: {reason_of(error)}") from error


_AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")


def xml_of(lines: list[str]) -> str:
    """Return the message of keyword = value `lines` in XML (CCSDS 505.0-B, Navigation Data Messages)."""
    name, version = _keyword(lines[0])
    kind = name.split("_")[1].lower()  # tdm, oem, opm or aem
    root = ET.Element(kind, id=name, version=version)
    place, body = ET.SubElement(root, "header"), ET.SubElement(root, "body")
    segment = data = root  # placeholder until the first segment begins
    for line in filter(None, lines[1:]):
        key, value = _keyword(line)
        if line == "META_START" or (kind == "opm" and key == "OBJECT_NAME"):
            segment = ET.SubElement(body, "segment")
            place = ET.SubElement(segment, "metadata")
        if line == "META_STOP" or (kind == "opm" and key == "EPOCH"):
            place = data = ET.SubElement(segment, "data")
        if kind == "opm" and key in {"EPOCH", "COV_REF_FRAME"}:
            place = ET.SubElement(data, "stateVector" if key == "EPOCH" else "covarianceMatrix")
        if key == "COMMENT":
            _element(place, key, line.removeprefix("COMMENT "))
        elif kind == "tdm" and place is data and value:
            date, number = value.split()
            observation = ET.SubElement(place, "observation")
            _element(observation, "EPOCH", date)
            _element(observation, key, number)
        elif value:
            number, _, unit = value.partition(" [")
            _element(place, key, number, **({"units": unit.rstrip("]")} if unit else {}))
        elif place is data and len(line.split()) > 1:
            _add_state(place, kind, *line.split())
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")


def _keyword(line: str) -> tuple[str, str]:
    """Return the keyword of a line, and its value or an empty text."""
    key, found, value = line.partition(" = ")
    return (line.split(maxsplit=1)[0], "") if not found or line.startswith("COMMENT") else (key, value)


def _element(place: ET.Element, name: str, text: str, **attributes: str) -> None:
    ET.SubElement(place, name, attributes).text = text


def _add_state(place: ET.Element, kind: str, date: str, *numbers: str) -> None:
    """Add one line of an ephemeris: position and velocity, or a quaternion (scalar last)."""
    names: tuple[str, ...] = _AXES
    if kind == "aem":
        place = ET.SubElement(ET.SubElement(place, "attitudeState"), "quaternionState")
        names = ("Q1", "Q2", "Q3", "QC")
    else:
        place = ET.SubElement(place, "stateVector")
    _element(place, "EPOCH", date)
    if kind == "aem":
        place = ET.SubElement(place, "quaternion")
    for name, number in zip(names, numbers, strict=True):
        _element(place, name, number)


def _segment(number: int, track: PacketArray, start_ns: int) -> list[str]:
    dates = [ccsds_date(start_ns + int(time)) for time in track["middle_ns"]]
    sigma = track["measured_sigma"] * _ARCSECONDS
    lines = [
        "",
        "META_START",
        f"COMMENT Standard deviation of each angle on the sky {np.median(sigma):.2f} arcsec in the median,",
        f"COMMENT and {sigma.min():.2f} to {sigma.max():.2f} arcsec in all, including the attitude error.",
        *_of_magnitudes(track["magnitude_sigma"]),
        "COMMENT Stellar aberration of the camera is corrected, light time is not.",
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
    """Return the comment lines on the standard deviations (n,) of MAG; no line if all are unknown."""
    known = sigma[np.isfinite(sigma)]
    if not len(known):
        return []
    return [
        f"COMMENT Standard deviation of MAG {np.median(known):.3f} in the median, {known.max():.3f} at most:",
        "COMMENT the scatter of the sightings, without the common error due to star colours.",
    ]


def ccsds_date(utc_ns: int) -> str:
    """Return a time in ns since 1970 in CCSDS format, with microseconds."""
    seconds, rest = divmod(utc_ns, _SECOND_NS)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest // 1000:06d}"


@dataclass(frozen=True, slots=True, eq=False)
class ObjectOrbit:
    """Initial orbit of a tracked object.

    Attributes:
        number: number of the object in the flight.
        sightings: number of sightings.
        span: time between the first and the last sighting, s.
        utc_ns: UTC epoch of the orbit, ns since 1970, or None without an orbit.
        orbit: initial orbit, or None if the sightings do not determine an orbit.
        reason: reason why `orbit` is None, or an empty text.
    """

    number: int
    sightings: int
    span: float
    utc_ns: int | None
    orbit: FirstOrbit | None
    reason: str

    @property
    def date(self) -> datetime:
        """Epoch of the orbit."""
        assert self.utc_ns is not None
        return datetime.fromtimestamp(self.utc_ns * 1e-9, UTC)


def orbits_of(run: Run) -> list[ObjectOrbit]:
    """Return the initial orbit of each tracked object. Raises UsageError for a run without objects."""
    tracks = run["track"]
    if not len(tracks):
        raise _no_object(run)
    start_ns = _start_ns(run)
    return [_orbit(number, tracks, start_ns) for number in sorted(set(tracks["number"].tolist()))]


def _start_ns(run: Run) -> int:
    """Return the UTC of mission time zero, ns since 1970. Raises UsageError if the log lacks it."""
    known = run["run"]["utc_ns"][run["run"]["utc_ns"] > 0]
    if not len(known):
        raise UsageError(f"{run.folder}: the log has no packet `run` with the UTC of the flight")
    return int(known[-1])


def _no_object(run: Run) -> UsageError:
    return UsageError(
        f"{run.folder}: no object was tracked; `camera: {{objects: {{}}}}` enables the tracking"
    )


def _orbit(number: int, tracks: PacketArray, start_ns: int) -> ObjectOrbit:
    track = tracks[tracks["number"] == number]
    seen = track[np.isfinite(track["measured"]).all(axis=1)]
    times = seen["middle_ns"] * 1e-9
    span = float(times[-1] - times[0]) if len(times) else 0.0
    found = ObjectOrbit(number, len(seen), span, None, None, "")
    if seen["relative"].any():
        # Without identified stars, all directions share the error of the attitude, so no orbit is fitted.
        return replace(found, reason="the directions were measured without identified stars")
    placed = seen[np.isfinite(seen["place"]).all(axis=1)]
    if len(placed) < MINIMUM_SIGHTINGS:
        sightings = f"{len(placed)} sightings with the satellite's position"
        return replace(found, reason=f"{sightings}: {MINIMUM_SIGHTINGS} or more are needed")
    times = placed["middle_ns"] * 1e-9
    middle = len(times) // 2
    measured = np.hstack([placed["place"], placed["velocity"]])
    observer, own = smoothed(times, measured, placed["place_sigma"], middle)
    utc_ns = start_ns + int(placed["middle_ns"][middle])
    date = float(terrestrial_time(UNIX_EPOCH + utc_ns * 1e-9 / DAY))
    bearings = Bearings(times, placed["measured"], placed["measured_sigma"], observer, earth_velocity(date))
    try:
        orbit = first_orbit(bearings)
    except ArcError as error:
        return replace(found, reason=str(error))
    # An error of the satellite's own orbit shifts the object's orbit by the same amount.
    return replace(found, utc_ns=utc_ns, orbit=replace(orbit, covariance=orbit.covariance + own))


def write_orbit_messages(found: list[ObjectOrbit], folder: Path, as_xml: bool = False) -> list[Path]:
    """Write one Orbit Parameter Message per initial orbit into a folder, and return the files.

    Raises UsageError if the folder cannot be written.
    """
    paths = {folder / f"object-{item.number}.opm": item for item in found if item.orbit is not None}
    for path, item in paths.items():
        _write(path, _message(item), as_xml)
    return list(paths)


def _message(item: ObjectOrbit) -> list[str]:
    orbit = item.orbit
    assert orbit is not None
    assert item.utc_ns is not None
    low, high = (1e-3 * end for end in orbit.interval)
    each = zip(_AXES, orbit.state, ["km"] * 3 + ["km/s"] * 3, strict=True)
    state = [f"{axis} = {1e-3 * value:.9f} [{unit}]" for axis, value, unit in each]
    covariance = []
    for row, first in enumerate(_AXES):
        for column, second in enumerate(_AXES[: row + 1]):
            unit = ("km**2", "km**2/s", "km**2/s**2")[(row > 2) + (column > 2)]
            covariance.append(f"C{first}_{second} = {1e-6 * orbit.covariance[row, column]:.9e} [{unit}]")
    version, *header = _header("CCSDS_OPM_VERS = 3.0")
    return [
        version,
        f"COMMENT Initial orbit from angles only: {item.sightings} sightings in {item.span:.0f} s.",
        f"COMMENT Distance {1e-3 * orbit.distance:.1f} km at the epoch, "
        f"{low:.1f} to {high:.1f} km at 95 % confidence.",
        *header,
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
