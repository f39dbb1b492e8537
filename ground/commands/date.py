"""A date on the command line."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from datetime import UTC, datetime

from knightcube.astro.earth.sun import DAY, J2000


@dataclass(frozen=True, slots=True)
class Date:
    """An instant, as the Julian year of a catalogue's epoch and as a Julian date."""

    year: float
    julian_date: float


def date(text: str) -> Date:
    """Return the date that an argument gives, UTC where it names no zone. Raises ArgumentTypeError."""
    try:
        instant = datetime.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: give a date such as 2026-11-21T20:15:00") from error
    instant = instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant
    julian_date = J2000 + (instant - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / DAY
    return Date(2000.0 + (julian_date - J2000) / 365.25, julian_date)
