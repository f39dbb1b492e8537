"""`flight link`: the link process between a flight and its ground."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
from contextlib import ExitStack, suppress
from pathlib import Path

from flight.app.accepted_config import accepted_config
from flight.link.process.archive_reader import LogFollower
from flight.link.process.control_line import ControlLine
from flight.link.process.lines import Line, SerialLine, TcpLine, UdpLine
from flight.link.process.station import Station, StationSettings
from flight.link.process.verification import Sent
from flight.link.security.associations import Vault
from flight.schema.carried import config_path
from flight.schema.peers import peer_networks
from flight.schema.reader import parse
from flight.schema.sections import Link
from hal.buses.clock import SystemClock
from hal.buses.serial_port import PySerialPort
from knightcube.errors import UsageError

_NICE = 10


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Connect a flight to its ground by protected frames (`link` in its configuration): live telemetry "
        "and playback from its log, commands to its socket. A process of its own, at low priority; SIGTERM "
        "ends it."
    )
    parser.add_argument("config", type=config_path, metavar="CONFIG", help="the configuration that is flown")
    parser.add_argument(
        "--log",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the run, or of the archive: its newest run is followed",
    )
    parser.set_defaults(command=link)


def link(options: argparse.Namespace) -> int:
    """Open the lines and turn until a signal."""
    # A service keeps the last configuration that flew beside its archive.
    chosen = accepted_config(options.config, {"STATE_DIRECTORY": str(options.log.absolute().parent)})
    if chosen.problem:
        sys.stderr.write(f"flight: {chosen.problem}\n")
    config = parse(chosen.text, str(chosen.path))
    if config.link is None or config.commands.socket is None:
        raise UsageError(f"{chosen.path}: no `link` section: there is nothing to connect")
    section, clock = config.link, SystemClock()
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    with suppress(PermissionError):  # a service's unit has done so, and its sandbox forbids it
        os.nice(_NICE)
    with ExitStack() as stack:
        vault = Vault(Path(section.keys))
        stack.enter_context(vault.owned())
        lines = _open_lines(section, clock, stack)
        folder = os.environ.get("RUNTIME_DIRECTORY") or stack.enter_context(
            tempfile.TemporaryDirectory(prefix="knightcube-")
        )
        control: ControlLine[Sent] = ControlLine(Path(config.commands.socket), Path(folder))
        settings = StationSettings(section.spacecraft, section.frame_bytes, section.rate)
        station = Station(settings, vault, lines, control, LogFollower(options.log), clock)
        sys.stderr.write(f"flight: link open on {', '.join(line.name for line in lines)}\n")
        station.run(ended.is_set, lambda text: sys.stderr.write(f"flight: link: {text}\n"))
    return 0


def _open_lines(section: Link, clock: SystemClock, stack: ExitStack) -> list[Line]:
    """Open the configured lines. Raises UsageError, DeviceError."""
    peers, lines = peer_networks(section), list[Line]()
    if section.udp is not None:
        lines.append(UdpLine(section.udp, section.telemetry_to, peers))
    if section.tcp is not None:
        lines.append(TcpLine(section.tcp, peers))
    if section.serial is not None:
        port = PySerialPort(section.serial.device, section.serial.baud, clock, patient=True)
        lines.append(SerialLine(section.serial.device, port))
    for line in lines:
        stack.callback(line.close)
    return lines
