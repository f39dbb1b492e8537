"""`flight files`: list, get and put files of a satellite over its link."""

from __future__ import annotations

import argparse
import json
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flight.app.service import EndingSignals
from flight.link.files.store import Store, files_folder
from flight.link.files.transfer import Progress
from flight.link.process.commanding import Stage
from flight.link.process.directives import CancelFile, DeleteFile, Directive, ListFiles, SendFile, UseFile
from flight.link.process.filing import KINDS, LISTING
from flight.link.security import COMMAND_SPIS
from ground.link.files import FileSession, failed, sum_of
from ground.link.options import add_link_options, terminal_of
from ground.link.terminal import Terminal
from knightcube.errors import FlightError, UsageError

_RATE = 20_000.0
_SILENCE_S = 60.0
_TURN_S = 0.01
_SHOW_S = 1.0
_LINGER_S = 0.5
"""After the end: so long the other end may ask again for the last answer."""
Object = dict[str, Any]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "List the files of a satellite, get them down, and put files up, over its link. Ctrl-C keeps what "
        "came; the same command later goes on with it. Exit status 1 where a file did not come whole."
    )
    add_link_options(parser, parser.add_mutually_exclusive_group(required=True))
    parser.add_argument("--spi", type=int, choices=COMMAND_SPIS, default=COMMAND_SPIS[0], help="(default 1)")
    parser.add_argument(
        "--folder", type=Path, metavar="DIR", help="of what came and is open (default files beside the keys)"
    )
    parser.add_argument(
        "--rate", type=float, default=_RATE, metavar="B", help=f"bytes/s of frames up (default {_RATE:g})"
    )
    parser.add_argument(
        "--timeout",
        type=float,
        default=_SILENCE_S,
        metavar="S",
        help=f"of silence before giving up (default {_SILENCE_S:g})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    _configure_words(parser.add_subparsers(required=True, metavar="WHAT", dest="what"))
    parser.set_defaults(command=files)


def _configure_words(words: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    listed = words.add_parser("list", help="list the files on board")
    listed.add_argument("under", nargs="?", default="", metavar="BEGINNING", help="of their names")
    got = words.add_parser("get", help="get files down")
    got.add_argument("names", nargs="+", metavar="NAME", help="as the list has it")
    put = words.add_parser("put", help="put a file up")
    put.add_argument("kind", choices=KINDS, help="what it is for")
    put.add_argument("path", type=Path, metavar="FILE")
    use = words.add_parser("use", help="choose a file that was put up")
    use.add_argument("kind", choices=KINDS, help="what it is for")
    use.add_argument("path", type=Path, metavar="FILE", help="the same file here: its SHA-256 is sent")
    deleted = words.add_parser("delete", help="delete a file that was put up")
    deleted.add_argument("name", metavar="NAME", help="as the list has it")
    cancelled = words.add_parser("cancel", help="end a transfer on board")
    cancelled.add_argument(
        "source", type=int, metavar="ENTITY", help="who sends: 1 the satellite, 2 the ground"
    )
    cancelled.add_argument("number", type=int, metavar="N", help="as the packet transfer has it")


def files(options: argparse.Namespace) -> int:
    """Do what the words ask for, and print what came of it."""
    for name in ("rate", "timeout"):
        if not 0.0 < getattr(options, name) < float("inf"):
            raise UsageError(f"--{name} {getattr(options, name)}: must be a positive number")
    terminal = terminal_of(options)
    try:
        store = Store(options.folder or files_folder(options.keys))
        with store.owned(), EndingSignals() as signals:
            session = FileSession(terminal, store, options.spi, options.rate, time.monotonic_ns())
            work = _Work(session, terminal, options.timeout, lambda: signals.received)
            try:
                facts = work.obey(options)
            finally:
                session.close(time.monotonic_ns())
    finally:
        terminal.close()
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        _print(facts)
    return 0


def _print(facts: Object) -> None:
    for one in facts.get("files", ()):
        sys.stdout.write(f"{one['bytes']:>12} {one['name']}\n")
    if "text" in facts:
        sys.stdout.write(f"{facts['text']}\n")


class _Work:
    """One call's work with a session."""

    def __init__(
        self, session: FileSession, terminal: Terminal, patience_s: float, ended: Callable[[], bool]
    ) -> None:
        self._session, self._terminal = session, terminal
        self._patience_s, self._ended = patience_s, ended
        self._shown_s = 0.0

    def obey(self, options: argparse.Namespace) -> Object:
        """Return what is to be printed. Raises FlightError."""
        match options.what:
            case "list":
                path = self._get(ListFiles(options.under), LISTING)
                listing: Object = json.loads(path.read_bytes())
                return listing | {"text": f"{listing['free']} bytes are free"}
            case "get":
                return {"files": [self._facts(self._get(SendFile(name), name)) for name in options.names]}
            case "put":
                return self._put(options.path, f"{options.kind}/{options.path.name}")
            case "use":
                name = f"received/{options.kind}/{options.path.name}"
                return self._command(UseFile(name, sum_of(options.path)))
            case "delete":
                return self._command(DeleteFile(options.name))
            case _:
                return self._command(CancelFile(options.source, options.number))

    def _facts(self, path: Path) -> Object:
        name = path.relative_to(self._session.received).as_posix()
        return {"name": name, "bytes": path.stat().st_size, "path": str(path), "sha256": sum_of(path).hex()}

    def _get(self, directive: Directive, name: str) -> Path:
        """Return the file that came down whole."""
        self._session.ask(directive, time.monotonic_ns())
        completed = False
        while not completed:
            self._turn(name)
            for report in self._session.reports():
                if problem := failed([report]):
                    raise FlightError(problem)
                # The satellite closes when it knows that the file is here: also by an earlier session.
                completed |= report.stage is Stage.COMPLETED
            for progress in self._new_endings(name):
                self._judge(progress)
                completed = True
        self._linger()
        return self._session.received / name

    def _put(self, path: Path, name: str) -> Object:
        begun = self._session.put(path.absolute(), name, time.monotonic_ns())
        ended: list[Progress] = []
        while not ended:
            self._turn(name)
            ended = [one for one in self._new_endings(name) if one.number == begun.number]
        self._judge(ended[0])
        return {"name": f"received/{name}", "bytes": begun.size, "sha256": sum_of(path).hex()} | {
            "text": f"on board: received/{name}, {begun.size} bytes"
        }

    def _command(self, directive: Directive) -> Object:
        self._session.ask(directive, time.monotonic_ns())
        while True:
            self._turn("")
            reports = self._session.reports()
            if problem := failed(reports):
                raise FlightError(problem)
            if any(report.stage is Stage.COMPLETED for report in reports):
                return {"text": f"completed: {directive}"}

    def _judge(self, progress: Progress) -> None:
        if progress.condition != 0:
            raise FlightError(f"{progress.name}: {self._session.said_of(progress)}")

    def _new_endings(self, name: str) -> list[Progress]:
        ended = self._session.entity.ended
        found = [one for one in ended if one.name == name]
        ended.clear()
        return found

    def _linger(self) -> None:
        until = time.monotonic() + _LINGER_S
        while time.monotonic() < until and self._session.entity.transfers():
            self._turn("")

    def _turn(self, name: str) -> None:
        """Carry for a moment. Raises FlightError after a signal or a long silence; what came is kept."""
        if select.select([self._terminal], [], [], _TURN_S)[0]:
            self._session.take(self._terminal.take(), time.monotonic_ns())
        now_ns = time.monotonic_ns()
        self._session.go_on(now_ns)
        kept = "; what came is kept, and the same command goes on with it"
        if self._ended():
            raise FlightError(f"ended by a signal{kept if name else ''}")
        if now_ns - self._session.heard_ns > self._patience_s * 1e9:
            raise FlightError(f"nothing came for {self._patience_s:g} s{kept if name else ''}")
        if name and now_ns * 1e-9 - self._shown_s >= _SHOW_S:
            self._shown_s = now_ns * 1e-9
            for one in self._session.entity.transfers():
                part = f"{one.done} of {one.size} bytes" if one.size else "begins"
                sys.stderr.write(f"flight: {one.name or name}: {part}\n")
