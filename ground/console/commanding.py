"""Commands from the console's forms to a flight over a socket or a link, and files of the satellite."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from flight.app.run import utc_ns
from flight.link import commands
from flight.link.events import Mode
from flight.link.files.store import FileError, Store, problem_of_name
from flight.link.process import directives
from flight.link.process.commanding import Report, Stage, utc_of
from flight.link.process.directives import KINDS, LIST, SCHEDULE, ListFiles, SendFile
from flight.link.process.downlink import LIVE, time_of
from flight.link.process.filing import LISTING
from flight.link.telemetry.definitions import LINK, RUN, TRANSFER, VERIFICATION, Field
from flight.link.telemetry.definitions import PARAMETER_FIELDS as PARAMETERS
from flight.link.telemetry.log import find_segments
from flight.link.telemetry.packets import LAYOUTS, Layout, Packer, PacketArray, TelemetryError
from flight.schema.document import read_text
from flight.schema.reader import merged_text, parse
from flight.schema.sections import Commands
from ground.console.history import values
from ground.documentation import Body, commands_for, foreign_modes, layouts_for
from ground.link.commanding import FileSession, exchange, explained, no_answer, obeyed, sha256_of
from ground.link.terminal import KEEP_ALIVE_S, Terminal, report_of
from ground.telemetry import decode, scan
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import KnightCubeError, UsageError

Object = dict[str, Any]
Send = Callable[[bytes], Object]
"""Function that sends a command packet and returns the answer with `obeyed` and `text`. Raises
KnightCubeError."""
_TIMEOUT_S = 3.0  # longest time (s) to wait for an answer from a socket
_LISTEN_S = 0.02  # longest time (s) to wait in one read of a link
_RESTART_NS = 10 * SECOND_NS
"""Decrease of the mission time (ns) that shows a restart of the flight; delays of packets are shorter."""
_RUN, *_OF_THE_LINK = (
    LAYOUTS[packet.name].identifier.to_bytes(2, "big") for packet in (RUN, LINK, VERIFICATION, TRANSFER)
)
"""First bytes of each packet of type `run`, and of each packet that the link process makes."""
_PING_AFTER_S = 2.0
"""Time (s) without telemetry after which a ping is sent, because a link that restarts forgets the ground."""
_ANSWER_S = 5.0  # longest time (s) to wait for the report on a command over the link
_KEPT_REPORTS = 64
_SPI = 1
_START_S, _END_S = 60.0, 15.0
"""Longest times (s) to wait for the start and the end of a flight that the console started."""
_FRAMES = 60  # number of camera frames that a flight started by the console keeps for the page
_CAMERA = re.compile(r"(?m)^(camera:[^\n]*)$(?!(?:\n[ #][^\n]*)*?\n  keep_frames:)(?=\n  )")
"""Pattern of the first line of a section `camera` without the key `keep_frames`."""


def by_socket(to: str) -> Send:
    """Return a function that sends commands to the UNIX socket or to the HOST:PORT of a flight."""

    def send(packet: bytes) -> Object:
        answers = decode(exchange(to, packet, _TIMEOUT_S))["command"]
        if not len(answers):
            raise KnightCubeError(f"{to}: the answer has no report on the command")
        return values(answers[-1])

    return send


class CommandForms:
    """Sender of commands, which packs the values of the page's forms into command packets."""

    def __init__(self, send: Send | None, layouts: Mapping[str, Layout] = commands.LAYOUTS) -> None:
        """Accept the commands of `layouts`; the console is read-only if `send` is None.

        The attribute `body` is the kind of body, or None if unknown. Only commands for this kind of body are
        accepted.
        """
        self._send = send
        self._layouts = layouts
        self.body: Body | None = None
        self._packer = Packer(dict(layouts))

    @property
    def possible(self) -> bool:
        """Whether the console can send commands."""
        return self._send is not None

    def table(self) -> list[Object]:
        """Return the commands that the controlled body accepts, each with the inputs of its web form."""
        return commands_for(self.body, self._layouts)

    def text(self, name: str, given: Object) -> str:
        """Return a command as text for its confirmation. Raises UsageError for invalid values."""
        return _text_of(self._pack(name, given))

    def obey(self, name: str, given: Object) -> Object:
        """Send a command and return the answer.

        Raises UsageError for invalid values, and KnightCubeError if no answer arrives.
        """
        if self._send is None:
            raise UsageError("this console is read-only: start it with --to or --link to send commands")
        return self._send(self._pack(name, given))

    def _pack(self, name: str, given: Object) -> bytes:
        layouts = layouts_for(self.body, self._layouts)
        if name not in layouts:
            raise UsageError(f"{name}: no such command; the commands are {', '.join(layouts)}")
        packet = layouts[name].packet
        unknown = sorted(set(given) - {field.name for field in packet.fields})
        if unknown:
            raise UsageError(f"{name}: no such value: {', '.join(unknown)}")
        if name == commands.LOAD_PARAMETERS.name and not given.get("crc"):
            # The CRC of the parameters is computed here unless the operator has entered it.
            parameters = [float(_value(name, field, given.get(field.name))) for field in PARAMETERS]
            given = {**given, "crc": commands.crc_of(parameters)}
        fields = {field.name: _value(name, field, given.get(field.name)) for field in packet.fields}
        try:
            data = self._packer.pack(packet, utc_ns(), fields)
            _text_of(data)
            self._check(name, fields)
        except (TelemetryError, commands.CommandError) as error:
            raise UsageError(str(error)) from error
        return data

    def _check(self, name: str, fields: Object) -> None:
        """Raise UsageError or CommandError for values that the body or the command schedule refuses."""
        if name == commands.MODE.name and (mode := Mode(fields["mode"])) in foreign_modes(self.body):
            raise UsageError(f"mode {mode.label}: this body has no such mode")
        if name == commands.CLEAR.name and (problem := commands.event_problem(fields["event"])):
            raise UsageError(f"clear: {fields['event']!r} {problem}")
        if name == SCHEDULE.name:
            if utc_of(fields["at"]) <= utc_ns():
                raise UsageError(f"schedule: {fields['at']} has passed")
            command = commands.command_of_words(fields["words"])
            if command.packet.name not in layouts_for(self.body, self._layouts):
                raise UsageError(f"schedule: this body does not accept {command.packet.name}")
            self._check(command.packet.name, command.fields)


def _text_of(data: bytes) -> str:
    """Return a text that describes a command packet. Raises CommandError for invalid values."""
    directive = directives.unpack(data)
    if isinstance(directive, directives.Scheduled):
        return f"at {directive.at}: {commands.command_of_words(directive.words)}"
    return str(commands.unpack(data) if directive is None else directive)


def _value(name: str, field: Field, given: Any) -> Any:
    """Return a field's value. An empty input is NaN in a field that permits NaN. Raises UsageError."""
    if field.count > 1 and field.kind == "u1" and isinstance(given, str):
        return _bytes(name, field, given)
    if field.count > 1:
        items = list(given) if isinstance(given, list) else [given] if given is not None else []
        if len(items) > field.count:
            raise UsageError(f"{name}: {field.name} has {len(items)} values: give at most {field.count}")
        return [_number(name, field, item) for item in [*items, *[None] * field.count][: field.count]]
    return str(given or "") if field.kind.startswith("S") else _number(name, field, given)


def _bytes(name: str, field: Field, given: str) -> list[int]:
    """Return the bytes of a field from hexadecimal digits. Raises UsageError."""
    try:
        found = bytes.fromhex(given)
    except ValueError:
        found = b""
    if len(found) != field.count:
        raise UsageError(f"{name}: {field.name} needs {2 * field.count} hexadecimal digits: {field.meaning}")
    return list(found)


def _number(name: str, field: Field, given: Any) -> float | int:
    real = field.kind.startswith("f")
    if given is None or given == "":
        if real:
            return math.nan
        raise UsageError(f"{name}: {field.name} is missing: {field.meaning}")
    try:
        if isinstance(given, bool):
            raise TypeError
        if not real and isinstance(given, float) and not given.is_integer():
            raise ValueError
        return float(given) if real else int(given)
    except (TypeError, ValueError, OverflowError) as error:
        needed = "a number" if real or isinstance(given, bool) else "a whole number"
        raise UsageError(f"{name}: {field.name} = {given!r:.40} is not {needed}: {field.meaning}") from error


class LinkFeed:
    """Live telemetry and commands over a link. One thread calls `new`, and other threads may call `send`.

    Played-back packets are not shown, because they are older than the live packets. The attribute `lock`
    protects the terminal and an open file session.

    Attributes:
        restarts: number of restarts of the flight that the packets have shown.
    """

    behind = False

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self.lock = threading.Lock()
        self._session: FileSession | None = None
        self._packer = commands.CommandPacker()
        self._reports: dict[int, list[Report]] = {}
        self._received = time.monotonic()
        self._asked = -np.inf
        self._run = b""  # newest packet `run`
        self._run_changed = False  # whether the newest packet `run` differs from its predecessor
        self._newest_ns = 0  # newest mission time
        self.restarts = 0

    @property
    def problem(self) -> str:
        """Reason why the newest packet could not be sent, or an empty text."""
        return self._terminal.problem

    @property
    def failing(self) -> float:
        """Time (s) since the first failure to send after the last success, or 0."""
        return self._terminal.failing

    @property
    def silence(self) -> float:
        """Time (s) since the last telemetry."""
        return time.monotonic() - self._received

    def new(self) -> dict[str, PacketArray]:
        """Return the packets received since the last call, by name.

        If the flight software was restarted since then, only the packets after the restart are returned. A
        failure to send is stored in `problem`, because telemetry may still arrive. Raises FileError if the
        disk of the file transfers fails.
        """
        with self.lock:
            now = time.monotonic()
            is_silent = now - max(self._received, self._asked) > _PING_AFTER_S
            if is_silent or now - self._asked > KEEP_ALIVE_S:
                self._asked = now
                with contextlib.suppress(KnightCubeError):
                    self._terminal.send(self._packer.pack(commands.Ping(), utc_ns()), _SPI)
            packets = list[tuple[int, bytes]]()
            with contextlib.suppress(KnightCubeError):  # the next ping opens a lost line again
                for packet in self._terminal.packets(_LISTEN_S):
                    packets.append(packet)
            if self._session is not None:
                self._session.take(packets, time.monotonic_ns())
                try:
                    self._session.transmit(time.monotonic_ns())
                except FileError:
                    raise
                except KnightCubeError:  # the error is in `problem`, and CFDP repeats lost segments
                    pass
            live = [packet for channel, packet in packets if channel == LIVE]
        if live:
            self._received = time.monotonic()
        for row in scan(b"".join(live)).packets[VERIFICATION.name]:
            report = report_of(row.tobytes())
            if report is not None and report.spi == _SPI:
                earlier = self._reports.setdefault(report.counter, [])
                if report.stage is not Stage.REPEATED or not earlier:
                    earlier.append(report)
        while len(self._reports) > _KEPT_REPORTS:
            del self._reports[next(iter(self._reports))]
        return scan(b"".join(self._since_restart(live))).packets

    def _since_restart(self, packets: list[bytes]) -> list[bytes]:
        """Return the packets after the last restart of the flight, or all packets if there was no restart.

        A restart is shown by a different packet `run` that is followed by a decrease of mission time. Neither
        is sufficient alone: a packet `run` may correct the UTC, and a link process that restarts repeats
        packets of the flight.
        """
        first = 0
        for place, packet in enumerate(packets):
            kind = packet[:2]
            if kind == _RUN:
                self._run_changed |= packet != self._run
                self._run = packet
            elif kind not in _OF_THE_LINK:
                time_ns = time_of(packet)
                if self._run_changed and time_ns < self._newest_ns - _RESTART_NS:
                    self.restarts += 1
                    self._newest_ns, first = 0, place
                self._run_changed = False
                self._newest_ns = max(self._newest_ns, time_ns)
        return packets[first:]

    def send(self, packet: bytes) -> Object:
        """Send a command and return its state after acceptance.

        Raises KnightCubeError if no report arrives.
        """
        with self.lock:
            counter = self._terminal.send(packet, _SPI)
            self._reports.pop(counter, None)  # reports on a frame with an earlier key
        until = time.monotonic() + _ANSWER_S
        while time.monotonic() < until:
            reports = list(self._reports.get(counter, ()))
            lists = bool(reports) and reports[-1].name == LIST.name
            # A list command is answered by one report `started` per line, and then by `completed`.
            awaited = {Stage.ACCEPTED, Stage.STARTED} if lists else {Stage.ACCEPTED}
            if reports and reports[-1].stage not in awaited:
                listed = reports[1:] if lists else reports[-1:]
                text = "; ".join(explained(report) for report in listed)
                return {"obeyed": int(obeyed(reports)), "text": text, "counter": counter}
            time.sleep(0.02)
        raise no_answer(self._terminal.gate, _ANSWER_S)

    @contextlib.contextmanager
    def transferring(self, store: Store, rate: float) -> Iterator[FileSession]:
        """Yield a session of file transfers, to which `new` passes the received packets.

        Raises KnightCubeError.
        """
        with self.lock:
            session = FileSession(self._terminal, store, _SPI, rate, time.monotonic_ns())
            self._session = session
        try:
            yield session
        finally:
            with self.lock:
                self._session = None
                session.close(time.monotonic_ns())

    def close(self) -> None:
        """Store the frame counters and close the line."""
        self._terminal.close()


class FlightProcess:
    """Flight that the console started.

    Attributes:
        socket: path of the flight's command socket.
    """

    def __init__(self, socket: str, process: subprocess.Popen[str], errors: Path) -> None:
        """Observe a process whose standard error is written to the file `errors`."""
        self.socket = socket
        self._process, self._errors = process, errors
        self._trouble = ""

    def trouble(self) -> str:
        """Return the reason why the process failed, or an empty text while it runs or after a clean end."""
        code = self._process.poll()
        if code and not self._trouble:
            said = [line for line in self.errors().splitlines() if line.strip()][-1:] if code > 0 else []
            how = f"was killed by signal {-code}" if code < 0 else f"ended with exit status {code}"
            self._trouble = f"the flight process {how}: {said[0] if said else 'start the console again'}"
        return self._trouble

    def errors(self) -> str:
        """Return the text that the flight has written to standard error, including its progress lines."""
        return self._errors.read_text(encoding="utf-8", errors="replace").strip()


@contextlib.contextmanager
def flying(config: Path, out: Path) -> Iterator[FlightProcess]:
    """Fly a simulated configuration in real time with logs in `out`, and yield the process of the flight.

    The flight ends when the context is left. Raises UsageError if `out` contains a flight, and
    KnightCubeError if the flight does not start, or has failed when the context is left.
    """
    if out.is_dir() and find_segments(out, "flight"):
        raise UsageError(f"{out} already contains a run: give a new folder, or show this run without --fly")
    text = merged_text(read_text(config), str(config))
    parsed = parse(text, str(config))
    if parsed.simulation is None:
        raise UsageError(f"{config}: has real devices; start the flight separately and give its run folder")
    if parsed.commands != Commands():
        raise UsageError(f"{config}: has `commands`; start the flight separately and give --to")
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        own, errors = Path(place) / config.name, Path(place) / "errors"
        text = _CAMERA.sub(rf"\1\n  keep_frames: {_FRAMES}", text)
        own.write_text(f"{text}\ncommands: {{socket: {place}/commands}}\n", encoding="utf-8")
        words = [sys.executable, "-m", "flight", "run", str(own), "--realtime", "--out", str(out)]
        # A pipe that nobody reads would be full after hours of progress lines, and would block the flight.
        with errors.open("w", encoding="utf-8") as file:
            process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=file, text=True)
        flight = FlightProcess(f"{place}/commands", process, errors)
        try:
            _await_log(flight, process, out)
            yield flight
        finally:
            failed = flight.trouble()
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if failed:
            raise KnightCubeError(failed)


def _await_log(flight: FlightProcess, process: subprocess.Popen[str], out: Path) -> None:
    """Wait for the log of a flight. Raises KnightCubeError if the flight ends or does not write a log."""
    until = time.monotonic() + _START_S
    while not (out.is_dir() and find_segments(out, "flight")):
        if process.poll() is not None:
            raise KnightCubeError(f"the flight did not start: {flight.errors()}")
        if time.monotonic() > until:
            raise KnightCubeError(f"{out}: no flight log after {_START_S:g} s")
        time.sleep(0.05)


_T = TypeVar("_T")
_RATE = 40_000.0  # maximum rate of frames to the satellite (bytes/s)
_SILENCE_S = 30.0  # Time (s) without telemetry after which a transfer fails. The received data is kept.
_POLL_S = 0.05
_LINGER_S = 0.5
"""Time (s) after a transfer during which the satellite may request a repetition of the last answer."""
_MOST_FILES = 2000  # largest number of files in the list of a run's folder


class Files(Protocol):
    """Protocol for the files of a satellite, which the page lists and fetches."""

    puts: bool

    def listing(self) -> Object:
        """Return the files as {"files": [{"name", "bytes"}, ...]}. Raises KnightCubeError."""

    def get(self, name: str) -> Path:
        """Return the local copy of a file. Raises KnightCubeError, and UsageError for an invalid name."""

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Upload a file to the satellite. Raises KnightCubeError, and UsageError for an invalid name."""


class RunFiles:
    """Files in the folder of a run."""

    puts = False

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def listing(self) -> Object:
        """Return the files of the folder and its subfolders."""
        paths = [path for path in sorted(self._folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        files = []
        for path in paths[:_MOST_FILES]:
            with contextlib.suppress(FileNotFoundError):  # the flight may have deleted the file
                files.append(
                    {"name": path.relative_to(self._folder).as_posix(), "bytes": path.stat().st_size}
                )
        return {"files": files}

    def get(self, name: str) -> Path:
        """Return the path of a file. Raises UsageError if the folder has no file of this name."""
        if all(name != file["name"] for file in self.listing()["files"]):
            raise UsageError(f"{name!r:.80}: the run has no such file")
        return self._folder / name

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Raise UsageError, because files can be uploaded to a satellite only over its link."""
        raise UsageError(f"{kind}/{name}: uploading files to a satellite needs its link: start with --link")


class LinkFiles:
    """Files of a satellite over its link. Requests are executed one at a time."""

    puts = True

    def __init__(self, feed: LinkFeed, folder: Path) -> None:
        self._feed, self._folder = feed, folder
        self._one = threading.Lock()

    def listing(self) -> Object:
        """Request the list of files and return it. Raises KnightCubeError."""
        found: Object = json.loads(self._request(ListFiles(), LISTING).read_bytes())
        return found

    def get(self, name: str) -> Path:
        """Request a file and return its local copy.

        Raises UsageError for a wrong name, and KnightCubeError.
        """
        if problem := problem_of_name(name):
            raise UsageError(f"{name!r:.80}: {problem}")
        return self._request(SendFile(name), name)

    def put(self, kind: str, name: str, data: bytes) -> Object:
        """Upload a file to the satellite and return its name, size and SHA-256. Raises KnightCubeError."""
        full = f"{kind}/{name}"
        problem = problem_of_name(full) or ("" if kind in KINDS else f"the kind is one of {', '.join(KINDS)}")
        if problem:
            raise UsageError(f"{full!r:.80}: {problem}")
        with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
            path = Path(place) / name
            path.write_bytes(data)

            def send(session: FileSession) -> None:
                with self._feed.lock:
                    begun = session.put(path, full, time.monotonic_ns())
                self._wait(lambda: session.ended(full, begun.number))

            self._with_session(send)
            return {"name": f"received/{full}", "bytes": len(data), "sha256": sha256_of(path).hex()}

    def _request(self, directive: ListFiles | SendFile, name: str) -> Path:
        def receive(session: FileSession) -> Path:
            with self._feed.lock:
                session.ask(directive, time.monotonic_ns())
            self._wait(lambda: session.received_file(name))
            until = time.monotonic() + _LINGER_S
            while session.entity.transfers() and time.monotonic() < until:
                time.sleep(_POLL_S)
            return session.received / name

        return self._with_session(receive)

    def _with_session(self, work: Callable[[FileSession], _T]) -> _T:
        store = Store(self._folder)
        with self._one, store.owned(), self._feed.transferring(store, _RATE) as session:
            return work(session)

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until `done` returns true. Raises KnightCubeError after a long silence or failure to send."""
        while True:
            with self._feed.lock:
                if done():
                    return
            if self._feed.failing > _SILENCE_S:
                raise KnightCubeError(f"{self._feed.problem}; the received data is kept")
            if self._feed.silence > _SILENCE_S:
                raise KnightCubeError(f"no telemetry for {_SILENCE_S:g} s; the received data is kept")
            time.sleep(_POLL_S)
