"""Commands of a ground station: `keys`, `gateway`, `watch` and `console`."""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from flight.app.cli import complain, to_json
from flight.app.service import EndingSignals
from flight.link.telemetry.definitions import STREAMS as STREAM_STATES
from flight.link.telemetry.log import find_runs
from flight.schema.document import config_path
from ground.commands.options import positive
from ground.link.commanding import add_link_options, flight_address, ground_files_folder, terminal_of
from ground.link.gateway import ADDRESS, Gateway, new_token, token_file, token_path
from ground.link.terminal import make_keys
from ground.telemetry import named
from ground.watch import (
    SILENT_S,
    STREAMS,
    FlightState,
    LogTail,
    PacketSource,
    PlainLines,
    answers,
    attitude_text,
    event_line,
    panel,
    state_line,
)
from knightcube.errors import KnightCubeError, UsageError
from knightcube.vision.camera import images

if TYPE_CHECKING:
    from ground.console.server import Console

PORT = 8040
_READ_S = 0.5  # time (s) between two reads of a growing log
_PING_S = 2.0  # time (s) between two pings of a watched flight


def configure_keys(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube keys` to the parser."""
    parser.description = (
        "Make new keys: FOLDER/satellite for the board, FOLDER/ground for the ground, readable by their "
        "owner only. Existing keys are never overwritten."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="new folder to create")
    parser.set_defaults(command=run_keys)


def run_keys(options: argparse.Namespace) -> int:
    """Make the keys and print their folders."""
    satellite, ground = make_keys(options.folder)
    sys.stdout.write(f"for the satellite: {satellite}\nfor the ground: {ground}\n")
    return 0


def configure_gateway(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube gateway` to the parser."""
    parser.description = (
        "Connect a satellite's link to a ground station without keys, such as Yamcs: a connection to the "
        "address receives every telemetry packet and may send command packets, which are sent up in "
        "protected frames. The first line of a connection must be a token. It is new at each start and is "
        "written to the file KEYS/gateway-PORT.token; a connection that sends anything else is closed. "
        "Loopback only. Ctrl-C ends."
    )
    add_link_options(parser, parser.add_mutually_exclusive_group(required=True))
    text = "address for ground stations (default %(default)s)"
    parser.add_argument("--serve", default=ADDRESS, metavar="HOST:PORT", help=text)
    parser.set_defaults(command=run_gateway)


def run_gateway(options: argparse.Namespace) -> int:
    """Relay packets until a signal arrives."""
    token = new_token()
    with contextlib.closing(terminal_of(options)) as terminal:
        gateway = Gateway(terminal, options.serve, token, _complain)
        path = token_path(options.keys, gateway.port)
        with contextlib.closing(gateway), EndingSignals() as signals, token_file(path, token):
            sys.stdout.write(f"packets on 127.0.0.1:{gateway.port}, token in {path} (Ctrl-C ends)\n")
            sys.stdout.flush()
            gateway.run(lambda: signals.received)
        sys.stdout.write(f"{terminal.reception()}\n")
    return 0


def _complain(text: str) -> None:
    """Write a problem of the gateway to standard error; a full disk does not end the gateway."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f"knightcube: gateway: {text}\n")


def configure_watch(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube watch` to the parser."""
    parser.description = (
        "Show a flight in the terminal from its log: mode, attitude, coil currents, devices and events, "
        "while the log grows or up to its end. A terminal with rich (extra `watch`) shows a panel, "
        "otherwise plain lines are printed. With a flight's command socket, a ping every two seconds "
        "requests its state, which is printed as plain lines. With --link the telemetry that the link "
        "receives is shown. Ctrl-C ends. Exit status 0 if the flight has ended or after Ctrl-C, 1 if no "
        "new packets arrive."
    )
    parser.epilog = (
        "examples: knightcube watch runs/demo; "
        "knightcube watch --link 192.0.2.7:5010 --keys keys/ground --once"
    )
    way = parser.add_mutually_exclusive_group(required=True)
    text = "folder of a run or of an archive, a socket, or HOST:PORT"
    way.add_argument("flight", metavar="RUN|SOCKET", nargs="?", help=text)
    add_link_options(parser, way)
    text = "mission time between printed lines (default %(default)g s)"
    parser.add_argument("--every", type=positive, default=10.0, metavar="S", help=text)
    text = "time without new packets before the command ends (default %(default)g s)"
    parser.add_argument("--patience", type=positive, default=30.0, metavar="S", help=text)
    parser.add_argument("--plain", action="store_true", help="print plain lines on a terminal too")
    parser.add_argument("--once", action="store_true", help="print the present state and end")
    parser.add_argument("--json", action="store_true", help="print the present state as one JSON object")
    parser.set_defaults(command=run_watch)


def run_watch(options: argparse.Namespace) -> int:
    """Show a flight until the flight ends, no new packets arrive, or a signal arrives."""
    if options.link is not None:
        from ground.console.commanding import LinkFeed  # noqa: PLC0415 - not needed by the other commands

        with contextlib.closing(LinkFeed(terminal_of(options))) as feed:
            status = _watch(options, feed, options.patience, "over the link")
            if feed.problem:
                sys.stderr.write(f"knightcube: {feed.problem}\n")
            return status
    folder = Path(options.flight)
    if folder.is_socket() or (":" in options.flight and not folder.exists()):
        return _watch_socket(options)
    runs = find_runs(folder)
    tail = LogTail(runs[-1] if runs else folder)
    status = _watch(options, tail, 0.0, "and the log has no stop event")
    if tail.problem:
        sys.stderr.write(f"knightcube: {tail.problem}\n")
    return status


def _watch(options: argparse.Namespace, tail: PacketSource, wait: float, where: str) -> int:
    """Show the flight whose packets the source `tail` delivers.

    `wait` is the longest time (s) to wait for a first complete state. If no packets arrive, a message that
    ends with `where` is shown.
    """
    state, by_link = FlightState(), options.link is not None

    def silence() -> float:
        """Return the time (s) since the last packet of the flight."""
        return state.silence if by_link else tail.silence

    if options.json or options.once:
        state.update(tail.new())
        until = time.monotonic() + wait
        while tail.behind or (not {"attitude", "health"} <= state.newest.keys() and time.monotonic() < until):
            state.update(tail.new())
        # The link process also sends packets of its own, which do not show that a flight is in progress.
        if not state.newest or (by_link and not state.mode):
            cause = _cause(state, tail) if by_link else ""
            return complain(f"no state of the flight in {wait:g} s {where}{cause}", 1)
        silent = f"  no packet for {silence():.0f} s" if silence() > SILENT_S else ""
        line = state_line(state) + (f"  ended: {state.ended}" if state.ended else silent)
        facts = _facts(state) | {"silence_s": silence()}
        sys.stdout.write(to_json(facts) if options.json else line + "\n")
        return 0
    with _ending() as ended, _display(options, state, tail, silence) as refresh:
        refresh()
        while not (state.ended or silence() > options.patience or ended.wait(_READ_S)):
            refresh()
    if not state.ended and not ended.is_set():
        cause = _cause(state, tail) if by_link else ""
        sys.stderr.write(f"knightcube: no new packet for {silence():.0f} s {where}{cause}\n")
        return 1
    return 0


def _cause(state: FlightState, tail: PacketSource) -> str:
    """Return the possible causes and remedies if no packet of a flight arrives over a link."""
    if not state.newest or tail.silence > SILENT_S:
        return ": no frame is authentic: check --link, --keys and --spacecraft, and that the link runs"
    return ": the link answers, but the flight does not run, or the link reads another run (its --log)"


@contextlib.contextmanager
def _ending() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets; a second signal kills the process."""
    ended = threading.Event()

    def end(number: int, _: FrameType | None) -> None:
        ended.set()
        signal.signal(number, signal.SIG_DFL)

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _display(
    options: argparse.Namespace, state: FlightState, tail: PacketSource, silence: Callable[[], float]
) -> Iterator[Callable[[], None]]:
    """Yield a function that shows the new packets: on a panel in a terminal with rich, otherwise as lines."""
    live = None
    if not options.plain and sys.stdout.isatty():
        try:
            from rich.live import Live  # noqa: PLC0415 - an extra

            live = Live(auto_refresh=False)
        except ModuleNotFoundError:
            sys.stderr.write("knightcube: a panel needs rich: pip install 'knightcube-flight[watch]'\n")
    lines = PlainLines(state, options.every, sys.stdout.write)

    def refresh() -> None:
        if live is None:
            lines.feed(tail.new())
            sys.stdout.flush()
        else:
            state.update(tail.new())
            live.update(panel(state, silence()), refresh=True)

    with live or contextlib.nullcontext():
        yield refresh


def _facts(state: FlightState) -> dict[str, Any]:
    written, health = state.value("control", "current_written"), state.newest.get("health")
    currents = streams = None
    if written is not None:
        currents = [float(value) if abs(value) < float("inf") else None for value in written]
    if health is not None:
        streams = {name: named(STREAM_STATES, health[name]) for name in STREAMS}
    return {
        "mission_time_s": state.time,
        "utc": state.utc(state.time) or None,
        "mode": state.mode or None,
        "attitude": attitude_text(state) or None,
        "error_deg": state.error_deg,
        "currents_a": currents,
        "streams": streams,
        "alarms": list(state.alarms),
        "faults": state.faults,
        "faults_since_s": state.since,
        "events": [
            {
                "time_s": event.time,
                "utc": state.utc(event.time) or None,
                "severity": event.severity,
                "name": event.name,
                "text": event.text,
                "suppressed": event.suppressed,
            }
            for event in state.events
        ],
        "ended": state.ended or None,
    }


def _watch_socket(options: argparse.Namespace) -> int:
    """Request the state of a flight until the flight does not answer or a signal arrives."""
    once, answered, state = options.once or options.json, False, FlightState()
    with _ending() as ended:
        for answer in answers(options.flight, options.patience, ended):
            answered = True
            found = state.update(answer.packets)
            if not options.json:
                sys.stdout.writelines(f"{event_line(event, state.utc(event.time))}\n" for event in found)
            facts = {"commands": answer.count, "answered_s": answer.delay}
            text = f"{state_line(state)}  answered in {1e3 * answer.delay:.1f} ms"
            sys.stdout.write(to_json(_facts(state) | facts) if options.json else text + "\n")
            sys.stdout.flush()
            if once or ended.wait(_PING_S):
                return 0
        if not ended.is_set():
            return complain(f"{options.flight}: {'no further' if answered else 'no'} answer", 1)
    return 0


def configure_console(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube console` to the parser."""
    parser.description = (
        "Show a flight in the browser: attitude in 3-D, plots with history, mode and health, events, the "
        "orbit on a map, and forms for commands. A flight in progress is shown live, from its log or over "
        "its link; a finished run is replayed on the same page. The page is served on loopback only, and "
        "only to the browser that opens the printed address: its token is valid for one browser. Needs the "
        "extra `ground`. Ctrl-C ends."
    )
    parser.epilog = (
        "examples: knightcube console runs/demo; "
        "knightcube console --fly config/step_demo.yaml runs/live; "
        "knightcube console --link 192.0.2.7:5010 --keys keys/ground --config orbit.yaml"
    )
    text = "folder of a run, or of an archive for its newest run"
    parser.add_argument("run", metavar="RUN", type=Path, nargs="?", help=text)
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--to", metavar="SOCKET", help="send commands to the flight's UNIX socket or HOST:PORT")
    text = "simulate this configuration in real time, with the log in RUN"
    way.add_argument("--fly", metavar="CONFIG", type=config_path, help=text)
    add_link_options(parser, way)
    text = "kept frames of the camera (default those of RUN; with --link as received by `files`)"
    parser.add_argument("--frames", metavar="FOLDER", type=Path, help=text)
    parser.add_argument(
        "--station",
        action="append",
        default=[],
        metavar="NAME,LAT,LON[,HEIGHT[,MASK]]",
        help="ground station whose passes the page lists, given as for `passes`; may be repeated",
    )
    parser.add_argument("--stations", type=Path, metavar="FILE", help="YAML file of ground stations")
    text = "port of the page, 0 for any (default %(default)s)"
    parser.add_argument("--port", type=int, default=PORT, metavar="N", help=text)
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.set_defaults(command=run_console)


def run_console(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    try:
        from aiohttp import web  # noqa: PLC0415 - an extra

        from ground.console.server import Access, application  # noqa: PLC0415
    except ModuleNotFoundError as error:
        needed = "pip install 'knightcube-flight[ground]'"
        raise KnightCubeError(f"the console needs {error.name}: {needed}") from error
    if (options.run is None) == (options.link is None):
        raise UsageError("give RUN, the folder of a run (with --fly: a new folder), or --link ADDRESS")
    if options.link is None and options.config is not None:
        raise UsageError(f"--config {options.config}: is for --link; a run has its own configuration")
    address = _listening(options.port)
    with address, ExitStack() as stack:
        shown = _shown(options, stack)
        shown.read()
        if shown.trouble:
            sys.stderr.write(f"knightcube: {shown.trouble}\n")
        page = f"http://127.0.0.1:{address.getsockname()[1]}/"
        access = Access(lambda token: _print(f"for another browser: {page}?token={token}"))
        url = f"{page}?token={access.token}"
        _print(f"console of {shown.name}, for one browser: {url} (Ctrl-C ends)")
        if options.open:
            webbrowser.open(url)
        web.run_app(application(shown, access), sock=address, print=None, access_log=None)
    return 0


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _shown(options: argparse.Namespace, stack: ExitStack) -> Console:
    """Return the console that the options describe, with resources that `stack` closes."""
    from ground.console.commanding import CommandForms, LinkFeed, LinkFiles, RunFiles, by_socket, flying  # noqa: PLC0415  # noqa: PLC0415
    from ground.console.history import History  # noqa: PLC0415
    from ground.console.server import Console  # noqa: PLC0415
    from ground.console.surroundings import UNKNOWN, FlightSurroundings, FrameFolder  # noqa: PLC0415
    from ground.xtce import TELECOMMANDS  # noqa: PLC0415

    history = stack.enter_context(History())
    stations = _stations(options)
    if options.link is not None:
        feed = LinkFeed(terminal_of(options))
        stack.callback(feed.close)
        place = UNKNOWN if options.config is None else FlightSurroundings.of(options.config)
        by_link = CommandForms(feed.send, TELECOMMANDS)
        files = LinkFiles(feed, ground_files_folder(options.keys))
        kept = FrameFolder(options.frames)
        shown = Console(
            options.link, feed, history, place, by_link, frames=kept, files=files, stations=stations
        )
        shown.doubts = (lambda: feed.problem,)
        return shown
    to: str | None = options.to
    flight_trouble: Callable[[], str] = str  # returns an empty text
    if to is not None:
        flight_address(to)
    if options.fly is not None:
        flight = stack.enter_context(flying(options.fly, options.run))
        to, flight_trouble = flight.socket, flight.trouble
    folder = options.run
    runs = find_runs(folder) if folder.is_dir() else []
    folder = runs[-1] if runs else folder
    forms = CommandForms(by_socket(to) if to else None)
    place = FlightSurroundings.of(folder / "config.yaml")
    frames = FrameFolder(options.frames or folder / images.KEPT_FRAMES_FOLDER)
    name, tail, listed = folder.name, LogTail(folder), RunFiles(folder)
    shown = Console(name, tail, history, place, forms, frames=frames, files=listed, stations=stations)
    shown.doubts = (flight_trouble, lambda: tail.problem)
    return shown


def _stations(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the ground stations that the options describe, as texts. Raises UsageError."""
    if not options.station and options.stations is None:
        return ()
    from ground.passes import read_stations, station_of  # noqa: PLC0415 - Skyfield is large

    given = tuple(map(station_of, options.station))
    return tuple(one.text for one in given + (read_stations(options.stations) if options.stations else ()))


def _listening(port: int) -> socket.socket:
    """Return a socket that listens on loopback. Raises UsageError if the port is invalid or in use."""
    if not 0 <= port < 65536:
        raise UsageError(f"--port {port}: must be 0 to 65535")
    line = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        line.bind(("127.0.0.1", port))
        line.listen()  # before the address is printed
    except OSError as error:
        line.close()
        raise UsageError(f"--port {port}: {error.strerror or error}; give another, or 0 for any") from error
    return line
