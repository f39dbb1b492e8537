"""`flight watch`: a flight in the terminal, live or as it ended."""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from flight.link.telemetry.definitions import STREAMS as STREAM_STATES
from flight.link.telemetry.log import find_runs
from ground.commands.options import positive
from ground.watch.plain import PlainLines, attitude_text, event_line, state_line
from ground.watch.socket import answers
from ground.watch.tail import LogTail
from ground.watch.view import STREAMS, View, named

_LOOK_S = 0.5
_PING_S = 2.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Show a flight in the terminal: mode, attitude, coil currents, devices and events, from its log as "
        "it grows; of a flight that is over, how it ended. On a terminal with rich (extra `watch`) it is a "
        "panel, else plain lines. Given a flight's command socket, a ping every two seconds asks how the "
        "flight stands, and plain lines show the answers. Ctrl-C ends. Exit status 0: the flight is over, or "
        "Ctrl-C; 1: nothing more came."
    )
    parser.epilog = "example: python -m flight watch runs/demo"
    parser.add_argument(
        "flight", metavar="RUN|SOCKET", help="folder of a run or of an archive, or socket, or HOST:PORT"
    )
    parser.add_argument(
        "--every", type=positive, default=10.0, metavar="S", help="of mission time, plain lines (default 10)"
    )
    parser.add_argument(
        "--patience",
        type=positive,
        default=30.0,
        metavar="S",
        help="for a log that stands still (default 30)",
    )
    parser.add_argument("--plain", action="store_true", help="lines on a terminal too")
    parser.add_argument("--once", action="store_true", help="show how it stands now, and end")
    parser.add_argument("--json", action="store_true", help="print how it stands now as one JSON object")
    parser.set_defaults(command=watch)


def watch(options: argparse.Namespace) -> int:
    """Show until the flight is over, nothing more comes, or a signal."""
    folder = Path(options.flight)
    if folder.is_socket() or (":" in options.flight and not folder.exists()):
        return _watch_socket(options)
    runs = find_runs(folder)
    tail, view = LogTail(runs[-1] if runs else folder), View()
    if options.json or options.once:
        return _look(tail, view, options.json)
    with _ending() as ended:
        show = None if options.plain or not sys.stdout.isatty() else _panel(view, tail)
        if show is None:
            lines = PlainLines(view, options.every, sys.stdout.write)
            while not _over(view, tail, options.patience, ended, lambda: lines.feed(tail.new())):
                sys.stdout.flush()
        else:
            with show as refresh:
                while not _over(view, tail, options.patience, ended, refresh):
                    pass
    if not view.ended and not ended.is_set():
        sys.stderr.write(f"flight: nothing new for {tail.silence:.0f} s: the log just stops\n")
        return 1
    return 0


def _over(
    view: View, tail: LogTail, patience: float, ended: threading.Event, look: Callable[[], None]
) -> bool:
    """Look once, then wait for the next look; return whether there is none."""
    look()
    return bool(view.ended) or tail.silence > patience or ended.wait(_LOOK_S)


@contextlib.contextmanager
def _ending() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets; the second one kills."""
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


def _panel(view: View, tail: LogTail) -> contextlib.AbstractContextManager[Callable[[], None]] | None:
    """Return a panel that looks at the log when it is refreshed; None without rich."""
    try:
        from rich.live import Live  # noqa: PLC0415 - an extra

        from ground.watch.panel import panel  # noqa: PLC0415
    except ModuleNotFoundError:
        sys.stderr.write("flight: a panel needs rich: pip install 'knightcube-flight[watch]'\n")
        return None

    @contextlib.contextmanager
    def shown() -> Iterator[Callable[[], None]]:
        with Live(auto_refresh=False) as live:

            def refresh() -> None:
                view.update(tail.new())
                live.update(panel(view, tail.silence), refresh=True)

            yield refresh

    return shown()


def _look(tail: LogTail, view: View, as_json: bool) -> int:
    view.update(tail.new())
    if as_json:
        sys.stdout.write(json.dumps(_facts(view)) + "\n")
    else:
        sys.stdout.write(state_line(view) + (f"  ended: {view.ended}" if view.ended else "") + "\n")
    return 0


def _facts(view: View) -> dict[str, Any]:
    written = view.value("control", "current_written")
    health = "health" in view.newest
    return {
        "mission_time_s": view.time,
        "mode": view.mode or None,
        "attitude": attitude_text(view) or None,
        "error_deg": view.error_deg,
        "currents_a": None if written is None else [_finite(current) for current in written],
        "streams": {name: named(STREAM_STATES, view.value("health", name)) for name in STREAMS}
        if health
        else None,
        "faults": view.faults,
        "events": [
            {"time_s": event.time, "severity": event.severity, "name": event.name, "text": event.text}
            for event in view.events
        ],
        "ended": view.ended or None,
    }


def _finite(value: float) -> float | None:
    return float(value) if abs(value) < float("inf") else None


def _watch_socket(options: argparse.Namespace) -> int:
    """Ask a flight how it stands until it does not answer, or a signal."""
    once, heard, view = options.once or options.json, False, View()
    with _ending() as ended:
        for answer in answers(options.flight, options.patience, ended):
            heard = True
            came = view.update(answer.packets)
            if not options.json:
                sys.stdout.writelines(f"{event_line(event)}\n" for event in came)
            facts = {"commands": answer.count, "answered_s": answer.delay}
            text = f"{state_line(view)}  answered in {1e3 * answer.delay:.1f} ms"
            sys.stdout.write((json.dumps(_facts(view) | facts) if options.json else text) + "\n")
            sys.stdout.flush()
            if once or ended.wait(_PING_S):
                return 0
        if not ended.is_set():
            sys.stderr.write(f"flight: {options.flight}: no answer{' any more' if heard else ''}\n")
    return 0 if ended.is_set() else 1
