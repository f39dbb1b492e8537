"""`flight parameters`: show, change, save and load the table of parameters of a flight."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.app.run import utc_ns
from flight.link.commands import Command, CommandPacker, DumpParameters, LoadParameters, shown
from flight.link.process.commanding import Stage
from flight.link.security import COMMAND_SPIS
from flight.link.telemetry.definitions import (
    COMMAND,
    PARAMETER_FIELDS,
    PARAMETER_KEYS,
    PARAMETERS,
    VERIFICATION,
    crc_of,
    problem_of,
)
from flight.link.telemetry.packets import LAYOUTS, to_text
from flight.schema.document import read_document, read_text, to_yaml
from ground.commands.command import exchange
from ground.link.options import add_link_options, terminal_of
from ground.link.terminal import report_of
from ground.telemetry import decode
from knightcube.errors import FlightError, UsageError

_ORIGINS = {field.name: dict(field.states) for field in PARAMETERS.fields if field.name in {"table", "kept"}}


@dataclass(frozen=True, slots=True)
class Table:
    """A table as a flight reports it."""

    values: dict[str, float]
    crc: int
    loads: int
    origin: str
    kept: bool


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Show the table of parameters that a flight uses. With values, or with --load, fly another table: it "
        "is loaded or refused as a whole, in place of the table that was looked at, and kept for the next "
        "starts. Exit status 0 when done, 1 when the flight refused or did not answer."
    )
    parser.epilog = "example: python -m flight parameters --to runs/socket modes.tumble_rate=0.3"
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument("--to", metavar="SOCKET", help="path of its UNIX socket, or HOST:PORT on a bench")
    add_link_options(parser, way)
    parser.add_argument(
        "--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help="with --link (default 1)"
    )
    parser.add_argument("--timeout", type=float, default=4.0, metavar="S", help="for an answer (default 4)")
    parser.add_argument("--load", type=Path, metavar="FILE", help="YAML as --save writes it, all parameters")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the table that flies in the end")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("changes", nargs="*", metavar="NAME=VALUE", help="such as modes.tumble_rate=0.3")
    parser.set_defaults(command=parameters)


def parameters(options: argparse.Namespace) -> int:
    """Ask for the table, change it where wanted, and show the one that flies."""
    if not 0.0 < options.timeout < float("inf"):
        raise UsageError(f"--timeout {options.timeout}: must be a positive number of seconds")
    file = _table_of(options.load) if options.load is not None else None
    changes = dict(map(_change, options.changes))
    before, _ = _ask(options, DumpParameters())
    if before is None:
        raise FlightError("the flight sent no table of parameters: ask again, or give a longer --timeout")
    wanted = {**(file or before.values), **changes}
    if problem := problem_of(wanted):
        raise UsageError(problem)
    flown, refused = before, ""
    if wanted != before.values:
        _, refused = _ask(options, LoadParameters(before.crc, tuple(wanted[key] for key in PARAMETER_KEYS)))
        flown = (_ask(options, DumpParameters())[0] or before) if not refused else before
        if not refused and flown.crc != crc_of([wanted[key] for key in PARAMETER_KEYS]):
            raise FlightError(f"table {flown.crc:08x} flies, not the one that was sent: look again")
    _show(flown, before, refused, options.json)
    if options.save is not None:
        options.save.write_text(_yaml(flown.values), encoding="utf-8")
    return 1 if refused else 0


def _ask(options: argparse.Namespace, command: Command) -> tuple[Table | None, str]:
    """Send a command; return the table that came with its answer, and why the command was refused."""
    packet = CommandPacker().pack(command, utc_ns())
    if options.link is None:
        found = decode(exchange(options.to, packet, options.timeout))
        answers, tables = found[COMMAND.name], found[PARAMETERS.name]
        if not len(answers):
            raise FlightError(f"{options.to}: its answer holds no report of the command")
        refused = "" if answers[-1]["obeyed"] else shown(to_text(answers[-1]["text"]))
        return (_reported(tables[-1]) if len(tables) else None), refused
    return _by_link(options, packet, wants_table=isinstance(command, DumpParameters))


def _by_link(options: argparse.Namespace, packet: bytes, wants_table: bool) -> tuple[Table | None, str]:
    """Send by protected frames; the table comes with the live telemetry, before or after the verification."""
    table: Table | None = None
    refused: str | None = None
    terminal = terminal_of(options)
    try:
        counter = terminal.send(packet, options.spi)
        for kind, data in _named(terminal.packets(options.timeout)):
            if kind == PARAMETERS.name:
                (row,) = decode(data)[kind]
                table = _reported(row)
            elif kind == VERIFICATION.name:
                report = report_of(data)
                if (report.counter, report.spi) == (counter, options.spi) and report.stage.final:
                    refused = "" if report.stage is Stage.COMPLETED else report.text
            if refused or (refused is not None and (table is not None or not wants_table)):
                break
    finally:
        terminal.close()
    if refused is None:
        raise FlightError(f"{options.link}: no answer within {options.timeout:g} s")
    return table, refused


def _named(packets: Iterator[tuple[int, bytes]]) -> Iterator[tuple[str, bytes]]:
    """Yield the name of each packet of the two kinds that are waited for, and its bytes."""
    kinds = {LAYOUTS[name].identifier: name for name in (PARAMETERS.name, VERIFICATION.name)}
    for _, data in packets:
        if name := kinds.get(int.from_bytes(data[:2], "big")):
            yield name, data


def _reported(row: np.void) -> Table:
    """Return the table of a packet."""
    values = {
        key: float(row[field.name]) for key, field in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True)
    }
    origin = _ORIGINS["table"].get(int(row["table"]), "unknown")
    return Table(values, int(row["crc"]), int(row["loads"]), origin, bool(row["kept"]))


def _show(table: Table, before: Table, refused: str, as_json: bool) -> None:
    if as_json:
        facts: dict[str, Any] = {
            "crc": f"{table.crc:08x}",
            "table": table.origin,
            "loads": table.loads,
            "kept": table.kept,
            "refused": refused,
            "values": table.values,
        }
        sys.stdout.write(json.dumps(facts) + "\n")
        return
    for key, field in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True):
        low, high = field.valid or (-np.inf, np.inf)
        old = "" if table.values[key] == before.values[key] else f"   was {before.values[key]:g}"
        sys.stdout.write(f"{key:22s} {table.values[key]:<10g} {field.unit:9s} {low:g} to {high:g}{old}\n")
    kept = "kept for the next starts" if table.kept else "not kept: this flight has no state folder"
    sys.stdout.write(f"table {table.crc:08x}, of the {table.origin}, {table.loads} loaded so far; {kept}\n")
    if refused:
        sys.stderr.write(f"flight: refused: {refused}\n")


def _change(text: str) -> tuple[str, float]:
    """Return name and value of NAME=VALUE. Raises UsageError."""
    key, _, value = text.partition("=")
    if key not in PARAMETER_KEYS:
        raise UsageError(f"{key} is no parameter: {', '.join(PARAMETER_KEYS)}")
    try:
        return key, float(value)
    except ValueError as error:
        raise UsageError(f"{text}: give NAME=VALUE with a number") from error


def _table_of(path: Path) -> dict[str, float]:
    """Return the table in a file. Raises ConfigError, UsageError."""
    document = read_document(read_text(path), str(path))
    values: dict[str, float] = {}
    for section, entries in document.values.items():
        if not isinstance(entries, dict):
            raise document.error(section, "must be a section of parameters, as --save writes it")
        for name, value in entries.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise document.error(f"{section}.{name}", f"is {value!r}: must be a number")
            values[f"{section}.{name}"] = float(value)
    if problem := problem_of(values):
        raise UsageError(f"{path}: {problem}")
    return values


def _yaml(values: Mapping[str, float]) -> str:
    sections: dict[str, dict[str, float]] = {}
    for key, value in values.items():
        section, _, name = key.partition(".")
        sections.setdefault(section, {})[name] = value
    return to_yaml(sections)
