"""Commands that control a flight: `knightcube command`, `knightcube parameters` and `knightcube files`."""

from __future__ import annotations

import argparse
import json
import math
import os
import select
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from flight.app.cli import PROGRAM, to_json
from flight.app.run import utc_ns
from flight.app.service import EndingSignals
from flight.link import commands
from flight.link.events import Mode
from flight.link.files.store import FileError, Store
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage, final_mode, utc_of
from flight.link.process.downlink import LIVE
from flight.link.process.filing import LISTING
from flight.link.security import COMMAND_SPIS, TELEMETRY_SPIS, Vault
from flight.link.telemetry.definitions import (
    COMMAND,
    PARAMETER_FIELDS,
    PARAMETER_KEYS,
    PARAMETERS,
    VERIFICATION,
    Packet,
)
from flight.link.telemetry.packets import LAYOUTS as TELEMETRY_LAYOUTS
from flight.link.telemetry.packets import TelemetryError
from flight.schema.document import read_document, read_text, to_yaml
from ground.commands.options import print_result
from ground.documentation import meaning_of
from ground.link.commanding import (
    FileSession,
    add_link_options,
    change_key,
    check_timeout,
    exchange,
    explained,
    ground_files_folder,
    no_answer,
    obeyed,
    sha256_of,
    terminal_of,
)
from ground.link.commanding import command as send
from ground.link.terminal import Terminal, report_of
from ground.telemetry import decode, text_of
from knightcube.errors import KnightCubeError, UsageError, shown
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

Object = dict[str, Any]
_Words: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
_DIRECTIVES = ("play", "stop-playback", "new-key", "schedule", "unschedule", "list-schedule", "restart")
(_ORIGINS,) = (dict(field.states) for field in PARAMETERS.fields if field.name == "table")
_OF_TRANSFERS: dict[str, type[directives.CancelFile | directives.SuspendFile | directives.ResumeFile]] = {
    "cancel": directives.CancelFile,
    "suspend": directives.SuspendFile,
    "resume": directives.ResumeFile,
}
_RATE = 20_000.0  # default rate of frames to the satellite (bytes/s)
_SILENCE_S = 60.0  # default time (s) without a packet after which a file command fails
_TURN_S = 0.01  # longest time (s) to wait for packets before due protocol data units are sent
_SHOW_S = 1.0  # time (s) between two lines of progress
_LINGER_S = 0.5
"""Time (s) after a transfer during which the satellite may ask again for the last answer."""


def _add_way(parser: argparse.ArgumentParser, timeout: float) -> None:
    """Add the options that select a flight and the time to wait for its answer."""
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "--to", metavar="SOCKET", help="UNIX socket of the flight, or its UDP address HOST:PORT on a bench"
    )
    add_link_options(parser, way)
    _add_spi(parser)
    text = f"longest wait for the answer (default {timeout:g} s)"
    parser.add_argument("--timeout", type=float, default=timeout, metavar="S", help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _allow_behind(words: _Words) -> None:
    """Accept the options `--timeout` and `--json` also after the words of a command."""
    for word in words.choices.values():
        word.add_argument("--timeout", type=float, default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        word.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)


def _add_spi(parser: argparse.ArgumentParser) -> None:
    text = "key of the commands on the link (default %(default)s)"
    parser.add_argument("--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help=text)


def configure_command(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube command` to the parser."""
    parser.description = (
        "Send a command to a flight that accepts commands (`commands` in its configuration) and print its "
        "answer. Exit status 0 if the flight executed it, 1 if it refused or did not answer."
    )
    _add_way(parser, 2.0)
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    _add_commands(words)
    play = words.add_parser("play", help="with --link: play back a part of the archive")
    play.add_argument("begin", type=float, metavar="BEGIN", help="mission time, s")
    play.add_argument("end", type=float, metavar="END", help="mission time, s")
    play.add_argument(
        "--run", type=int, default=0, metavar="N", help="run of the archive (default the newest)"
    )
    words.add_parser("stop-playback", help="with --link: end the playback")
    timed = words.add_parser("schedule", help="with --link: execute a command at a UTC")
    timed.add_argument("at", metavar="UTC", help="such as 2026-11-23T21:00:00")
    text = "the command and its arguments, such as point nadir --roll 90"
    timed.add_argument("words", nargs=argparse.REMAINDER, metavar="WHAT", help=text)
    deleted = words.add_parser("unschedule", help="with --link: delete a scheduled command")
    deleted.add_argument("number", type=int, metavar="N", help="number in list-schedule; 0 deletes all")
    words.add_parser("list-schedule", help="with --link: show the scheduled commands")
    restarted = words.add_parser("restart", help="with --link: restart a process or the board")
    restarted.add_argument(
        "part", choices=directives.PARTS, metavar="PART", help=" or ".join(directives.PARTS)
    )
    key = words.add_parser("new-key", help="with --link: change a key of ground and satellite")
    spis = (*COMMAND_SPIS, *TELEMETRY_SPIS)
    text = "SPI of the key: {} or {} for commands, {} or {} for telemetry".format(*spis)
    key.add_argument("changed", type=int, choices=spis, metavar="SPI", help=text)
    _allow_behind(words)
    parser.set_defaults(command=run_command)


def _add_commands(words: _Words, packets: Sequence[Packet] = commands.COMMANDS) -> None:
    """Add a subparser for each of the telecommands."""
    for packet in packets:
        _configure_word(
            words.add_parser(packet.name, help=packet.meaning[:1].lower() + packet.meaning[1:]), packet
        )


def _with_scheduled(options: argparse.Namespace) -> argparse.Namespace:
    """Return the options of the scheduling command, with the scheduled command as one line of text.

    Options that the user entered after the scheduled command are included. A table of parameters cannot be
    scheduled, because it is too long for a scheduled command.

    Raises UsageError for values that the command forbids. A syntax error ends the program with status 2.
    """
    parser = argparse.ArgumentParser(prog=f"{PROGRAM} command schedule UTC")
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    _add_commands(words, [packet for packet in commands.COMMANDS if packet is not commands.LOAD_PARAMETERS])
    _allow_behind(words)
    typed = parser.parse_args(options.words)
    behind = {name: getattr(typed, name) for name in ("timeout", "json") if hasattr(typed, name)}
    try:
        utc_of(options.at)
        line = commands.words_of(_command_of(typed))
    except commands.CommandError as error:
        raise UsageError(str(error)) from error
    return argparse.Namespace(**{**vars(options), **behind, "words": line})


def _configure_word(parser: argparse.ArgumentParser, packet: Packet) -> None:
    """Add the arguments of one command from the table of telecommands."""
    parser.description = f"{packet.meaning}. Hazard: {packet.hazard or 'none'}."
    if packet is commands.POINT:
        parser.description = (
            "Point to nadir, velocity or sun; to inertial QX QY QZ QW, an attitude from ICRS into the body "
            "frame, scalar last; to ground LAT LON, degrees; or to object, the moving object that the star "
            f"camera detects in its field of view, or near RA DEC, degrees. Hazard: {commands.POINT.hazard}."
        )
        text = "QX QY QZ QW of inertial, LAT LON of ground, RA DEC of object"
        parser.add_argument("goal", choices=[goal.label for goal in Goal])
        numbers = parser.add_argument("numbers", type=float, nargs="*", metavar="NUMBER", help=text)
        numbers.required = False  # otherwise argparse would name the optional numbers as missing
        parser.add_argument(
            "--roll", type=float, metavar="DEG", help="angle about the pointing axis (default free)"
        )
        return
    for field in packet.fields if packet is not commands.PING else ():
        unit = "" if field.unit in {"", "-"} else f", {field.unit}"
        meaning = f"{meaning_of(replace(field, states=()))}{unit}".replace("%", "%%")
        if field.states:
            parser.add_argument(field.name, choices=[label for _, label in field.states], help=meaning)
        elif field.kind.startswith("S"):
            parser.add_argument(field.name, nargs="*", help=meaning)
        else:
            parser.add_argument(field.name, type=float if field.kind.startswith("f") else int, help=meaning)


def run_command(options: argparse.Namespace) -> int:
    """Send the command, wait for the answer and print it."""
    check_timeout(options.timeout)
    if options.what == "schedule":
        options = _with_scheduled(options)
    if options.link is not None:
        return _command_by_link(options)
    if options.what in _DIRECTIVES:
        raise UsageError(f"{options.what}: is a command of the link itself, send it with --link")
    data = packet_of(options)
    raw = exchange(options.to, data, options.timeout)
    try:
        (row,) = decode(raw)[COMMAND.name]
        mode = Mode(int(row["mode"]))
    except (TelemetryError, ValueError) as error:
        raise KnightCubeError(f"{options.to}: its answer of {len(raw)} bytes is invalid") from error
    done, text = bool(row["obeyed"]), text_of(row["text"])
    facts = {"obeyed": done, "mode": mode.label, "text": text, "count": int(row["count"])}
    print_result(options, facts, f"{'executed' if done else 'refused'}: {text}; mode {mode.label}\n")
    return 0 if done else 1


def _command_by_link(options: argparse.Namespace) -> int:
    """Send the command in protected frames and print each stage of its verification."""

    def show(report: Report) -> None:
        if not options.json:
            sys.stdout.write(f"{report.stage.name.lower()}: {explained(report)}\n")
            sys.stdout.flush()

    with closing(terminal_of(options)) as terminal:
        if options.what == "new-key":
            vault = Vault(options.keys)
            reports = change_key(terminal, vault, options.changed, options.spi, options.timeout, show)
        else:
            reports = send(terminal, packet_of(options), options.spi, options.timeout, show)
    stages = [{"stage": report.stage.name.lower(), "text": explained(report)} for report in reports]
    done = obeyed(reports)
    print_result(
        options,
        {"obeyed": done, "counter": reports[-1].counter, "stages": stages},
        _hint(options) if reports and reports[-1].stage is Stage.STARTED else "",
    )
    return 0 if done else 1


def _hint(options: argparse.Namespace) -> str:
    """Return a hint on how to see the mode that a command starts; empty if the command changes no mode."""
    if options.what not in commands.LAYOUTS:
        return ""
    mode = final_mode(_command_of(options))
    shown = f"`{PROGRAM} watch --link {options.link} --keys {options.keys} --once` shows the mode"
    return "" if mode is None else f"complete when the flight enters the mode {mode.label}: {shown}\n"


def packet_of(options: argparse.Namespace) -> bytes:
    """Return the packet of the command that the user typed; the time in the packet makes it unique.

    Raises UsageError.
    """
    try:
        match options.what:
            case "play":
                directive: directives.Directive = directives.Play(options.run, options.begin, options.end)
            case "stop-playback":
                directive = directives.Stop()
            case "schedule":
                directive = directives.Scheduled(options.at, options.words)
            case "unschedule":
                directive = directives.Deletion(options.number)
            case "restart":
                directive = directives.Restart(directives.PARTS.index(options.part))
            case "list-schedule":
                directive = directives.Listing()
            case _:
                return commands.CommandPacker().pack(_command_of(options), utc_ns())
        return directives.pack(directive, utc_ns())
    except commands.CommandError as error:
        raise UsageError(str(error)) from error


def _command_of(options: argparse.Namespace) -> commands.Command:
    packet = commands.LAYOUTS[options.what].packet
    if packet is commands.PING:
        return commands.Ping(os.getpid() & 0xFFFFFFFF)
    if packet is commands.POINT:
        goal = Goal.named(options.goal)
        numbers = options.numbers if goal is Goal.INERTIAL else map(math.radians, options.numbers)
        roll = None if options.roll is None else math.radians(options.roll)
        return commands.Point(PointingTarget(goal, tuple(numbers), roll))
    fields = {}
    for field in packet.fields:
        value = getattr(options, field.name)
        if field.kind.startswith("S"):
            value, size = " ".join(value), int(field.kind[1:])
            if len(value.encode(errors="replace")) >= size:  # the command is sent with a shorter text
                sys.stderr.write(f"knightcube: {field.name}: only its first {size - 1} bytes are sent\n")
        numbers_by_label = {label: number for number, label in field.states}
        fields[field.name] = numbers_by_label[value] if field.states else value
    return commands.command_of(packet, fields)


@dataclass(frozen=True, slots=True)
class ParameterTable:
    """Parameter table that a flight has reported."""

    values: dict[str, float]
    crc: int
    loads: int
    origin: str
    kept: bool

    @classmethod
    def of(cls, row: np.void) -> ParameterTable:
        """Return the parameter table that the decoded packet `row` contains."""
        values = {
            key: float(row[field.name]) for key, field in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True)
        }
        origin = _ORIGINS.get(int(row["table"]), "unknown")
        return cls(values, int(row["crc"]), int(row["loads"]), origin, bool(row["kept"]))


def configure_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube parameters` to the parser."""
    parser.description = (
        "Show the table of parameters that a flight uses. With NAME=VALUE or --load, load another table: the "
        "flight accepts or refuses it as a whole, and only if its table has not changed meanwhile. It keeps "
        "the new table for its next starts. Exit status 0 if done, 1 if the flight refused or did not answer."
    )
    parser.epilog = "example: knightcube parameters --to runs/socket modes.tumble_rate=0.3"
    _add_way(parser, 4.0)
    parser.add_argument("--load", type=Path, metavar="FILE", help="load all parameters from a file of --save")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the table in use to this file")
    parser.add_argument("changes", nargs="*", metavar="NAME=VALUE", help="such as modes.tumble_rate=0.3")
    parser.set_defaults(command=run_parameters)


def run_parameters(options: argparse.Namespace) -> int:
    """Request the parameter table, change it if requested, and print the table in use."""
    check_timeout(options.timeout)
    file = _parameters_in(options.load) if options.load is not None else None
    changes = dict(map(_change, options.changes))
    before, _ = _ask(options, commands.DumpParameters())
    if before is None:
        raise KnightCubeError(
            "the flight sent no table of parameters: repeat the command or use a longer --timeout"
        )
    wanted = {**(file or before.values), **changes}
    if problem := commands.problem_of(wanted):
        raise UsageError(problem)
    flown, refused = before, ""
    if wanted != before.values:
        _, refused = _ask(
            options, commands.LoadParameters(before.crc, tuple(wanted[key] for key in PARAMETER_KEYS))
        )
        flown = (_ask(options, commands.DumpParameters())[0] or before) if not refused else before
        if not refused and flown.crc != commands.crc_of([wanted[key] for key in PARAMETER_KEYS]):
            problem = f"the flight uses table {flown.crc:08x}, not the one that was sent"
            raise KnightCubeError(f"{problem}: check it with another call")
    _show(flown, before, refused, options.json)
    if options.save is not None:
        sections: dict[str, dict[str, float]] = {}
        for key, value in flown.values.items():
            section, _, name = key.partition(".")
            sections.setdefault(section, {})[name] = value
        options.save.write_text(to_yaml(sections), encoding="utf-8")
    return 1 if refused else 0


def _ask(options: argparse.Namespace, command: commands.Command) -> tuple[ParameterTable | None, str]:
    """Send a command and return the table received with its answer, and the reason for a refusal."""
    packet = commands.CommandPacker().pack(command, utc_ns())
    if options.link is not None:
        return _ask_by_link(options, packet, wants_table=isinstance(command, commands.DumpParameters))
    found = decode(exchange(options.to, packet, options.timeout))
    answers, tables = found[COMMAND.name], found[PARAMETERS.name]
    if not len(answers):
        raise KnightCubeError(f"{options.to}: its answer has no report on the command")
    refused = "" if answers[-1]["obeyed"] else text_of(answers[-1]["text"])
    return (ParameterTable.of(tables[-1]) if len(tables) else None), refused


def _ask_by_link(
    options: argparse.Namespace, packet: bytes, wants_table: bool
) -> tuple[ParameterTable | None, str]:
    """Send a command in protected frames, and find the parameter table in the live telemetry."""
    table: ParameterTable | None = None
    refused: str | None = None
    reported = False
    kinds = {TELEMETRY_LAYOUTS[kind.name].identifier: kind for kind in (PARAMETERS, VERIFICATION)}
    with closing(terminal_of(options)) as terminal:
        counter = terminal.send(packet, options.spi)
        for channel, data in terminal.packets(options.timeout):
            kind = kinds.get(int.from_bytes(data[:2], "big"))
            if kind is PARAMETERS and channel == LIVE:
                (row,) = decode(data)[kind.name]
                table = ParameterTable.of(row)
            elif kind is VERIFICATION:
                report = report_of(data)
                if report is not None and (report.counter, report.spi) == (counter, options.spi):
                    if report.stage.final or (report.stage is Stage.REPEATED and not reported):
                        refused = "" if report.stage is Stage.COMPLETED else explained(report)
                    reported = True
            if refused or (refused is not None and (table is not None or not wants_table)):
                break
        gate = terminal.gate
    if refused is None:
        raise no_answer(gate, options.timeout)
    return table, refused


def _show(table: ParameterTable, before: ParameterTable, refused: str, as_json: bool) -> None:
    if as_json:
        facts: Object = {"crc": f"{table.crc:08x}", "table": table.origin, "loads": table.loads}
        facts |= {"kept": table.kept, "refused": refused, "values": table.values}
        sys.stdout.write(to_json(facts))
        return
    for key, field in zip(PARAMETER_KEYS, PARAMETER_FIELDS, strict=True):
        low, high = field.valid or (-np.inf, np.inf)
        old = "" if table.values[key] == before.values[key] else f"   was {before.values[key]:g}"
        sys.stdout.write(f"{key:22s} {table.values[key]:<10g} {field.unit:9s} {low:g} to {high:g}{old}\n")
    kept = "kept for the next starts" if table.kept else "not kept: this flight has no state folder"
    source = "as configured" if table.origin == "configuration" else f"{table.origin} by command"
    sys.stdout.write(f"table {table.crc:08x}: {source} (number of loads: {table.loads}); {kept}\n")
    if refused:
        sys.stderr.write(f"knightcube: refused: {refused}\n")


def _change(text: str) -> tuple[str, float]:
    """Return the name and the value of an argument NAME=VALUE. Raises UsageError."""
    key, _, value = text.partition("=")
    if key not in PARAMETER_KEYS:
        raise UsageError(f"{key}: no such parameter; the parameters are {', '.join(PARAMETER_KEYS)}")
    try:
        return key, float(value)
    except ValueError as error:
        raise UsageError(f"{text}: give NAME=VALUE with a number") from error


def _parameters_in(path: Path) -> dict[str, float]:
    """Return the parameter table in a YAML file. Raises ConfigError or UsageError if the file is invalid."""
    document = read_document(read_text(path, packaged=False), str(path))
    values: dict[str, float] = {}
    for section, entries in document.values.items():
        if not isinstance(entries, dict):
            raise document.error(section, "must be a section of parameters, as --save writes it")
        for name, value in entries.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise document.error(f"{section}.{name}", f"is {value!r}: must be a number")
            if not abs(value) <= sys.float_info.max:
                raise document.error(f"{section}.{name}", f"is {value!r:.20}: must be a finite number")
            values[f"{section}.{name}"] = float(value)
    if problem := commands.problem_of(values):
        raise UsageError(f"{path}: {problem}")
    return values


def configure_files(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube files` to the parser."""
    parser.description = (
        "List the files of a satellite, get files from it and put files on it over its link. Received data "
        "is kept after Ctrl-C; run the same command again to continue. Exit status 1 if a file is incomplete."
    )
    add_link_options(parser, parser.add_mutually_exclusive_group(required=True))
    _add_spi(parser)
    text = "folder of received files and open transfers (default: KEYS-files beside the folder KEYS)"
    parser.add_argument("--folder", type=Path, metavar="DIR", help=text)
    text = "maximum rate of frames to the satellite, bytes/s (default %(default)g)"
    parser.add_argument("--rate", type=float, default=_RATE, metavar="B", help=text)
    text = "time without a packet after which the command fails (default %(default)g s)"
    parser.add_argument("--timeout", type=float, default=_SILENCE_S, metavar="S", help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    listed = words.add_parser("list", help="list the files on board")
    listed.add_argument(
        "under", nargs="?", default="", metavar="BEGINNING", help="first letters of the listed names"
    )
    got = words.add_parser("get", help="get files from the satellite")
    got.add_argument("names", nargs="+", metavar="NAME", help="name in the list")
    for word, purpose, text in (
        ("put", "put a file on the satellite", "the file"),
        ("use", "use a file uploaded to the satellite", "local copy of the file, whose SHA-256 is sent"),
    ):
        placed = words.add_parser(word, help=purpose)
        placed.add_argument("kind", choices=directives.KINDS, help="purpose of the file")
        placed.add_argument("path", type=Path, metavar="FILE", help=text)
        if word == "put":
            placed.add_argument(
                "--replace", action="store_true", help="delete a file of this name on board first"
            )
    deleted = words.add_parser("delete", help="delete a file that was uploaded to the satellite")
    deleted.add_argument("name", metavar="NAME", help="name in the list")
    for word in _OF_TRANSFERS:
        placed = words.add_parser(word, help=f"{word} a transfer on board")
        text = "sender: 1 for the satellite, 2 for the ground"
        placed.add_argument("source", type=int, metavar="ENTITY", help=text)
        placed.add_argument("number", type=int, metavar="N", help="number in the packet transfer")
    _allow_behind(words)
    parser.set_defaults(command=run_files)


_LOCAL = {
    "put": "`files put` sends a local file",
    "use": "`files use` needs the local copy of the file on board, whose SHA-256 it sends",
}
"""Reasons why file commands need a local file, by the name of the command."""


def run_files(options: argparse.Namespace) -> int:
    """Carry out the file command and print its result."""
    for name in ("rate", "timeout"):
        if not 0.0 < getattr(options, name) < float("inf"):
            raise UsageError(f"--{name} {getattr(options, name)}: must be a positive number")
    if options.what in _LOCAL and not options.path.is_file():
        raise UsageError(f"{options.path}: no such file on the ground: {_LOCAL[options.what]}")
    with closing(terminal_of(options)) as terminal:
        store = Store(options.folder or ground_files_folder(options.keys))
        with store.owned(), EndingSignals() as signals:
            session = FileSession(terminal, store, options.spi, options.rate, time.monotonic_ns())
            work = _FileWork(session, terminal, options.timeout, lambda: signals.received)
            try:
                facts = work.obey(options)
            finally:
                session.close(time.monotonic_ns())
    files = "".join(f"{one['bytes']:>12} {shown(one['name'])}\n" for one in facts.get("files", ()))
    print_result(options, facts, files + (f"{facts['text']}\n" if "text" in facts else ""))
    return 0


class _FileWork:
    """Runner of one `knightcube files` command over a link session."""

    def __init__(
        self, session: FileSession, terminal: Terminal, patience_s: float, ended: Callable[[], bool]
    ) -> None:
        self._session, self._terminal = session, terminal
        self._patience_s, self._ended = patience_s, ended
        self._shown_s, self._said = 0.0, ""

    def obey(self, options: argparse.Namespace) -> Object:
        """Return the result of the file command. Raises KnightCubeError."""
        match options.what:
            case "list":
                path = self._get(directives.ListFiles(options.under), LISTING)
                listing: Object = json.loads(path.read_bytes())
                return listing | {"text": f"{listing['free']} bytes are free"}
            case "get":
                paths = [self._get(directives.SendFile(name), name) for name in options.names]
                return {"files": [self._facts(path) for path in paths]}
            case "put":
                name = f"{options.kind}/{options.path.name}"
                if options.replace:
                    path = self._get(directives.ListFiles(f"received/{name}"), LISTING)
                    files = json.loads(path.read_bytes())["files"]
                    if any(file["name"] == f"received/{name}" for file in files):
                        self._command(directives.DeleteFile(f"received/{name}"))
                return self._put(options.path, name)
            case "use":
                name, digest = f"received/{options.kind}/{options.path.name}", sha256_of(options.path)
                try:
                    return self._command(directives.UseFile(name, digest))
                except KnightCubeError as error:
                    if "its SHA-256 is" not in str(error):
                        raise
                    problem = f"{error}, but that of {options.path} is {digest.hex()}"
                    raise KnightCubeError(f"{problem}: send the file again by `put --replace`") from error
            case "delete":
                return self._command(directives.DeleteFile(options.name))
            case word:
                return self._command(_OF_TRANSFERS[word](options.source, options.number))

    def _facts(self, path: Path) -> Object:
        name, size = path.relative_to(self._session.received).as_posix(), path.stat().st_size
        return {"name": name, "bytes": size, "path": str(path), "sha256": sha256_of(path).hex()}

    def _get(self, directive: directives.Directive, name: str) -> Path:
        """Return the path of a file that was received completely."""
        self._session.ask(directive, time.monotonic_ns())
        self._turn(name)
        while not self._session.received_file(name):
            self._turn(name)
        until = time.monotonic() + _LINGER_S
        while time.monotonic() < until and self._session.entity.transfers():
            self._turn("")
        return self._session.received / name

    def _put(self, path: Path, name: str) -> Object:
        begun = self._session.put(path.absolute(), name, time.monotonic_ns())
        self._turn(name)
        while not self._session.ended(name, begun.number):
            self._turn(name)
        text = f"on board: received/{name}, {begun.size} bytes"
        digest = sha256_of(path).hex()
        return {"name": f"received/{name}", "bytes": begun.size, "sha256": digest, "text": text}

    def _command(self, directive: directives.Directive) -> Object:
        self._session.ask(directive, time.monotonic_ns())
        self._turn("")
        while not self._session.completed():
            self._turn("")
        return {"text": f"completed: {directive}"}

    def _try(self, use: Callable[[], object]) -> None:
        """Use the line. A failure of the line is reported once, and ends the work if it lasts."""
        try:
            use()
        except FileError:
            raise
        except KnightCubeError as error:
            if self._terminal.failing > self._patience_s:
                raise
            if str(error) != self._said:
                self._said = str(error)
                sys.stderr.write(f"knightcube: {error}; tried again\n")

    def _turn(self, name: str) -> None:
        """Receive packets, and send due packets. Raises KnightCubeError after a signal or a long silence."""
        if select.select([self._terminal], [], [], _TURN_S)[0]:
            self._try(lambda: self._session.take(self._terminal.take(), time.monotonic_ns()))
        now_ns = time.monotonic_ns()
        self._try(lambda: self._session.transmit(now_ns))
        kept = "; the received data is kept: run the same command again to continue" if name else ""
        if self._ended():
            raise KnightCubeError(f"ended by a signal{kept}")
        if now_ns - self._session.received_ns > self._patience_s * 1e9:
            cause = "check --link and --keys, and that the link runs"
            raise KnightCubeError(f"no packet from the satellite for {self._patience_s:g} s: {cause}{kept}")
        if name and now_ns * 1e-9 - self._shown_s >= _SHOW_S:
            self._shown_s = now_ns * 1e-9
            for one in self._session.entity.transfers():
                if one.name not in {"", name}:  # transfers of other files are not shown
                    continue
                part = f"{one.done} of {one.size} bytes" if one.size else "waiting for data"
                sys.stderr.write(f"knightcube: {shown(one.name or name)}: {part}\n")
