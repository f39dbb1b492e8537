"""`flight console`: a flight in the browser, live or as a replay, and commands to it."""

from __future__ import annotations

import argparse
import socket
import sys
import webbrowser
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from flight.link.telemetry.log import find_runs
from ground.link.options import add_link_options, terminal_of
from ground.watch.tail import LogTail
from knightcube.errors import FlightError, UsageError
from knightcube.vision.camera import images

if TYPE_CHECKING:
    from ground.console.server import Console

PORT = 8040


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Show a flight in the browser: attitude in 3-D, plots with history, mode and health, events, the "
        "orbit on a map, and forms for commands. A flight that goes on is shown live, from its log or by its "
        "link; a run that is over is replayed on the same page. The page is served on loopback only, and "
        "only to the browser that opens the printed address: its token is good for one browser. Needs the "
        "extra `ground`. Ctrl-C ends."
    )
    parser.epilog = (
        "examples: python -m flight console runs/demo; "
        "python -m flight console --fly config/step_demo.yaml runs/live; "
        "python -m flight console --link 192.0.2.7:5010 --keys keys/ground --config orbit.yaml"
    )
    parser.add_argument(
        "run", metavar="RUN", type=Path, nargs="?", help="folder of a run, or of an archive: newest run"
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--to", metavar="SOCKET", help="command by the flight's UNIX socket, or HOST:PORT")
    way.add_argument(
        "--fly", metavar="CONFIG", type=Path, help="fly this simulated configuration into RUN, in real time"
    )
    add_link_options(parser, way)
    parser.add_argument(
        "--config", metavar="CONFIG", type=Path, help="with --link: what is flown, for the map"
    )
    parser.add_argument(
        "--frames",
        metavar="FOLDER",
        type=Path,
        help="kept frames of the camera (default those of RUN; with --link as `flight files` got them)",
    )
    parser.add_argument("--port", type=int, default=PORT, metavar="N", help=f"0: any (default {PORT})")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.set_defaults(command=console)


def console(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    try:
        from aiohttp import web  # noqa: PLC0415 - an extra

        from ground.console.access import Access  # noqa: PLC0415
        from ground.console.server import application  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise FlightError(
            f"the console needs {error.name}: pip install 'knightcube-flight[ground]'"
        ) from error
    if (options.run is None) == (options.link is None):
        raise UsageError("give RUN, the folder of a run (with --fly: of the coming one), or --link ADDRESS")
    address = _listening(options.port)
    with address, ExitStack() as stack:
        shown = _shown(options, stack)
        shown.look()
        page = f"http://127.0.0.1:{address.getsockname()[1]}/"
        access = Access(lambda token: _say(f"for one more browser: {page}?token={token}"))
        url = f"{page}?token={access.token}"
        _say(f"console of {shown.name}, for one browser: {url} (Ctrl-C ends)")
        if options.open:
            webbrowser.open(url)
        web.run_app(application(shown, access), sock=address, print=None, access_log=None)
    return 0


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _shown(options: argparse.Namespace, stack: ExitStack) -> Console:
    """Return what the page shows; `stack` ends it."""
    from ground.console.commanding import Commanding, by_socket  # noqa: PLC0415
    from ground.console.flying import flying  # noqa: PLC0415
    from ground.console.history import History  # noqa: PLC0415
    from ground.console.kept_frames import FrameFolder  # noqa: PLC0415
    from ground.console.link_feed import LinkFeed  # noqa: PLC0415
    from ground.console.server import Console  # noqa: PLC0415
    from ground.console.surroundings import NOWHERE, Surroundings  # noqa: PLC0415
    from ground.xtce import TELECOMMANDS  # noqa: PLC0415

    history = stack.enter_context(History())
    if options.link is not None:
        feed = LinkFeed(terminal_of(options))
        stack.callback(feed.close)
        place = NOWHERE if options.config is None else Surroundings.of(options.config)
        by_link = Commanding(feed.send, TELECOMMANDS)
        return Console(options.link, feed, history, place, by_link, frames=FrameFolder(options.frames))
    to = options.to
    if options.fly is not None:
        to = stack.enter_context(flying(options.fly, options.run))
    folder = options.run
    runs = find_runs(folder) if folder.is_dir() else []
    folder = runs[-1] if runs else folder
    commanding = Commanding(by_socket(to) if to else None)
    place = Surroundings.of(folder / "config.yaml")
    frames = FrameFolder(options.frames or folder / images.KEPT_FRAMES_FOLDER)
    return Console(folder.name, LogTail(folder), history, place, commanding, frames=frames)


def _listening(port: int) -> socket.socket:
    """Return a socket that listens on loopback. Raises UsageError for a port that is none or is taken."""
    if not 0 <= port < 65536:
        raise UsageError(f"--port {port}: must lie within 0 and 65535")
    line = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        line.bind(("127.0.0.1", port))
    except OSError as error:
        line.close()
        raise UsageError(f"--port {port}: {error.strerror or error}; give another, or 0 for any") from error
    return line
