"""The command `knightcube link`, which runs the link process between a flight and its ground station."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from flight.app.service import (
    FlownRelease,
    SeparationInhibit,
    StartRetry,
    StoppedError,
    accepted_config,
    retried_start,
)
from flight.link.coding import LinkCodes
from flight.link.events import FOREIGN_MODES
from flight.link.frames import (
    LONGEST_FRAME,
    TELECOMMAND_HEADER,
    TELECOMMAND_MASK,
    TelecommandHeader,
    close_frame,
)
from flight.link.process import directives
from flight.link.process.commanding import ControlLine, Sent
from flight.link.process.directives import Listing
from flight.link.process.downlink import LogFollower
from flight.link.process.station import (
    REBUILT,
    RESTORED,
    Line,
    SerialLine,
    Station,
    StationSettings,
    TcpLine,
    TncLine,
    UdpLine,
)
from flight.link.security import (
    COMMAND_SPIS,
    OVERHEAD_BYTES,
    TELEMETRY_SPIS,
    Association,
    Sealer,
    Vault,
    new_key,
)
from flight.link.telemetry.log import find_runs, find_segments
from flight.link.telemetry.packets import CRC_BYTES
from flight.schema.document import ConfigError, config_path
from flight.schema.reader import parse, peer_networks
from flight.schema.sections import Config, Link
from hal.buses.linux_wires import PySerialPort
from hal.buses.system import ServiceManager, SystemClock
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.errors import KnightCubeError, UsageError

_NICE = 10
_KEYS_WAIT_NS = 60 * SECOND_NS
"""Time (ns) for which the start waits for the folder of keys before it rebuilds the folder from the reference
folder."""
_WRITE_TIMEOUT_S = 0.0  # a radio that is slower than the configured rate accepts the rest of a frame later


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Connect a flight to its ground by protected frames (`link` in its configuration): live telemetry "
        "and playback from its log, commands to its socket. The link is a process of its own, at low "
        "priority. While keys, an address or a port are missing, it reports this and waits. SIGTERM ends it."
    )
    parser.add_argument("config", type=config_path, metavar="CONFIG", help="configuration of the flight")
    parser.add_argument(
        "--log",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the run, or of an archive, whose newest run is followed",
    )
    parser.set_defaults(command=link)


def link(options: argparse.Namespace) -> int:
    """Run the link until a signal arrives.

    Raises ConfigError for a wrong option or configuration, and KnightCubeError for any other error.
    """
    if os.path.exists(options.log) and not os.path.isdir(options.log):  # false if the disk fails
        raise ConfigError(f"--log {options.log}", "is not the folder of a run or of an archive")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    with suppress(OSError):  # for a service, systemd sets the priority and forbids this call
        os.nice(_NICE)
    try:
        _run(options.config, options.log, ended.is_set)
    except StoppedError as error:  # a signal during the start
        _say(str(error))
    except ConfigError:
        raise
    except (UsageError, OSError) as error:
        raise KnightCubeError(str(error)) from error
    return 0


def _run(config: Path, log: Path, ended: Callable[[], bool]) -> None:
    """Run the link until `ended` returns true; start it again when lost keys can be read again."""
    with ExitStack() as stack:
        retry, overseer = StartRetry(ended), ServiceManager(os.environ, os.getpid())
        for callback in (retry.close, overseer.close, overseer.stopping):
            stack.callback(callback)
        clock, release = SystemClock(), FlownRelease(os.environ)
        judge = partial(_judge, config, log)
        attempt = partial(_open, log, SeparationInhibit(clock), KeysFolder(clock))
        while not ended():
            with ExitStack() as opened:
                station, names = retried_start(judge, attempt, opened, retry)
                status = f"link open on {names}"
                _say("; ".join(filter(None, (status, retry.summary()))))
                with suppress(OSError):  # a damaged disk of the flight must not end the link
                    if not find_segments((find_runs(log) or [log])[-1], "flight"):
                        _say(f"--log {log}: no flight log yet: telemetry begins with the log in this folder")
                overseer.ready(status)
                if release.note:
                    station.report_problem("release", release.note)
                release.serve(clock, opened)
                station.run(ended, lambda text: _say(f"link: {text}"), overseer.feed_watchdog)
        release.end()


def _judge(config_path: Path, log: Path) -> tuple[Config, str]:
    """Return a valid configuration, and why it replaces the requested one (or "").

    Raises ConfigError if there is no valid configuration, or if it has no link or no command socket.
    """
    # A service stores the flown configurations in the folder that also contains its archive.
    chosen = accepted_config(config_path, {"STATE_DIRECTORY": str(log.absolute().parent)})
    config = parse(chosen.text, str(chosen.path))
    if config.link is None or config.commands.socket is None:
        raise ConfigError(
            str(chosen.path), "has no section `link`, which describes the line to the ground: add it"
        )
    return config, chosen.problem


class KeysFolder:
    """Opens the satellite's folder of keys, and measures for how long no key could be read."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._missing_ns: int | None = None  # time of the first attempt that found no key

    def open(self, folder: Path) -> Vault:
        """Open the folder. A minute after the first attempt without a key, a lost folder is rebuilt.

        Raises UsageError if no key can be read.
        """
        now_ns = self._clock.now_ns()
        rebuild = self._missing_ns is not None and now_ns - self._missing_ns >= _KEYS_WAIT_NS
        try:
            vault = Vault(folder, _witness(folder), rebuild)
            if all(vault.read(spi) is None for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS)):
                raise UsageError(f"{folder}: no key can be read: mount or copy the satellite's keys there")
        except UsageError:
            self._missing_ns = now_ns if self._missing_ns is None else self._missing_ns
            raise
        self._missing_ns = None
        if vault.restored or vault.rebuilt:
            _say(f"{folder}: {RESTORED if vault.restored else REBUILT}")
        return vault


def _open(
    log: Path, inhibit: SeparationInhibit, keys: KeysFolder, judged: tuple[Config, str], stack: ExitStack
) -> tuple[Station, str]:
    """Open the station after the separation inhibit; return it with the names of its communication lines."""
    (config, problem), clock = judged, SystemClock()
    section, commands = config.link, config.commands.socket
    assert section is not None
    assert commands is not None
    if problem:
        _say(problem)
    inhibit.check(Path(section.keys).absolute().parent, config.separation.inhibit)
    vault = keys.open(Path(section.keys))
    stack.enter_context(vault.owned())
    coding = section.coding
    codes = LinkCodes(
        section.frame_bytes, coding.randomiser, coding.reed_solomon, coding.cltu, section.call_signs
    )
    lines = _open_lines(section, codes, clock, stack)
    folder = os.environ.get("RUNTIME_DIRECTORY") or stack.enter_context(
        tempfile.TemporaryDirectory(prefix="knightcube-")
    )
    control: ControlLine[Sent] = ControlLine(Path(commands), Path(folder))
    settings = StationSettings(
        section.spacecraft,
        section.frame_bytes,
        section.rate,
        section.command_loss,
        idle_rate=section.idle_rate,
        encrypted=section.encrypt_telemetry,
        codes=codes,
        foreign_modes=FOREIGN_MODES.get(config.body, frozenset()),
    )
    station = Station(settings, vault, lines, control, LogFollower(log), clock)
    return station, ", ".join(line.name for line in lines)


def _witness(keys: Path) -> Path:
    """Return the reference folder: the second state folder of a service, or else a folder beside the keys."""
    folders = os.environ.get("STATE_DIRECTORY", "").split(":")
    return Path(folders[1]) if len(folders) > 1 else keys.absolute().parent / "witness"


def _open_lines(section: Link, codes: LinkCodes, clock: SystemClock, stack: ExitStack) -> list[Line]:
    """Open the configured communication lines, which `stack` closes.

    Raises UsageError if an address cannot be bound, and DeviceError if the serial port cannot be used.
    """
    peers, lines = peer_networks(section), list[Line]()

    def add(line: Line) -> None:
        stack.callback(line.close)
        lines.append(line)

    if section.udp is not None:
        add(UdpLine(section.udp, section.telemetry_to, peers, codes))
    if section.tcp is not None:
        add(TcpLine(section.tcp, peers, codes.on_board()))
    if section.serial is not None:
        device, baud = section.serial.device, section.serial.baud
        port = PySerialPort(device, baud, clock, patient=True, write_timeout=_WRITE_TIMEOUT_S)
        add(SerialLine(section.serial.device, port, codes.on_board(section.serial.kiss)))
    if section.kiss is not None:
        add(TncLine(section.kiss, codes.on_board(kiss=True)))
    return lines


class _LoopbackLine:
    """Line to a ground station in the same process, because the build sandbox of a release has no network."""

    name = "self-test"

    def __init__(self, frame: bytes) -> None:
        self.answers = 0
        self._frames = [(frame, None)]

    def receive(self) -> list[tuple[bytes, Any]]:
        received, self._frames = self._frames, []
        return list(received)

    def trust(self, sender: Any, now_ns: int) -> None:
        pass

    def send(self, frames: Sequence[bytes], now_ns: int) -> int:
        self.answers += len(frames)
        return len(frames)

    def close(self) -> None:
        pass


def self_test() -> None:
    """Test a release: run a link until it has executed one command. Raises KnightCubeError after 20 s."""
    with tempfile.TemporaryDirectory(prefix="knightcube-") as name:
        folder = Path(name)
        keys = [folder / "satellite" / "keys", folder / "ground"]
        shared = [Association(spi, 1, 0, new_key()) for spi in (*COMMAND_SPIS, *TELEMETRY_SPIS)]
        for place in keys:
            place.mkdir(parents=True)
            for association in shared:
                Vault(place).write(association)
        settings = StationSettings(1, LONGEST_FRAME, 1e5)
        packet = directives.pack(Listing(), 0)
        length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + len(packet) + CRC_BYTES
        header = TelecommandHeader(settings.spacecraft, 0, 0).pack(length)
        frame, _ = Sealer(Vault(keys[1]), COMMAND_SPIS[0], TELECOMMAND_MASK).seal(header, packet)
        line = _LoopbackLine(close_frame(frame))
        control: ControlLine[Sent] = ControlLine(folder / "commands", folder)
        clock = SystemClock()
        station = Station(settings, Vault(keys[0]), [line], control, LogFollower(folder), clock)
        for _ in range(1000):
            station.turn()
            if station.obeyed and line.answers:
                return
            clock.sleep_until_ns(clock.now_ns() + SECOND_NS // 50)
    raise KnightCubeError("self-test: the link executed no command")


def _say(text: str) -> None:
    """Write a line to standard error; a full disk does not end the link."""
    with suppress(OSError):
        sys.stderr.write(f"knightcube: {text}\n")
        sys.stderr.flush()
