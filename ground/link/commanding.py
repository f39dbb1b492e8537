"""Commands to a flight over its socket or link, with verification, key changes and file transfers."""

from __future__ import annotations

import argparse
import hashlib
import os
import socket
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from flight.link.files import units
from flight.link.files.store import FileError, Store, write_whole
from flight.link.files.transfer import CRC32, GROUND, LONGEST_FILE, NOBODY, SATELLITE, Entity, Progress
from flight.link.frames import LONGEST_FRAME, TELECOMMAND_MASK
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage
from flight.link.process.directives import Directive, NewKey, SendFile
from flight.link.process.filing import LISTING
from flight.link.security import (
    COMMAND_SPIS,
    NEXT,
    USED_KEY,
    Association,
    Gate,
    Refusal,
    Sealer,
    Vault,
    may_change,
    new_key,
)
from flight.link.telemetry.definitions import TRANSFER, VERIFICATION
from flight.link.telemetry.log import SUFFIX
from flight.link.telemetry.packets import LAYOUTS, LONGEST_PACKET, row_of
from flight.schema.document import config_path
from flight.schema.reader import load
from flight.schema.sections import Link
from ground.link.terminal import (
    ADDRESSES,
    DEFAULTS,
    FRAME_OVERHEAD_BYTES,
    KEEP_ALIVE_S,
    Terminal,
    TerminalSettings,
    open_terminal,
    report_of,
)
from ground.telemetry import text_of
from knightcube.errors import KnightCubeError, UsageError, reason_of

Show = Callable[[Report], object]
_BLOCK = 64  # number of frame counters reserved at once, because each reservation takes two disk writes
_SILENCE_S = 5.0
"""Time (s) without telemetry after which the ground sends a ping while it awaits the reports on a command."""
_STATUS_S = 1.5  # longest time (s) to wait for the packet `link`, which is sent once a second
_REASON_NS = 2_000_000_000  # longest time (ns) to wait for the satellite's reason for the end of a transfer
_REPEAT_NS = 5_000_000_000  # time (ns) after which an unanswered command is sent again
_HIGHEST_PORT = 65535
_BURST_S = 0.05  # longest time (s) over which unused transmission capacity accumulates
_VERIFICATION = LAYOUTS[VERIFICATION.name].identifier.to_bytes(2, "big")
_TRANSFER = LAYOUTS[TRANSFER.name].identifier.to_bytes(2, "big")


def flight_address(to: str) -> str | tuple[str, int]:
    """Return the path of a flight's UNIX socket, or host and port of its UDP address HOST:PORT.

    Raises UsageError for a file that is not a socket, and for a port that does not exist. A path without a
    file is returned, because the flight may create the socket later.
    """
    host, _, port = to.rpartition(":")
    path = Path(to)
    if path.exists() and not path.is_socket():
        cure = "give the command socket of a flight (`commands.socket` of its configuration), or HOST:PORT"
        raise UsageError(f"{to}: is not a socket: {cure}")
    if path.exists() or not (host and port.isascii() and port.isdigit()):
        return to
    if not 0 < int(port) <= _HIGHEST_PORT:
        raise UsageError(f"{to}: port {port}: give a port from 1 to {_HIGHEST_PORT}")
    return host, int(port)


def exchange(to: str, data: bytes, timeout: float) -> bytes:
    """Send a packet to a flight process at a UNIX socket or UDP address HOST:PORT, and return the answer.

    Raises KnightCubeError if no answer arrives within `timeout` s, and UsageError for an invalid address or
    timeout.
    """
    check_timeout(timeout)
    address = flight_address(to)
    if isinstance(address, tuple):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            return _ask(line, address, data, timeout, to)
    # A flight that runs as a service has no access to /tmp, but it can answer to a socket in its own folder.
    beside = Path(to).absolute().parent
    place = beside if beside.is_relative_to("/run") and os.access(beside, os.W_OK | os.X_OK) else None
    with (
        tempfile.TemporaryDirectory(prefix="knightcube-", dir=place) as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line,
    ):
        own = os.path.join(folder, "answer")
        os.chmod(folder, 0o711)  # the flight software may run as another user
        line.bind(own)
        os.chmod(own, 0o777)
        return _ask(line, to, data, timeout, to)


def _ask(line: socket.socket, address: str | tuple[str, int], data: bytes, timeout: float, to: str) -> bytes:
    line.settimeout(timeout)
    try:
        line.sendto(data, address)
    except OSError as error:
        reason = error.strerror or error
        cure = "check that the flight runs, and its `commands.socket` or `commands.udp`"
        raise KnightCubeError(f"{to}: no flight listens there ({reason}): {cure}") from error
    try:
        return line.recv(LONGEST_PACKET)
    except OSError as error:
        raise KnightCubeError(f"{to}: no answer within {timeout:g} s: check that the flight runs") from error


def add_link_options(parser: argparse.ArgumentParser, way: argparse._MutuallyExclusiveGroup) -> None:
    """Add the option `--link` to the group of flight addresses, and the link's settings to the parser."""
    text = f"link of the flight: {ADDRESSES}"
    way.add_argument("--link", metavar="ADDRESS", help=text)
    parser.add_argument("--keys", type=Path, metavar="FOLDER", help="keys of the ground, needed with --link")
    text = "configuration of the flight, whose section `link` describes frames and their coding"
    parser.add_argument("--config", type=config_path, metavar="CONFIG", help=text)
    text = f"spacecraft identifier of the link (default that of --config, or {DEFAULTS.spacecraft})"
    parser.add_argument("--spacecraft", type=int, metavar="N", help=text)
    text = f"length of the link's telemetry frames (default that of --config, or {DEFAULTS.frame_bytes})"
    parser.add_argument("--frame-bytes", type=int, metavar="N", help=text)


def check_timeout(seconds: float) -> None:
    """Raise UsageError unless the time to wait is a positive finite number."""
    if not 0.0 < seconds < float("inf"):
        raise UsageError(f"--timeout {seconds}: must be a positive number of seconds")


def ground_files_folder(keys: Path) -> Path:
    """Return the ground's folder for transferred files: keys/ground-files if `keys` is keys/ground.

    The folder differs from the satellite's (`files_folder` of `flight.link.files.store`), so that both ends
    can run on one machine.
    """
    folder = keys.absolute()
    return folder.with_name(f"{folder.name}-files")


def terminal_of(options: argparse.Namespace) -> Terminal:
    """Return the link to the satellite that the command-line options describe.

    Raises UsageError for invalid options, and KnightCubeError if the link cannot be opened.
    """
    if options.keys is None:
        raise UsageError("--link needs --keys, the ground's folder of `knightcube keys`")
    section = DEFAULTS if options.config is None else load(options.config).link
    if section is None:
        raise UsageError(f"{options.config}: has no section `link`: give the flight's configuration")
    settings = TerminalSettings.of(section)
    hints = get_type_hints(Link, include_extras=True)
    for name in ("spacecraft", "frame_bytes"):
        if (value := getattr(options, name)) is not None:
            (limits,) = hints[name].__metadata__
            if not limits.ge <= value <= limits.le:
                raise UsageError(f"--{name.replace('_', '-')} {value}: must be {limits.ge} to {limits.le}")
            settings = replace(settings, **{name: value})
    return open_terminal(options.link, options.keys, settings)


def obeyed(reports: list[Report]) -> bool:
    """Return whether the last report on a command shows that its execution has started or is complete."""
    return bool(reports) and reports[-1].stage in {Stage.STARTED, Stage.COMPLETED}


def failed(reports: list[Report]) -> str:
    """Return the reason why a command failed, or an empty text."""
    bad = {Stage.REFUSED, Stage.FAILED, Stage.REPEATED}
    return next((explained(report) for report in reports if report.stage in bad), "")


def explained(report: Report) -> str:
    """Return the text of a report, with a remedy if the counter of the command's frame was used before."""
    if report.stage is not Stage.REPEATED:
        return report.text
    return (
        f"{report.text}: the counter in the ground's folder of keys was too low, because the folder is an "
        "older copy; telemetry raises the counter: send the command again"
    )


def no_answer(gate: Gate, seconds: float) -> KnightCubeError:
    """Return the error, with possible causes, for a command on which no report arrived within `seconds` s.

    The causes depend on the numbers of telemetry frames that `gate` has accepted and refused.
    """
    foreign, forged = gate.refused[Refusal.HEADER], gate.refused[Refusal.MAC]
    if gate.admitted:
        cause = "telemetry arrives, but the command or its reports were lost"
    elif foreign + forged:
        which = "another spacecraft (--spacecraft)" if foreign > forged else "other keys (--keys)"
        cause = f"{foreign + forged} frames of {which} were received"
    else:
        cause = (
            "no telemetry frame was received: check the address of --link, and that the link runs; the "
            "satellite does not answer frames with other --keys, with another --spacecraft or, from an older "
            f"copy of the keys, with counters that were used: `--spi {COMMAND_SPIS[1]} ping` renews these"
        )
    return KnightCubeError(
        f"no answer over the link within {seconds:g} s: {cause}; look at the "
        "telemetry before you send the command again, because it may have been executed"
    )


def command(
    terminal: Terminal,
    packet: bytes,
    spi: int,
    seconds: float,
    show: Show,
    ended: Callable[[list[Report]], bool] = lambda _: False,
) -> list[Report]:
    """Send a command, `show` its reports and return them. Raises KnightCubeError if no report arrives.

    The call ends with the final report, as soon as `ended` returns true for the received reports, or after
    `seconds` s. A ping is sent after each silence and every `KEEP_ALIVE_S`, because a link process that
    restarts, or that receives no frame for a minute, forgets the UDP address of the ground. Afterwards, the
    counters of the ground are raised above those of the satellite if the frame's counter was used before, or
    if the reserve SPI is used.
    """
    found = _followed(terminal, packet, spi, seconds, show, ended)
    if spi == COMMAND_SPIS[1] or any(report.stage is Stage.REPEATED for report in found):
        terminal.learn_counters(_STATUS_S)
        for lost in terminal.lost_spis:
            cure = f"set a new key by `--spi {COMMAND_SPIS[1]} new-key {lost}`"
            sys.stderr.write(f"knightcube: the satellite has lost the counter of SPI {lost}: {cure}\n")
    return found


def _followed(
    terminal: Terminal,
    packet: bytes,
    spi: int,
    seconds: float,
    show: Show,
    ended: Callable[[list[Report]], bool],
) -> list[Report]:
    """Send a command, `show` its reports and return them, see `command`."""
    counter, packer, found = terminal.send(packet, spi), CommandPacker(), list[Report]()
    left, idle = seconds, 0.0  # `idle` is the time (s) since the last frame to the satellite
    while left > 0.0:
        wait, heard = min(left, _SILENCE_S), terminal.gate.admitted
        left, idle = left - wait, idle + wait
        for report in terminal.follow(counter, spi, wait, reported=bool(found)):
            show(report)
            found.append(report)
            if ended(found) or report.stage.final or report.stage is Stage.REPEATED:
                return found
        if left > 0.0 and (terminal.gate.admitted == heard or idle >= KEEP_ALIVE_S):
            idle = 0.0
            with suppress(KnightCubeError):  # the reports may arrive even if the ping fails
                terminal.send(packer.pack(Ping(), utc_ns()), spi)
    if not found:
        raise no_answer(terminal.gate, seconds)
    return found


def change_key(
    terminal: Terminal, vault: Vault, changed: int, spi: int, seconds: float, show: Show
) -> list[Report]:
    """Change the key of SPI `changed` by a command that is protected with the key of `spi`.

    The new key is stored on the ground before it is sent, and replaces the old key when the satellite has
    confirmed it. If the result of an earlier change is unknown, a ping with the new key of that change is
    sent first. Raises UsageError if the satellite would refuse the change, and KnightCubeError if the new key
    cannot be stored or no answer arrives.
    """
    if not may_change(spi, changed):
        raise UsageError(
            f"new-key {changed}: only the reserve SPI may change its own key: add --spi {COMMAND_SPIS[1]}"
        )
    old, name = vault.read(changed), f"{changed}-{NEXT}"
    if old is None:
        raise UsageError(f"both copies of SPI {changed} are lost on the ground too: make new keys")
    following = vault.read(name)
    if following is not None and changed in COMMAND_SPIS:
        sealer = Sealer(vault, name, TELECOMMAND_MASK)
        counter = terminal.send_by(sealer, CommandPacker().pack(Ping(), utc_ns()))
        reports = list(terminal.follow(counter, changed, seconds))
        if obeyed(reports):
            _promote(vault, changed)
            return reports
        following = vault.read(name)
    if following is None or following.generation != old.generation + 1:
        following = Association(changed, old.generation + 1, 0, new_key())
        _store(vault, following, name)
    packet = directives.pack(NewKey(changed, following.generation, following.key), utc_ns())
    reports = command(terminal, packet, spi, seconds, show)
    if obeyed(reports) and changed in COMMAND_SPIS:
        _promote(vault, changed)
    elif USED_KEY in failed(reports):  # the satellite never accepts this key: the next attempt makes another
        vault.remove(name)
    return reports  # a new telemetry key is accepted at the first frame that uses it


def _promote(vault: Vault, spi: int) -> None:
    with vault.locked():
        following = vault.read(f"{spi}-{NEXT}")
        if following is not None:
            _store(vault, following, spi)
            vault.remove(f"{spi}-{NEXT}")


def _store(vault: Vault, association: Association, name: int | str) -> None:
    """Store a new key under a name. Raises KnightCubeError if no copy can be written."""
    if vault.write(association, name) == 0:
        raise KnightCubeError(
            f"{vault.folder}: the new key of SPI {association.spi} cannot be stored: make room on the disk, "
            f"and send new-key {association.spi} again"
        )


class FileSession:
    """Session of file commands and transfers over one terminal, for use by one thread.

    Received data is written to disk at once, so that the next session can continue an interrupted transfer.

    Attributes:
        entity: CFDP entity of the ground.
        received: folder of the received files.
        received_ns: time of the last received packet, ns.
    """

    def __init__(self, terminal: Terminal, store: Store, spi: int, rate: float, now_ns: int) -> None:
        """Create a session that sends at most `rate` bytes/s of frames. Raises KnightCubeError."""
        self._terminal = terminal
        self._rate, self._spi = rate, spi
        self._sealer = terminal.sealer(spi, _BLOCK)
        self._units = units.UnitPacker(units.UP)
        self._wanted = {LISTING}
        self._store, self.received = store, store.received
        unit_bytes = terminal.packet_bytes - units.UNIT_OVERHEAD_BYTES
        self.entity = Entity(GROUND, store, self._may_come, LONGEST_FILE, now_ns, unit_bytes)
        self.received_ns = now_ns
        self._texts: dict[tuple[int, int], str] = {}
        self._asked: tuple[Directive, int] | None = None
        self._failed: list[tuple[Progress, int]] = []  # failed transfers, with timeouts (ns) of the reasons
        self._earlier: set[tuple[int, int]] = set()  # transfers to the ground that were open at the request
        self._counters: set[int] = set()
        self._reports: deque[Report] = deque()
        self._unsent = b""  # packet that could not be sent yet
        self._packer, self._sent_ns = CommandPacker(), now_ns  # for pings; time of the last sent packet
        self._credit, self._credit_ns = 0.0, now_ns  # transmission capacity at the last call of `transmit`

    def ask(self, directive: Directive, now_ns: int) -> None:
        """Send a command and repeat it until the satellite answers.

        Late reports on earlier commands are ignored, and the end of transfers that these began and that the
        satellite cancels, because the file has changed since then.
        """
        self._earlier = {(one.source, one.number) for one in self.entity.transfers() if not one.outgoing}
        self._counters.clear()
        self._reports.clear()
        self._send(directive, now_ns)

    def _send(self, directive: Directive, now_ns: int) -> None:
        self._asked = (directive, now_ns + _REPEAT_NS)
        if isinstance(directive, SendFile):
            self._wanted.add(directive.name)
        self._counters.add(self._send_packet(directives.pack(directive, utc_ns()), now_ns))

    def _send_packet(self, packet: bytes, now_ns: int) -> int:
        counter = self._terminal.send_by(self._sealer, packet)
        self._sent_ns = now_ns
        return counter

    def put(self, path: Path, name: str, now_ns: int) -> Progress:
        """Start or continue the transfer of a file to the satellite. Raises KnightCubeError."""
        return self.entity.send(path, name, SATELLITE, CRC32, utc_ns(), now_ns, NOBODY)

    def take(self, packets: Iterable[tuple[int, bytes]], now_ns: int) -> None:
        """Process received telemetry, given as pairs of virtual channel and packet."""
        for _, packet in packets:
            self.received_ns = now_ns
            if units.is_unit(packet, units.DOWN):
                try:
                    self.entity.take(units.unit_of(packet), now_ns)
                except units.PduError:  # the satellite's software release may define other PDUs
                    continue
            elif packet[:2] == _VERIFICATION:
                report = report_of(packet)
                # If a counter was used before, the command is sent again with a higher counter.
                if report is None or report.spi != self._spi or report.counter not in self._counters:
                    continue
                if report.stage is not Stage.REPEATED:
                    if report.stage is not Stage.ACCEPTED:
                        self._asked = None
                    self._reports.append(report)
            elif packet[:2] == _TRANSFER:
                row = row_of(TRANSFER, packet)
                if row is not None:
                    self._texts[int(row["source"]), int(row["number"])] = text_of(row["text"])

    def transmit(self, now_ns: int) -> None:
        """Send due commands and PDUs within the rate limit, or a ping if none were due for `KEEP_ALIVE_S`.

        Raises KnightCubeError if a packet cannot be sent. The next call then sends the packet again.
        """
        self.entity.work(now_ns)
        self.entity.keep(now_ns)
        if self._asked is not None and now_ns >= self._asked[1]:
            self._send(self._asked[0], now_ns)
        self._credit += self._rate * (now_ns - self._credit_ns) * 1e-9
        self._credit = min(self._credit, max(self._rate * _BURST_S, 2.0 * LONGEST_FRAME))
        self._credit_ns = now_ns
        while self._credit > 0.0:
            if not self._unsent and (unit := self.entity.unit(now_ns)) is not None:
                self._unsent = self._units.pack(unit, utc_ns())
            if not self._unsent:
                break
            self._send_packet(self._unsent, now_ns)
            self._credit -= len(self._unsent) + FRAME_OVERHEAD_BYTES
            self._unsent = b""
        if now_ns - self._sent_ns >= KEEP_ALIVE_S * 1e9:
            self._send_packet(self._packer.pack(Ping(), utc_ns()), now_ns)

    def _may_come(self, metadata: units.Metadata) -> str:
        """Return why a file from the satellite is rejected, or an empty text if it is accepted."""
        exists = (self.received / metadata.name).exists()
        return f"{metadata.name} exists" if exists and metadata.name not in self._wanted else ""

    def reports(self) -> list[Report]:
        """Return the reports on the commands since the last call."""
        found = list(self._reports)
        self._reports.clear()
        return found

    def reason_of(self, progress: Progress) -> str:
        """Return why a transfer ended: the reason that the satellite reported, or else the ground's own."""
        return self._texts.get((progress.source, progress.number), "") or progress.said

    def ended(self, name: str, number: int | None = None) -> bool:
        """Return whether a transfer of a file has ended, and forget all ended transfers.

        If `number` is given, only the transfer with this number is considered. Raises KnightCubeError with
        the reason if the transfer has failed.
        """
        found = [one for one in self.entity.ended if one.name == name and number in {None, one.number}]
        self.entity.ended.clear()
        for one in found:
            is_earlier = (
                one.condition == units.Condition.CANCELLED and (one.source, one.number) in self._earlier
            )
            if one.condition != 0 and not is_earlier:
                self._failed.append((one, self._credit_ns + _REASON_NS))
        for one, until in self._failed:
            # The satellite's reason is in the packet `transfer`, which may follow the end of the transfer.
            if (one.source, one.number) in self._texts or self._credit_ns >= until:
                raise KnightCubeError(f"{one.name}: {self.reason_of(one)}")
        return any(one.condition == 0 for one in found) and not self._failed

    def completed(self) -> bool:
        """Return whether the satellite has completed a command.

        Raises KnightCubeError for a failed command.
        """
        reports = self.reports()
        if problem := failed(reports):
            raise KnightCubeError(problem)
        return any(report.stage is Stage.COMPLETED for report in reports)

    def received_file(self, name: str) -> bool:
        """Return whether a file has been received completely.

        Raises KnightCubeError if the transfer has failed.

        The satellite reports a transfer as completed after the ground has received the file.
        """
        completed = self.completed()
        return self.ended(name) or completed

    def close(self, now_ns: int) -> None:
        """Store the received data; the beginning of an incomplete log is stored as a received log.

        A flight log is readable up to its last whole packet, so that its beginning can be evaluated before
        the transfer is complete. Raises FileError if the disk cannot be written.
        """
        self.entity.close(now_ns)
        for record in self._store.incoming():
            if record.finished is None and record.name is not None and record.name.endswith(SUFFIX):
                count = next((end for begin, end in record.ranges if begin == 0), 0)
                place = self._store.received / record.name
                try:
                    if count > (place.stat().st_size if place.exists() else 0):
                        place.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                        with self._store.part(record).open("rb") as file:
                            write_whole(place, file.read(count))
                except OSError as error:
                    raise FileError(f"{place}: cannot be written: {reason_of(error)}") from error


def sha256_of(path: Path) -> bytes:
    """Return the SHA-256 of a file. Raises KnightCubeError if the file cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError as error:
        raise KnightCubeError(f"{path}: {reason_of(error)}") from error
