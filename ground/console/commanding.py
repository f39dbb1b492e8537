"""Commands out of the page's forms: values by the command table, sent, and what became of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from flight.app.run import utc_ns
from flight.link import commands
from flight.link.commands import LAYOUTS, LOAD_PARAMETERS, CommandError
from flight.link.process import directives
from flight.link.telemetry.definitions import PARAMETER_FIELDS as PARAMETERS
from flight.link.telemetry.definitions import Field, crc_of
from flight.link.telemetry.packets import Layout, Packer, TelemetryError
from ground.commands.command import exchange
from ground.console.instant import values
from ground.telemetry import decode
from knightcube.errors import FlightError, UsageError

Object = dict[str, Any]
Send = Callable[[bytes], Object]
"""Sends a command packet and returns what became of it: `obeyed`, `text`. Raises FlightError."""
_TIMEOUT_S = 3.0


def by_socket(to: str) -> Send:
    """Return what sends to a flight's own socket, or to its HOST:PORT."""

    def send(packet: bytes) -> Object:
        answers = decode(exchange(to, packet, _TIMEOUT_S))["command"]
        if not len(answers):
            raise FlightError(f"{to}: the answer holds no report of the command")
        return values(answers[-1])

    return send


class Commanding:
    """Packs what the page's forms hold; `send` is None where this console only looks."""

    def __init__(self, send: Send | None, layouts: Mapping[str, Layout] = LAYOUTS) -> None:
        """`layouts` are the commands that `send` takes: by a link also those of the link itself."""
        self._send = send
        self.layouts = layouts
        self._packer = Packer(dict(layouts))

    @property
    def possible(self) -> bool:
        """Whether there is a way to the flight."""
        return self._send is not None

    def words(self, name: str, given: Object) -> str:
        """Return a command in words, for its confirmation. Raises UsageError for values that are none."""
        return _words(self._pack(name, given))

    def obey(self, name: str, given: Object) -> Object:
        """Send a command; return the flight's answer. Raises UsageError for values, else FlightError."""
        if self._send is None:
            raise UsageError("this console only looks: start it with --to or --link to command")
        return self._send(self._pack(name, given))

    def _pack(self, name: str, given: Object) -> bytes:
        if name not in self.layouts:
            raise UsageError(f"{name}: no such command: {', '.join(self.layouts)}")
        packet = self.layouts[name].packet
        unknown = sorted(set(given) - {field.name for field in packet.fields})
        if unknown:
            raise UsageError(f"{name}: no such value: {', '.join(unknown)}")
        if name == LOAD_PARAMETERS.name and not given.get("crc"):
            given = {**given, "crc": _crc(given)}
        fields = {field.name: _value(name, field, given.get(field.name)) for field in packet.fields}
        try:
            data = self._packer.pack(packet, utc_ns(), fields)
            _words(data)
        except (TelemetryError, CommandError) as error:
            raise UsageError(str(error)) from error
        return data


def _words(data: bytes) -> str:
    """Return the words of a command's packet. Raises CommandError for values that are none."""
    directive = directives.unpack(data)
    return commands.unpack(data).text if directive is None else str(directive)


def _crc(given: Object) -> int:
    """Return the CRC of the parameters in a form, which no operator reckons by hand."""
    return crc_of([float(_value(LOAD_PARAMETERS.name, field, given.get(field.name))) for field in PARAMETERS])


def _value(name: str, field: Field, given: Any) -> Any:
    """Return a field's value; empty numbers are NaN where the field can hold that. Raises UsageError."""
    if field.count > 1:
        items = list(given) if isinstance(given, list) else [given] if given is not None else []
        return [_number(name, field, item) for item in [*items, *[None] * field.count][: field.count]]
    return str(given or "") if field.kind.startswith("S") else _number(name, field, given)


def _number(name: str, field: Field, given: Any) -> float | int:
    real = field.kind.startswith("f")
    if given is None or given == "":
        if real:
            return math.nan
        raise UsageError(f"{name}: {field.name} is missing: {field.meaning}")
    try:
        return float(given) if real else int(given)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: {field.name} = {given!r} is no number: {field.meaning}") from error
