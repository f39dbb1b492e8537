"""Campaign `start`: each system call of a flight's start on a board fails once; the flight must still start.

A point is a pair of one call of the main thread and one error that strace injects into this call; calls are
numbered from the start of the process. The list of points contains each call of a traced start with each
error. The number of calls varies slightly between starts. The seed determines the order of the list. Calls
after and before the opening of the configuration alternate as long as both remain, because nearly all calls
before the opening only read modules. With as many runs as points, the campaign covers the whole list.

A case is a board whose emulated devices run in a separate process. The flight of the board starts repeatedly,
each time with one point. The campaign replaces the service manager: if a process ends, it is restarted
without the fault, unless its exit status is 78. With that status the board would stay grounded, which must
not happen.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from flight.app.cli.run import REFUSED
from flight.app.service import FlownConfig, sum_file
from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.errors import UsageError
from tests.hal.guardian.live_flight import ROOT, devices_running, write_config

CALLS = ("open", "openat", "read", "getdents64", "fsync", "rename", "bind", "ioctl")
ERRORS = ("EIO", "ENOSPC", "ENOENT", "EACCES")
FAULTS = 10
"""Number of points (failing calls) that one board tests."""

_LONGEST_S = 120.0
_CONFIG = "flight.yaml"
_MOST_RESTARTS = 5
_GROUNDED = REFUSED
"""Exit status after which the service manager does not start a flight again."""


@dataclass(frozen=True, slots=True)
class Point:
    """One failing call: the `number`th of its kind, before or after the configuration was opened."""

    begun: bool
    call: str
    number: int
    error: str


def points(counts: Counter[str], before: Counter[str]) -> list[Point]:
    """Return all points (failing calls) of a start.

    `counts` are the numbers of calls by name in a traced start, and `before` are the numbers of calls before
    the configuration is opened.
    """
    return [
        Point(number > before[call], call, number, error)
        for call in CALLS
        for number in range(1, counts[call] + 1)
        for error in ERRORS
    ]


def in_turn(listed: Sequence[Point], seed: int) -> list[Point]:
    """Return the points (failing calls) in a random order that the seed determines.

    Calls after and before the opening of the configuration alternate.
    """

    def rank(point: Point) -> bytes:
        return hashlib.sha256(f"{seed} {point.call} {point.number} {point.error}".encode()).digest()

    ordered = sorted(listed, key=rank)
    parts = ([point for point in ordered if point.begun is begun] for begun in (True, False))
    return [point for pair in zip_longest(*parts) for point in pair if point is not None]


def cases(runs: int, seed: int) -> list[Case]:
    """Trace a start; return boards for the first `runs` points."""
    with _board() as board:
        listed = points(*board.trace())
    chosen = [(point.call, point.number, point.error, point.begun) for point in in_turn(listed, seed)[:runs]]
    of = {"points": len(listed), "begun": sum(point.begun for point in listed)}
    return [
        Case(str(number), (seed, number), {"faults": chosen[at : at + FAULTS], "of": of})
        for number, at in enumerate(range(0, len(chosen), FAULTS))
    ]


def run(case: Case) -> Result:
    """Start the flight of one board repeatedly, with one fault each time."""
    with _board() as board:
        # The traced start leaves stored state and an archive, as on every board except a new one.
        board.trace()
        faults = [
            {"fault": f"{call} {number}: {error}", "begun": begun}
            | board.start(f"{call}:error={error}:when={number}")
            for call, number, error, begun in case.parameters["faults"]
        ]
    return {"faults": faults, "of": case.parameters["of"]}


@contextmanager
def _board() -> Iterator[Board]:
    """Provide a board with running devices. Raises UsageError if strace is not installed."""
    if shutil.which("strace") is None:
        raise UsageError("the campaign start needs strace")
    _check_injection()
    # A temporary folder is used, because the path of a socket must be short.
    with tempfile.TemporaryDirectory(prefix="kc-") as name:
        place = Path(name)
        (place / "devices").mkdir()
        with devices_running(place / "devices") as facts:
            board = Board(place, facts)
            try:
                yield board
            finally:
                board.close()


def _check_injection() -> None:
    """Raise UsageError if strace cannot inject errors here, as in some containers."""
    fault = ["-e", "trace=none", "-e", "inject=openat:error=EIO:when=1+"]
    words = ["strace", "-o", "/dev/null", *fault, sys.executable, "-c", "open('/dev/null')"]
    if subprocess.run(words, capture_output=True, check=False).returncode == 0:
        raise UsageError("strace cannot make system calls fail on this machine: use another one")


class Board:
    """A board with configuration, state and archive, and the service manager's notification socket."""

    def __init__(self, place: Path, devices: Path) -> None:
        """Write the configuration of a flight on emulated devices."""
        self._place = place
        config, state = write_config(place), place / "state"
        state.mkdir()
        with config.open("a", encoding="utf-8") as file:
            file.write(f"\ncommands: {{socket: {place / 'commands'}, udp: '127.0.0.1:0'}}\n")
            file.write(f"\nstate: {{folder: {state}}}\nmodes: {{crash_limit: 16}}\n")
        data = config.read_bytes()
        sum_file(config).write_text(f"{hashlib.sha256(data).hexdigest()}  {_CONFIG}\n", encoding="ascii")
        FlownConfig(data.decode(), state).keep()
        words = ["run", config, "--realtime", "--archive", place / "runs", "--devices", devices]
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._line.bind(str(place / "notify"))
        self._line.settimeout(0.1)
        self._words = [sys.executable, "-m", "flight", *map(str, words)]
        self._environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(place / "notify"),
            "WATCHDOG_USEC": "2000000",
            "STATE_DIRECTORY": str(state),
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def trace(self) -> tuple[Counter[str], Counter[str]]:
        """Return the numbers of calls by name: in total, and before the configuration is opened."""
        path = self._place / "trace"
        strace = ["strace", "-o", str(path), "-e", f"trace={','.join(CALLS)}"]
        begun = self._begin(strace)
        flies, said = self._ready(begun), self._end(begun)
        if not flies:
            raise UsageError(
                f"a board does not fly even without a fault: status {begun.returncode}: {said!r}"
            )
        calls = re.findall(r"^(\w+)\((.*)", path.read_text(errors="replace"), re.MULTILINE)
        opened = next(at for at, (_, words) in enumerate(calls) if f'/{_CONFIG}"' in words)
        return Counter(name for name, _ in calls), Counter(name for name, _ in calls[:opened])

    def start(self, fault: str) -> Result:
        """Start the flight with a fault; if it ends, start it again without the fault. Return the outcome."""
        strace = ["strace", "-o", "/dev/null", "-e", "trace=none", "-e", f"inject={fault}"]
        begun_s = time.monotonic()
        restarts, flies, status, said = 0, False, 0, ""
        while not flies and status != _GROUNDED and restarts <= _MOST_RESTARTS:
            begun = self._begin([] if restarts else strace)
            flies = self._ready(begun)
            said += self._end(begun)
            status = begun.returncode
            restarts += not flies
        return {
            "flies": flies,
            "restarts": restarts,
            "waited": "cannot start yet" in said,
            "status": None if flies else status,
            "said": said[-600:],
            "took_s": time.monotonic() - begun_s,
        }

    def close(self) -> None:
        """Close the notification socket."""
        self._line.close()

    def _begin(self, wrapper: Sequence[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*wrapper, *self._words],
            cwd=ROOT,
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def _ready(self, begun: subprocess.Popen[str]) -> bool:
        """Wait until the flight is ready or ends; return whether it is ready."""
        deadline = time.monotonic() + _LONGEST_S
        while time.monotonic() < deadline:
            try:
                if b"READY=1" in self._line.recv(4096):
                    return True
            except TimeoutError:
                if begun.poll() is not None:
                    return False
        return False

    def _end(self, begun: subprocess.Popen[str]) -> str:
        """End a flight, wait for its guardian, which ends last, and return the standard error."""
        if begun.poll() is None:
            os.killpg(begun.pid, signal.SIGKILL)
        said = begun.communicate()[1] or ""
        self._line.setblocking(False)
        try:
            while self._line.recv(4096):
                pass
        except BlockingIOError:
            self._line.settimeout(0.1)
        return said


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Count the outcomes of the starts; name each start after which no flight ran."""
    faults = [fault for result in results for fault in result["faults"]]
    flew = [fault for fault in faults if fault["flies"]]
    at_once = sum(not fault["waited"] and not fault["restarts"] for fault in flew)
    waited = sum(fault["waited"] and not fault["restarts"] for fault in flew)
    grounded = [fault for fault in faults if not fault["flies"]]
    begun, of = sum(fault["begun"] for fault in faults), results[0]["of"]
    facts = {
        "starts": len(faults),
        "begun": begun,
        "of": of,
        "at_once": at_once,
        "waited": waited,
        "started_again": len(flew) - at_once - waited,
        "grounded": len(grounded),
        "never_flew": [f"{fault['fault']}: status {fault['status']}: {fault['said']}" for fault in grounded],
        "longest_s": max((fault["took_s"] for fault in flew), default=0.0),
    }
    return summary(facts)
