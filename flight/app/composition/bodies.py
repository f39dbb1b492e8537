"""The bodies that a configuration can name: those of `BODIES`, or a third party's as `module:object`."""

from __future__ import annotations

import importlib

from flight.loop.body import BodyKind
from flight.schema.errors import ConfigError
from flight.schema.sections import Config

BODIES = {"testbed": "flight.bodies.testbed.body:TESTBED", "orbit": "flight.bodies.orbit.body:ORBIT"}


def body_kind(config: Config) -> BodyKind:
    """Return the configured kind of body. Raises ConfigError."""
    place = BODIES.get(config.body, config.body)
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        known = ", ".join(BODIES)
        raise ConfigError("body", f"is {config.body!r}: name one of {known}, or `module:object`")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError("body", f"is {config.body!r}, which cannot be had: {error}") from error
    if not isinstance(kind, BodyKind):
        raise ConfigError("body", f"is {config.body!r}: that is no BodyKind of flight.loop.body")
    return kind
