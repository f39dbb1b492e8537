"""A date on the command line."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime


def date(text: str) -> datetime:
    """Return the instant that an argument gives, UTC if it has no time zone. Raises ArgumentTypeError."""
    try:
        instant = datetime.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: give a date such as 2026-11-21T20:15:00") from error
    return instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant
