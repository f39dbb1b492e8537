"""Reader of mean elements for SGP4 from files: two-line elements, and OMM in JSON, XML, KVN and CSV.

The Orbit Mean-Elements Message (OMM) is defined in CCSDS 502.0-B-3. CelesTrak and Space-Track publish OMMs
for satellites with numbers above 99999. Two-line elements can represent satellite numbers only up to 339999
(Alpha-5). Each OMM is converted to two-line elements. The rounding of the epoch to 1e-8 days shifts a
satellite by up to 3 m.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from xml.etree import ElementTree

from sgp4.api import WGS72, Satrec
from sgp4.exporter import export_tle

from knightcube.astro.earth.orbit_knowledge import (
    ANGLES,
    FASTEST_MOTION,
    LARGEST_DRAG,
    LOWEST_RADIUS,
    SLOWEST_MOTION,
    check_lines,
    perigee_radius,
)
from knightcube.errors import UsageError

_SGP4_EPOCH = datetime(1949, 12, 31, tzinfo=UTC)
_RESOLUTION = timedelta(microseconds=864)
"""Resolution of the epoch of two-line elements, 1e-8 days."""
_ANY_NUMBER, _LARGEST_NUMBER = 999_999_999, 339_999
"""Largest satellite number in an OMM, and in two-line elements. In two-line elements, 0 replaces a larger
number."""
_FIXED = {
    "CENTER_NAME": ("EARTH",),
    "REF_FRAME": ("TEME",),
    "TIME_SYSTEM": ("UTC",),
    "MEAN_ELEMENT_THEORY": ("SGP4", "SGP/SGP4"),
    "EPHEMERIS_TYPE": ("0", "2"),
}
"""Fields of an OMM that may be absent, and their accepted values."""
_INCLINATION, _NODE, _PERIGEE = ANGLES.values()
_NUMBERS: dict[str, tuple[float, float, str]] = {
    "MEAN_MOTION": (SLOWEST_MOTION, FASTEST_MOTION, " rev/day"),
    "ECCENTRICITY": (0.0, 0.999_999_9, ""),
    "INCLINATION": (0.0, _INCLINATION, " deg"),
    "RA_OF_ASC_NODE": (0.0, _NODE, " deg"),
    "ARG_OF_PERICENTER": (0.0, _PERIGEE, " deg"),
    "MEAN_ANOMALY": (0.0, 360.0, " deg"),
    "BSTAR": (-LARGEST_DRAG, LARGEST_DRAG, " per Earth radius"),
}
"""Bounds and unit of the numerical fields of an OMM, which are all required."""
_LEAST_DRAG = 1e-9
"""Smallest nonzero absolute value of B* that two-line elements can represent (one-digit exponent)."""
_YEARS = 1957, 2056
"""First and last year that two-line elements can represent."""


@dataclass(frozen=True, slots=True)
class NamedElements:
    """Name, satellite number and two-line elements of a satellite. The name may be empty."""

    name: str
    number: int
    lines: tuple[str, str]


def read_elements(text: str) -> list[NamedElements]:
    """Return the elements of all satellites in a text, whose format is recognised by its first characters.

    Raises UsageError for invalid elements, with line and columns of two-line elements, or the field of an
    OMM.
    """
    start = text.lstrip("\ufeff \t\r\n")
    first = start.partition("\n")[0]
    if start.startswith(("{", "[")):
        messages = _json(start)
    elif start.startswith("<"):
        messages = _xml(start)
    elif "=" in first or first.startswith("COMMENT"):
        messages = _kvn(start)
    elif "," in first and any(key in first for key in ("OBJECT_NAME", *_NUMBERS)):
        messages = _csv(start)
    else:
        return _two_lines(start)
    if not messages:
        raise UsageError("the file holds no OMM: download the elements of the satellite again")
    return [_converted(message, index) for index, message in enumerate(messages, 1)]


def _two_lines(text: str) -> list[NamedElements]:
    """Return the elements of all satellites in a file of two-line elements, with or without name lines."""
    lines = [line.rstrip() for line in text.splitlines() if line.strip()]
    found: list[NamedElements] = []
    name = ""
    while lines:
        line = lines.pop(0)
        if not line.startswith("1 "):
            if line.startswith("2 ") or name:
                raise UsageError(f"{line!r}: expected line 1 of a two-line element set, or an OMM")
            name = line.removeprefix("0 ").strip()
            continue
        second = lines.pop(0) if lines else ""
        check_lines(line, second)
        found.append(NamedElements(name, _alpha5(line[2:7]), (line, second)))
        name = ""
    if not found:
        raise UsageError(f"{name!r}: neither two-line elements nor an OMM in JSON, XML, KVN or CSV")
    return found


def _alpha5(text: str) -> int:
    """Return a satellite number from five columns, of which the first may be a letter (Alpha-5)."""
    if text[0].isalpha():
        return (10 + "ABCDEFGHJKLMNPQRSTUVWXYZ".index(text[0])) * 10_000 + int(text[1:])
    return int(text)


def _json(text: str) -> list[Mapping[str, object]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"this JSON cannot be read: {error}") from error
    messages = found if isinstance(found, list) else [found]
    for index, message in enumerate(messages, 1):
        if not isinstance(message, dict):
            raise UsageError(f"entry {index} of the JSON is not an object with the fields of an OMM")
    return messages


def _xml(text: str) -> list[Mapping[str, object]]:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise UsageError(f"this XML cannot be read: {error}") from error
    segments = [part for part in root.iter() if _local(part.tag) == "omm"]
    return [{_local(part.tag): part.text or "" for part in omm.iter() if len(part) == 0} for omm in segments]


def _csv(text: str) -> list[Mapping[str, object]]:
    try:
        return list(csv.DictReader(io.StringIO(text)))
    except csv.Error as error:
        raise UsageError(f"this CSV cannot be read: {error}") from error


def _local(tag: object) -> str:
    """Return the name of an XML tag without its namespace."""
    return str(tag).rpartition("}")[2]


def _kvn(text: str) -> list[Mapping[str, object]]:
    found: list[dict[str, object]] = []
    for number, line in enumerate(text.splitlines(), 1):
        key, equals, value = line.partition("=")
        key = key.strip()
        if not line.strip() or key.startswith("COMMENT"):
            continue
        if not equals:
            raise UsageError(f"line {number} of the OMM: {line.strip()!r} must have the form KEY = value")
        if key == "CCSDS_OMM_VERS" or not found:
            found.append({})
        # A unit in brackets may follow a value.
        found[-1][key] = re.sub(r"\s*\[[^\]]*\]\s*$", "", value).strip()
    return list(found)


def _converted(message: Mapping[str, object], index: int) -> NamedElements:
    """Return the elements of an OMM. Raises UsageError for a field with an invalid value."""
    name = _text(message, "OBJECT_NAME")
    where = f"OMM {index} ({name})" if name else f"OMM {index}"
    for key, accepted in _FIXED.items():
        value = _text(message, key).upper()
        if value and value not in accepted:
            raise UsageError(f"{where}: {key} is {value!r}, but must be {accepted[0]}")
    numbers = {key: _number(message, key, bounds, where) for key, bounds in _NUMBERS.items()}
    low = perigee_radius(numbers["MEAN_MOTION"], numbers["ECCENTRICITY"])
    if low < LOWEST_RADIUS:
        raise UsageError(
            f"{where}: ECCENTRICITY {numbers['ECCENTRICITY']:g} and MEAN_MOTION {numbers['MEAN_MOTION']:g} "
            f"give a perigee within the Earth, {1e-3 * low:.0f} km from its centre"
        )
    number = round(_number(message, "NORAD_CAT_ID", (0.0, _ANY_NUMBER, ""), where))
    lines = _lines(message, numbers, number, where)
    check_lines(*lines)
    return NamedElements(name, number, lines)


def _lines(
    message: Mapping[str, object], numbers: Mapping[str, float], number: int, where: str
) -> tuple[str, str]:
    made = Satrec()
    epoch = _epoch(_text(message, "EPOCH"), where)
    degree = math.pi / 180.0
    per_minute = 2.0 * math.pi / 1440.0
    made.sgp4init(
        WGS72,
        "i",
        number if number <= _LARGEST_NUMBER else 0,
        (epoch - _SGP4_EPOCH) / timedelta(days=1),
        numbers["BSTAR"] if abs(numbers["BSTAR"]) >= _LEAST_DRAG else 0.0,
        0.0,
        0.0,
        numbers["ECCENTRICITY"],
        numbers["ARG_OF_PERICENTER"] * degree,
        numbers["INCLINATION"] * degree,
        numbers["MEAN_ANOMALY"] * degree,
        numbers["MEAN_MOTION"] * per_minute,
        numbers["RA_OF_ASC_NODE"] * degree,
    )
    made.classification = "U"
    identifier = re.fullmatch(r"\d\d(\d\d)-(\d{3}[A-Z]{1,3})", _text(message, "OBJECT_ID"))
    made.intldesg = "".join(identifier.groups()) if identifier else ""
    first, second = export_tle(made)
    return first, second


def _epoch(text: str, where: str) -> datetime:
    """Return the time of an epoch that is given as a calendar date or as a year with a day of the year.

    The time is rounded to the resolution of two-line elements. Otherwise, an epoch just before the end of a
    year would be written as a day after the last day of that year.
    """
    plain = text.strip().removesuffix("Z")
    day_of_year = re.fullmatch(r"(\d{4})-(\d{3})(T.*)", plain)
    try:
        if day_of_year:
            year, day, time = day_of_year.groups()
            found = datetime.fromisoformat(f"{year}-01-01{time}") + timedelta(days=int(day) - 1)
            if found.year != int(year):
                raise ValueError(day)
        else:
            found = datetime.fromisoformat(plain)
        utc = found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)
        utc = _SGP4_EPOCH + round((utc - _SGP4_EPOCH) / _RESOLUTION) * _RESOLUTION
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{where}: EPOCH is {text!r}, but must have the form 2026-11-16T12:25:40.104192"
        ) from error
    if not _YEARS[0] <= utc.year <= _YEARS[1]:
        raise UsageError(f"{where}: EPOCH {text!r} must be in the years {_YEARS[0]} to {_YEARS[1]}")
    return utc


def _text(message: Mapping[str, object], key: str) -> str:
    value = message.get(key)
    return "" if value is None else str(value).strip()


def _number(message: Mapping[str, object], key: str, bounds: tuple[float, float, str], where: str) -> float:
    low, high, unit = bounds
    text = _text(message, key)
    if not text:
        raise UsageError(f"{where}: the field {key} is missing")
    try:
        value = float(text)
    except ValueError as error:
        raise UsageError(f"{where}: {key} is {text!r}, which is not a number") from error
    if not low <= value <= high:
        raise UsageError(f"{where}: {key} {text} must be from {low:g} to {high:g}{unit}")
    return value
