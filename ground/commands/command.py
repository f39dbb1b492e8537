"""`flight command`: send a command to a flight and print its answer."""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import sys
import tempfile
from pathlib import Path

from flight.app.utc_label import utc_ns
from flight.gnc.errors import FlightError, UsageError
from flight.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from flight.link.commands.codec import (
    ChangeMode,
    Clear,
    Command,
    CommandError,
    CommandPacker,
    Ping,
    Point,
    Slew,
    shown,
)
from flight.link.modes import COMMANDABLE, Mode
from flight.link.process import directives
from flight.link.process.directives import Play, Stop
from flight.link.process.verification import Report
from flight.link.security.associations import COMMAND_SPIS, TELEMETRY_SPIS, Vault
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import LONGEST_PACKET, TelemetryError, to_text
from ground.link.commanding import change_key, obeyed
from ground.link.commanding import command as send
from ground.link.terminal import DEFAULTS, TerminalSettings, open_terminal
from ground.telemetry.scanner import decode

_DIRECTIVES = ("play", "stop-playback", "new-key")
_MODES = [mode.label for mode in COMMANDABLE if mode is not Mode.SLEW]


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
    way.add_argument(
        "--link", metavar="ADDRESS", help="its link: HOST:PORT (UDP), tcp:HOST:PORT or /dev/FILE@BAUD"
    )
    parser.add_argument("--keys", type=Path, metavar="FOLDER", help="the ground's keys, with --link")
    parser.add_argument(
        "--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help="with --link (default 1)"
    )
    parser.add_argument(
        "--spacecraft", type=int, default=DEFAULTS.spacecraft, metavar="N", help="with --link"
    )
    parser.add_argument(
        "--frame-bytes", type=int, default=DEFAULTS.frame_bytes, metavar="N", help="with --link"
    )
    parser.add_argument("--timeout", type=float, default=2.0, metavar="S", help="for the answer (default 2)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    words = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    words.add_parser("ping", help="answer and do nothing else")
    safe = words.add_parser("safe", help="abort: coils to zero, mode safe")
    safe.add_argument("reason", nargs="?", default="", help="for the log")
    words.add_parser("mode", help="change the mode").add_argument("mode", choices=_MODES)
    slew = words.add_parser("slew", help="go to an attitude, then hold it")
    slew.add_argument("q2", type=float, help="commanded final q2, within +-0.68")
    clear = words.add_parser("clear", help="clear a latched event")
    clear.add_argument("event", help="its name, as in the log")
    _configure_point(words.add_parser("point", help="point a satellite to a goal"))
    _configure_directives(words)
    parser.set_defaults(command=command)


def _configure_point(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Point to nadir, velocity or sun; to inertial QX QY QZ QW, an attitude ICRS into body, scalar last; "
        "or to ground LAT LON, degrees."
    )
    parser.add_argument("goal", choices=[goal.label for goal in Goal])
    parser.add_argument("numbers", type=float, nargs="*", metavar="NUMBER", help="of inertial and ground")
    parser.add_argument("--roll", type=float, metavar="DEG", help="about the pointing axis (default free)")


def _configure_directives(words: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    play = words.add_parser("play", help="with --link: play a stretch of the archive back")
    play.add_argument("begin", type=float, metavar="BEGIN", help="mission time, s")
    play.add_argument("end", type=float, metavar="END", help="mission time, s")
    play.add_argument("--run", type=int, default=0, metavar="N", help="of the archive (default the newest)")
    words.add_parser("stop-playback", help="with --link: end the playback")
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
    if options.keys is None:
        raise UsageError("--link needs --keys, the ground's folder of `python -m ground keys`")
    terminal = open_terminal(
        options.link, options.keys, TerminalSettings(options.spacecraft, options.frame_bytes)
    )

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
    match options.what:
        case "ping":
            return Ping(os.getpid() & 0xFFFFFFFF)
        case "safe":
            return ChangeMode(Mode.SAFE, options.reason)
        case "mode":
            return ChangeMode(Mode.named(options.mode))
        case "slew":
            return Slew(options.q2)
        case "point":
            return Point(_target_of(options))
        case _:
            return Clear(options.event)


def _target_of(options: argparse.Namespace) -> PointingTarget:
    """Return the target of the words of `point`. Raises UsageError."""
    goal = Goal.named(options.goal)
    numbers = options.numbers if goal is not Goal.GROUND else map(math.radians, options.numbers)
    return PointingTarget(goal, tuple(numbers), None if options.roll is None else math.radians(options.roll))
