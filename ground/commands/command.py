"""`flight command`: send a command to a flight and print its answer."""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from flight.app.run import utc_ns
from flight.link.commands import (
    COMMANDS,
    LAYOUTS,
    PING,
    POINT,
    SAFE,
    Command,
    CommandError,
    CommandPacker,
    Ping,
    Point,
    command_of,
    shown,
)
from flight.link.modes import Mode
from flight.link.process import directives
from flight.link.process.commanding import Report
from flight.link.process.directives import Deletion, Listing, Play, Scheduled, Stop
from flight.link.security import COMMAND_SPIS, TELEMETRY_SPIS, Vault
from flight.link.telemetry.definitions import COMMAND, Field, Packet
from flight.link.telemetry.packets import LONGEST_PACKET, TelemetryError, to_text
from ground.documentation import meaning_of
from ground.link.commanding import change_key, obeyed
from ground.link.commanding import command as send
from ground.link.options import add_link_options, terminal_of
from ground.telemetry import decode
from knightcube.errors import FlightError, UsageError
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget

_DIRECTIVES = ("play", "stop-playback", "new-key", "schedule", "unschedule", "list-schedule")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Send a command to a flight that listens (`commands` in its configuration) and print its answer. "
        "Exit status 0 when the flight obeyed, 1 when it refused or did not answer."
    )
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "--to", metavar="SOCKET", help="path of its UNIX socket, or HOST:PORT of its UDP address, on a bench"
    )
    add_link_options(parser, way)
    parser.add_argument(
        "--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help="with --link (default 1)"
    )
    parser.add_argument("--timeout", type=float, default=2.0, metavar="S", help="for the answer (default 2)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    for packet in COMMANDS:
        _configure_word(words.add_parser(packet.name, help=packet.meaning.lower()), packet)
    _configure_directives(words)
    parser.set_defaults(command=command)


def _configure_word(parser: argparse.ArgumentParser, packet: Packet) -> None:
    """Add the arguments of one command, as the table of telecommands has them."""
    parser.description = f"{packet.meaning}. Hazard: {packet.hazard or 'none'}."
    if packet is POINT:
        _configure_point(parser)
        return
    for field in packet.fields:
        if packet is not PING:
            _add_argument(parser, field, optional=packet is SAFE)


def _add_argument(parser: argparse.ArgumentParser, field: Field, optional: bool) -> None:
    meaning = meaning_of(replace(field, states=())).replace("%", "%%")
    if field.states:
        parser.add_argument(field.name, choices=[label for _, label in field.states], help=meaning)
    elif field.kind.startswith("S"):
        parser.add_argument(field.name, nargs="?" if optional else None, default="", help=meaning)
    else:
        parser.add_argument(field.name, type=float if field.kind.startswith("f") else int, help=meaning)


def _configure_point(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Point to nadir, velocity or sun; to inertial QX QY QZ QW, an attitude ICRS into body, scalar last; "
        "to ground LAT LON, degrees; or to object, the moving object that the star camera finds where it "
        f"looks, or near RA DEC, degrees. Hazard: {POINT.hazard}."
    )
    parser.add_argument("goal", choices=[goal.label for goal in Goal])
    parser.add_argument(
        "numbers", type=float, nargs="*", metavar="NUMBER", help="of inertial, ground and object"
    )
    parser.add_argument("--roll", type=float, metavar="DEG", help="about the pointing axis (default free)")


def _configure_directives(words: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    play = words.add_parser("play", help="with --link: play a stretch of the archive back")
    play.add_argument("begin", type=float, metavar="BEGIN", help="mission time, s")
    play.add_argument("end", type=float, metavar="END", help="mission time, s")
    play.add_argument("--run", type=int, default=0, metavar="N", help="of the archive (default the newest)")
    words.add_parser("stop-playback", help="with --link: end the playback")
    timed = words.add_parser("schedule", help="with --link: execute a command at a UTC")
    timed.add_argument("at", metavar="UTC", help="such as 2026-11-23T21:00:00")
    timed.add_argument("words", nargs="+", metavar="WHAT", help="a command, such as slew 0.2")
    deleted = words.add_parser("unschedule", help="with --link: delete a scheduled command")
    deleted.add_argument("number", type=int, metavar="N", help="as list-schedule shows it; 0: all")
    words.add_parser("list-schedule", help="with --link: show the scheduled commands")
    key = words.add_parser("new-key", help="with --link: change a key at both ends")
    key.add_argument("changed", type=int, choices=(*COMMAND_SPIS, *TELEMETRY_SPIS), metavar="SPI")


def command(options: argparse.Namespace) -> int:
    """Send, wait, print."""
    if options.link is not None:
        return _by_link(options)
    if options.what in _DIRECTIVES:
        raise UsageError(f"{options.what} goes by --link: it is a command of the link itself")
    data = _packet_of(options)
    raw = exchange(options.to, data, options.timeout)
    try:
        (row,) = decode(raw)[COMMAND.name]
        mode = Mode(int(row["mode"]))
    except (TelemetryError, ValueError) as error:
        raise FlightError(f"{options.to}: its answer of {len(raw)} bytes is invalid") from error
    obeyed, text = bool(row["obeyed"]), shown(to_text(row["text"]))
    if options.json:
        facts = {"obeyed": obeyed, "mode": mode.label, "text": text, "count": int(row["count"])}
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        sys.stdout.write(f"{'obeyed' if obeyed else 'refused'}: {text}; mode {mode.label}\n")
    return 0 if obeyed else 1


def _by_link(options: argparse.Namespace) -> int:
    """Send by protected frames and show each stage."""
    terminal = terminal_of(options)

    def show(report: Report) -> None:
        if not options.json:
            sys.stdout.write(f"{report.stage.name.lower()}: {report.text}\n")
            sys.stdout.flush()

    try:
        if options.what == "new-key":
            vault = Vault(options.keys)
            reports = change_key(terminal, vault, options.changed, options.spi, options.timeout, show)
        else:
            reports = send(terminal, _packet_of(options), options.spi, options.timeout, show)
    finally:
        terminal.close()
    done = obeyed(reports)
    if options.json:
        stages = [{"stage": report.stage.name.lower(), "text": report.text} for report in reports]
        sys.stdout.write(
            json.dumps({"obeyed": done, "counter": reports[-1].counter, "stages": stages}) + "\n"
        )
    return 0 if done else 1


def _packet_of(options: argparse.Namespace) -> bytes:
    """Return the packet of the words; its time makes it unique. Raises UsageError."""
    try:
        match options.what:
            case "play":
                return directives.pack(Play(options.run, options.begin, options.end), utc_ns())
            case "stop-playback":
                return directives.pack(Stop(), utc_ns())
            case "schedule":
                return directives.pack(Scheduled(options.at, " ".join(options.words)), utc_ns())
            case "unschedule":
                return directives.pack(Deletion(options.number), utc_ns())
            case "list-schedule":
                return directives.pack(Listing(), utc_ns())
            case _:
                return CommandPacker().pack(_command_of(options), utc_ns())
    except CommandError as error:
        raise UsageError(str(error)) from error


def exchange(to: str, data: bytes, timeout: float) -> bytes:
    """Send a datagram and return the answer. Raises FlightError without one, UsageError."""
    if not 0.0 < timeout < float("inf"):
        raise UsageError(f"--timeout {timeout}: must be a positive number of seconds")
    host, _, port = to.rpartition(":")
    if host and port.isdigit() and not Path(to).exists():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            return _ask(line, (host, int(port)), data, timeout, to)
    with (
        tempfile.TemporaryDirectory(prefix="knightcube-", dir=_answering_place(Path(to))) as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line,
    ):
        own = os.path.join(folder, "answer")
        os.chmod(folder, 0o711)  # the flight, another user, must reach our socket to answer
        line.bind(own)
        os.chmod(own, 0o777)
        return _ask(line, to, data, timeout, to)


def _answering_place(to: Path) -> Path | None:
    """Return the folder where a flight reaches our socket: its own in /run, None for that of temporary files.

    A service (`deploy/knightcube.service`) has temporary files to itself.
    """
    beside = to.absolute().parent
    return beside if beside.is_relative_to("/run") and os.access(beside, os.W_OK | os.X_OK) else None


def _ask(line: socket.socket, address: str | tuple[str, int], data: bytes, timeout: float, to: str) -> bytes:
    line.settimeout(timeout)
    try:
        line.sendto(data, address)
    except OSError as error:
        raise FlightError(f"{to}: no flight listens there: {error.strerror or error}") from error
    except OverflowError as error:
        raise UsageError(f"{to}: {error}") from error
    try:
        return line.recv(LONGEST_PACKET)
    except OSError as error:
        raise FlightError(f"{to}: no answer within {timeout:g} s") from error


def _command_of(options: argparse.Namespace) -> Command:
    packet = LAYOUTS[options.what].packet
    if packet is PING:
        return Ping(os.getpid() & 0xFFFFFFFF)
    if packet is POINT:
        return Point(_target_of(options))
    fields = {}
    for field in packet.fields:
        value = getattr(options, field.name)
        numbers = {label: number for number, label in field.states}
        fields[field.name] = numbers[value] if field.states else value
    return command_of(packet, fields)


def _target_of(options: argparse.Namespace) -> PointingTarget:
    """Return the target of the words of `point`. Raises UsageError."""
    goal = Goal.named(options.goal)
    numbers = options.numbers if goal is Goal.INERTIAL else map(math.radians, options.numbers)
    return PointingTarget(goal, tuple(numbers), None if options.roll is None else math.radians(options.roll))
