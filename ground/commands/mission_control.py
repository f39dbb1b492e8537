"""The command `knightcube mission-control`, which runs Yamcs and the gateway for one satellite."""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, cast

from flight.app.service import EndingSignals
from flight.link.telemetry.definitions import RUN
from flight.link.telemetry.log import SUFFIX, find_runs, find_segments
from flight.link.telemetry.packets import HEADER_BYTES, SECONDARY_BYTES, walk
from flight.schema.document import config_path
from flight.schema.reader import load
from ground import yamcs
from ground.commands.elements import add_stations, predicted
from ground.commands.options import count, positive
from ground.link.commanding import terminal_of
from ground.link.gateway import Gateway, new_token, token_file, token_path
from ground.link.terminal import DEFAULTS, PORTS
from ground.telemetry import decode, flight_segments
from ground.xtce import EPOCH, epoch_of
from knightcube.errors import KnightCubeError, UsageError

if TYPE_CHECKING:
    from flight.schema.sections import Link
    from ground.documentation import Body
    from ground.passes import OrbitPrediction, Station

_ASK_S = 0.2  # interval (s) between two requests for the state of Yamcs
_START_S = 60.0  # longest time (s) to wait for the link, and for the flight
_RUNS, _FLIGHT = "runs", "the flight"
"""Folder of the runs of a simulated flight, and the name of its process in messages."""
_END_S = 30.0  # longest time (s) to wait for the end of Yamcs


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube mission-control` to the parser."""
    parser.description = (
        "Run the mission control system Yamcs for the satellite of a configuration. Yamcs gets the "
        "satellite's telemetry, limits and commands from this software, and reaches the satellite through a "
        "gateway in this process, which holds the keys. Yamcs archives all packets, raises alarms at the "
        "limits, transfers files, executes command stacks and, with --station or --stations, shows the "
        "passes on its timeline. Needs Java 17 and the extra `interop`. Loopback only. Ctrl-C ends."
    )
    parser.add_argument("config", type=config_path, metavar="CONFIG", help="configuration of the flight")
    way = parser.add_mutually_exclusive_group()
    text = "address of the satellite's link (default `link.udp`, or `link.tcp`, of CONFIG)"
    way.add_argument("--link", metavar="ADDRESS", help=text)
    text = "show the packets of a recorded run, without a link; RUN is a folder that `run --out` wrote"
    way.add_argument("--recorded", type=Path, metavar="RUN", help=text)
    text = "run the simulation of CONFIG and its link in real time, with output below --out"
    way.add_argument("--fly", action="store_true", help=text)
    text = "with --recorded: replay S seconds of the run per second, instead of all packets at once"
    parser.add_argument("--speed", type=positive, metavar="S", help=text)
    text = "keys of the ground (default %(default)s)"
    parser.add_argument("--keys", type=Path, default=yamcs.KEYS, metavar="FOLDER", help=text)
    text = "folder of Yamcs's configuration and archive (default %(default)s)"
    parser.add_argument("--out", type=Path, default=Path("mission-control"), metavar="FOLDER", help=text)
    text = "port of Yamcs's page (default %(default)s)"
    parser.add_argument("--port", type=count, default=yamcs.HTTP_PORT, metavar="PORT", help=text)
    text = f"UTC of mission time zero (default that of the flown or recorded run, otherwise {EPOCH})"
    parser.add_argument("--epoch", metavar="UTC", help=text)
    text = "file of two-line elements or OMM that predicts the passes (default `elements` of CONFIG)"
    parser.add_argument("--elements", type=Path, metavar="FILE", help=text)
    add_stations(parser)
    parser.set_defaults(command=run, spacecraft=None, frame_bytes=None)


def _check(options: argparse.Namespace) -> None:
    """Raise KnightCubeError if Yamcs is not installed, and UsageError for options that cannot be used."""
    if problem := yamcs.missing():
        raise KnightCubeError(problem)
    if options.speed is not None and options.recorded is None:
        raise UsageError("--speed: replays a recorded run: give --recorded RUN")
    if options.port >= PORTS:
        raise UsageError(f"--port {options.port}: must be 1 to {PORTS - 1}")
    options.epoch = None if options.epoch is None else epoch_of(options.epoch)


def run(options: argparse.Namespace) -> int:
    """Run Yamcs, and the gateway unless a run is replayed, until a signal arrives or Yamcs ends."""
    _check(options)
    packets = None if options.recorded is None else _packets(options.recorded)
    config = load(options.config)
    section = config.link
    body = cast("Body", config.body) if config.body in ("testbed", "orbit") else None
    frame_bytes = DEFAULTS.command_frame_bytes if section is None else section.command_frame_bytes
    if packets is None:
        options.link = options.link or _address(options.config, section)
    folder = options.out.absolute()
    with ExitStack() as stack:
        signals = stack.enter_context(EndingSignals())
        earlier = find_runs(folder / _RUNS) if options.fly else []
        running = _flown(options.config, folder, stack) if options.fly else {}
        gateway = None if packets is not None else _gateway(options, stack)
        served = None if gateway is None else f"127.0.0.1:{gateway.port}"
        yamcs.compile_link(folder)  # while the flight starts
        zero = _mission_zero(_first_packets(folder, earlier, running) if running else packets or ())
        options.begin = options.begin or zero
        forecast = _forecast(options)
        epoch = options.epoch or (EPOCH if zero is None else zero.replace(tzinfo=None).isoformat())
        yamcs.write(folder, served, options.port, epoch, options.keys, frame_bytes, body)
        server = running["Yamcs"] = _process(yamcs.command_line(folder), folder / "log", stack)

        def ended() -> bool:
            return signals.received or server.poll() is not None or any(map(_failed, running.values()))

        replay: Replay | None = None
        if _started(options.port, folder, forecast, ended):
            # The replay begins now, because packets before the start of Yamcs's archive would be lost.
            if packets is not None:
                replay = Replay(packets, folder, options.speed, time.monotonic())
            page, log = f"http://127.0.0.1:{options.port}/", folder / "log"
            access = f"user {yamcs.USER}, password in {folder / yamcs.USERS}"
            sys.stdout.write(f"Yamcs on {page}, {access}, log in {log} (Ctrl-C ends)\n")
            sys.stdout.flush()
        while not ended():
            if replay is not None:
                replay.turn(time.monotonic())
            time.sleep(_ASK_S) if gateway is None else gateway.turn(_ASK_S)
        if not signals.received:
            name, process = next(one for one in running.items() if one[0] == "Yamcs" or _failed(one[1]))
            raise KnightCubeError(f"{name} has ended with status {process.wait()}: see the logs in {folder}")
    return 0


def _flown(config: Path, folder: Path, stack: ExitStack) -> dict[str, subprocess.Popen[bytes]]:
    """Start link and flight of a configuration in real time. Return their processes; `stack` ends them."""
    runs = folder / _RUNS
    runs.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "flight"]
    link = _process([*command, "link", str(config), "--log", str(runs)], folder / "link.log", stack)
    until = time.monotonic() + _START_S
    while link.poll() is None and "link open" not in (folder / "link.log").read_text(encoding="utf-8"):
        if time.monotonic() > until:
            raise KnightCubeError(f"the link could not be opened: see {folder / 'link.log'}")
        time.sleep(_ASK_S)
    words = ["run", str(config), "--realtime", "--archive", str(runs)]
    return {"the link": link, _FLIGHT: _process([*command, *words], folder / "flight.log", stack)}


def _first_packets(
    folder: Path, earlier: Sequence[Path], running: Mapping[str, subprocess.Popen[bytes]]
) -> list[bytes]:
    """Wait for the first packets of the flight and return them.

    Raises KnightCubeError if no packets arrive.
    """
    until = time.monotonic() + _START_S
    while time.monotonic() < until and running[_FLIGHT].poll() is None:
        new = [run for run in find_runs(folder / _RUNS) if run not in earlier]
        if new and find_segments(new[0], "flight") and (packets := _packets(new[0])):
            return packets
        time.sleep(_ASK_S)
    raise KnightCubeError(f"the flight did not begin: see {folder / 'flight.log'}")


def _process(command: list[str], log: Path, stack: ExitStack) -> subprocess.Popen[bytes]:
    """Start a process whose output goes to a new log file, and return it. The process ends with `stack`."""
    file = stack.enter_context(log.open("w", encoding="utf-8"))
    process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    stack.callback(_end, process)
    return process


def _failed(process: subprocess.Popen[bytes]) -> bool:
    """Return whether a process has ended with an error; a flight that reaches its duration has none."""
    return process.poll() not in (None, 0)


def _packets(run: Path) -> list[bytes]:
    data = b"".join(path.read_bytes() for path in flight_segments(run))
    return [data[begin:end] for _, begin, end in walk(data)]


def _mission_zero(packets: Sequence[bytes]) -> datetime | None:
    """Return the UTC of mission time zero from the last packet that states it, or None if no packet does."""
    rows = decode(b"".join(packets))[RUN.name]
    if not len(rows) or not rows[-1]["utc_ns"]:
        return None
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(milliseconds=int(rows[-1]["utc_ns"]) // 10**6)


class Replay:
    """Replay of recorded packets as files, which the Yamcs data link `recorded` reads.

    Yamcs reads and deletes a file as soon as it appears. Each file is therefore written under another name
    and renamed when it is complete. The next file is written after Yamcs has deleted the previous file, so
    that Yamcs reads the packets in order.
    """

    def __init__(self, packets: Sequence[bytes], folder: Path, speed: float | None, begun: float) -> None:
        """Begin a replay at the monotonic time `begun` (s), in the folder of Yamcs's configuration.

        The `speed` is the ratio of mission time to the time of this computer; without a speed (None), all
        packets are replayed at once.
        """
        self._folder, self._speed, self._begun = folder, speed, begun
        end = HEADER_BYTES + SECONDARY_BYTES
        times = [int.from_bytes(packet[end - 8 : end], "big", signed=True) for packet in packets]
        # A packet with an earlier time than its predecessor is due with the predecessor.
        self._times = list(accumulate(times, max))
        self._packets = packets
        self._sent = 0
        self._files = 0

    def turn(self, now: float) -> None:
        """Write the packets that are due at the monotonic time `now` (s) into a file."""
        due = len(self._packets)
        if self._speed is not None and self._times:
            due = bisect_right(self._times, self._times[0] + 1e9 * self._speed * (now - self._begun))
        if due == self._sent or any((self._folder / yamcs.RECORDED).glob(f"run-*{SUFFIX}")):
            return
        self._files += 1
        complete = self._folder / f"run-{self._files:06d}{SUFFIX}"
        complete.write_bytes(b"".join(self._packets[self._sent : due]))
        complete.replace(self._folder / yamcs.RECORDED / complete.name)
        self._sent = due


def _address(config: Path, section: Link | None) -> str:
    if section is None:
        raise UsageError(f"{config}: has no section `link`: add it, or use --recorded RUN")
    if section.udp is None and section.tcp is None:
        raise UsageError(f"{config}: has neither `link.udp` nor `link.tcp`: give --link ADDRESS")
    return section.udp or f"tcp:{section.tcp}"


def _gateway(options: argparse.Namespace, stack: ExitStack) -> Gateway:
    """Return a gateway to the satellite, which `stack` closes, with its token in the folder of the keys."""
    token = new_token()
    terminal = stack.enter_context(contextlib.closing(terminal_of(options)))
    gateway = Gateway(
        terminal, "127.0.0.1:0", token, lambda text: sys.stderr.write(f"knightcube: gateway: {text}\n")
    )
    stack.enter_context(contextlib.closing(gateway))
    stack.enter_context(token_file(token_path(options.keys, gateway.port), token))
    return gateway


_Forecast = tuple["OrbitPrediction", tuple["Station", ...]]


def _forecast(options: argparse.Namespace) -> _Forecast | None:
    """Return the predicted orbit and the stations, or None if no station is given. Raises UsageError."""
    if not options.station and options.stations is None:
        return None
    source = argparse.Namespace(**{**vars(options), "config": options.elements or options.config})
    return predicted(source)[:2]


def _started(port: int, folder: Path, forecast: _Forecast | None, ended: Callable[[], bool]) -> bool:
    """Wait until Yamcs answers or `ended` is true, show the passes, and return whether Yamcs answers."""
    session = yamcs.Session(f"http://127.0.0.1:{port}/api", yamcs.USER, yamcs.password_in(folder))
    while not ended() and not _runs(session):
        time.sleep(_ASK_S)
    if ended():
        return False
    if forecast is not None:
        try:
            yamcs.add_passes(session, yamcs.INSTANCE, *forecast)
        except OSError as error:
            raise KnightCubeError(f"Yamcs refuses the passes: {error}: see {folder / 'log'}") from error
    return True


def _runs(session: yamcs.Session) -> bool:
    try:
        return bool(session.ask(f"/instances/{yamcs.INSTANCE}")["state"] == "RUNNING")
    except (OSError, ValueError):  # a ValueError means that the answer is not JSON
        return False


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
