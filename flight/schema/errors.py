"""The exception for a configuration that is refused."""

from __future__ import annotations

from knightcube.errors import InputError


class ConfigError(InputError):
    """A configuration that cannot be flown; `where` is the file and, if known, the line of the value."""


class UnreadConfigError(ConfigError):
    """A configuration that could not be read whole, or is not the accepted one: its values are not judged."""
