"""Why something is no command."""

from __future__ import annotations

from knightcube.errors import FlightError


class CommandError(FlightError):
    """Bytes or values that are no command; says why."""


class MalformedError(CommandError):
    """Bytes that are no packet of a command: never answered, so that two flights cannot answer each other."""
