"""The parameters: the table that flies, replaced as a whole by a command, kept for the next boots.

A table is checked before it is flown: its ranges, then the schema's bounds. Where a flight ends uncleanly
within `PROVEN_NS` of a load, the next boot flies the table before (`flight.loop.state.history`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from flight.link import events
from flight.link.parameters import FIELDS, KEYS, crc_of, problem_of
from flight.link.telemetry.definitions import PARAMETERS
from flight.loop.services import Services
from flight.loop.state.content import KeptTable
from flight.loop.state.keeper import StateKeeper
from flight.schema.sections import Config, Health, Modes

S = TypeVar("S", Modes, Health)

PROVEN_NS = 60_000_000_000
"""Flight time after which a loaded table stays, however the flight ends."""


@dataclass(frozen=True, slots=True)
class Adopters:
    """Who goes on with other bounds of the modes and of health."""

    modes: Sequence[Callable[[Modes], None]]
    health: Callable[[Health], None]


class Parameters:
    """Owns the table of parameters that flies."""

    def __init__(
        self, config: Config, adopters: Adopters, keeper: StateKeeper | None, services: Services
    ) -> None:
        """Start with the configuration's values, or with a table that the `keeper` has."""
        self._config = config
        self._adopters = adopters
        self._keeper = keeper
        self._recorder = services.recorder
        self._events = services.events
        self._configured = {key: float(_value(config, key)) for key in KEYS}
        self._values: Mapping[str, float] = self._configured
        self._table = KeptTable() if keeper is None else keeper.table
        self._loaded_ns = 0

    def begin(self, now_ns: int) -> None:
        """Fly the kept table, where this version and configuration can; report the table that flies."""
        self._loaded_ns = now_ns
        if kept := self._table.values:
            # Of another version of the software a key may be gone or new: there the configuration holds.
            table = {key: kept.get(key, value) for key, value in self._configured.items()}
            if problem := problem_of(table) or self._adopt(table):
                self._table = msgspec.structs.replace(self._table, values={}, proven=True)
                self._events.report(events.PARAMETERS_LEFT, now_ns, problem)
        self.dump(now_ns)

    def run(self, now_ns: int) -> None:
        """Trust a table that has flown long enough."""
        if not self._table.proven and now_ns - self._loaded_ns >= PROVEN_NS:
            self._keep(msgspec.structs.replace(self._table, proven=True))

    def load(self, values: Mapping[str, float], replaced: int, now_ns: int) -> str:
        """Fly another table in place of the one whose CRC is `replaced`; return why not, empty when done."""
        if replaced != self._crc:
            return f"the table that flies is {self._crc:08x}, not {replaced:08x}: dump it and look again"
        before = self._table.values if self._table.proven else self._table.before
        if problem := problem_of(values) or self._adopt(values):
            return problem
        self._loaded_ns = now_ns
        self._keep(
            KeptTable(values=dict(values), before=dict(before), proven=False, loads=self._table.loads + 1)
        )
        self.dump(now_ns)
        return ""

    def dump(self, now_ns: int) -> None:
        """Record the table."""
        named = {field.name: self._values[key] for field, key in zip(FIELDS, KEYS, strict=True)}
        fields: dict[str, Any] = {
            "loads": self._table.loads,
            "crc": self._crc,
            "table": int(self._values is not self._configured),
            "kept": int(self._keeper is not None),
        }
        self._recorder.record(PARAMETERS, now_ns, **fields, **named)

    @property
    def _crc(self) -> int:
        return crc_of([self._values[key] for key in KEYS])

    def _keep(self, table: KeptTable) -> None:
        self._table = table
        if self._keeper is not None:
            self._keeper.note_table(table)

    def _adopt(self, values: Mapping[str, float]) -> str:
        """Have everybody go on with a table; return why the schema refuses it, empty when done."""
        try:
            modes = _section(self._config.modes, "modes", values)
            health = _section(self._config.health, "health", values)
        except msgspec.ValidationError as error:
            return str(error)
        self._values = values
        for adopt in self._adopters.modes:
            adopt(modes)
        self._adopters.health(health)
        return ""


def _value(config: Config, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(config, section), name)


def _section(section: S, name: str, values: Mapping[str, float]) -> S:
    """Return a section with the values of a table. Raises ValidationError."""
    changes = {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{name}.")}
    return msgspec.convert({**msgspec.to_builtins(section), **changes}, type(section))
