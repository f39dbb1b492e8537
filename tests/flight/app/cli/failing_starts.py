"""Starts the link repeatedly in one process; in each start, different system calls fail.

`python -m tests.flight.app.cli.failing_starts FOLDER [all]` runs in a separate process, because the audit
hook that makes calls fail cannot be removed. The program prints one JSON object per start.

Python raises an audit event before it opens a file or a socket. If `all` is given, each call is tested with
each error, and calls without an audit event are made to fail too. Calls without an audit event are replaced
by test doubles in the modules that use the calls.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

from flight.app.cli import main
from flight.app.service import StartRetry
from flight.link.process.station import Station
from tests.support.linked_board import write_linked_config

CALLS = frozenset({"open", "os.mkdir", "os.remove", "os.listdir", "os.scandir", "socket.bind"})
"""Audit events (Python documentation, "Audit events table"), which Python raises before the call."""
REPLACED: tuple[tuple[Any, tuple[str, ...]], ...] = (
    (os, ("read", "pwrite", "fsync", "ftruncate", "fstat", "stat", "lstat", "replace")),
    (fcntl, ("flock",)),
    (socket.socket, ("setsockopt", "listen", "setblocking")),
)
"""Names of calls without an audit event, with the module or class to which they belong."""
ERRORS = (errno.EIO, errno.ENOSPC, errno.ENOENT, errno.EACCES, errno.EROFS)
NETWORK_ERRORS = (errno.EADDRINUSE, errno.EADDRNOTAVAIL)


class Faults:
    """Injector of failing calls during the starts of a link.

    Attributes:
        seen: name and one argument of each call during the present start.
        waits: number of times that the present start has waited.
    """

    def __init__(self) -> None:
        self.seen: list[tuple[str, str]] = []
        self.waits = 0
        self._error_of: Callable[[str, str], int] | None = None

    def start(self, error_of: Callable[[str, str], int]) -> None:
        """Clear the record of calls, and select the calls that fail during the next start.

        `error_of` returns the errno with which a call must fail, or 0 if the call must succeed.
        """
        self.seen, self.waits, self._error_of = [], 0, error_of

    def end(self) -> None:
        """Make no further calls fail."""
        self._error_of = None

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Make the selected calls fail with an OSError; `sys.addaudithook` takes this method as its hook."""
        if self._error_of is None or event not in CALLS:
            return
        self._fail(event, str(arguments[-1] if event == "socket.bind" else arguments[0]))

    def failing(self, name: str, called: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that calls `called`, unless `error_of` selects the call to fail."""

        def call(*arguments: Any, **named: Any) -> Any:
            if self._error_of is not None:
                self._fail(name, str(arguments[0]))
            return called(*arguments, **named)

        return call

    def _fail(self, event: str, about: str) -> None:
        assert self._error_of is not None
        self.seen.append((event, about))
        if error := self._error_of(event, about):
            raise OSError(error, os.strerror(error), about)


def cases(faults: Faults, place: Path, complete: bool) -> Iterator[tuple[str, Callable[[str, str], int]]]:
    """Yield, for each start, a description of the failing calls and the function `error_of`."""
    for _ in range(2):  # the first start is not counted, because it imports modules
        yield "nothing", lambda *_: 0
    calls = list(faults.seen)
    for number, (event, about) in enumerate(calls, 1):
        errors = set(NETWORK_ERRORS if event == "socket.bind" else ERRORS[number % len(ERRORS) :][:1])
        errors = errors | set(ERRORS) if complete else errors
        for error in sorted(errors):

            def once(*_: str, number: int = number, error: int = error) -> int:
                return error if len(faults.seen) == number else 0

            yield f"call {number}: {event} {about}: {errno.errorcode[error]}", once
    for error in ERRORS:

        def long(event: str, about: str, error: int = error) -> int:
            return error if faults.waits < 3 and about.startswith(str(place / "board")) else 0

        yield f"the whole disk for three attempts: {errno.errorcode[error]}", long

        def archive(event: str, about: str, error: int = error) -> int:
            return error if event == "os.scandir" and about == str(place / "board" / "runs") else 0

        yield f"the list of runs at all times: {errno.errorcode[error]}", archive


def run(place: Path, complete: bool = False) -> None:
    """Run all starts of the link in the folder `place`, and print the result of each start."""
    (place / "board" / "runs").mkdir(parents=True)
    config = write_linked_config(place / "board", udp="127.0.0.1:0", tcp="127.0.0.1:0")
    words = ["link", str(config), "--log", str(place / "board" / "runs")]
    faults, came_up = Faults(), False
    turn_until, wait = Station.run, StartRetry.wait

    def run_shortly(self: Station, *arguments: Any) -> None:
        nonlocal came_up
        faults.end()
        came_up = True
        self.turn()
        signal.raise_signal(signal.SIGTERM)
        turn_until(self, *arguments)

    def count_waits(self: StartRetry, problem: str, _: float) -> None:
        faults.waits += 1
        wait(self, problem, 0.0)

    sys.addaudithook(faults.hook)
    # Only the start of the link is tested, and its pauses are omitted.
    with ExitStack() as stack:
        stack.enter_context(patch.object(Station, "run", run_shortly))
        stack.enter_context(patch.object(StartRetry, "wait", count_waits))
        for owner, names in REPLACED if complete else ():
            for name in names:
                stack.enter_context(patch.object(owner, name, faults.failing(name, getattr(owner, name))))
        for name, error_of in cases(faults, place, complete):
            came_up = False
            faults.start(error_of)
            with redirect_stderr(StringIO()) as said:
                status = main(words)
            faults.end()
            facts = {"fails": name, "status": status, "came_up": came_up, "waits": faults.waits}
            sys.stdout.write(json.dumps({**facts, "said": said.getvalue()}) + "\n")


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:] == ["all"])
