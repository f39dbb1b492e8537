"""Campaign `start`: each system call of a board's start fails once, and the board flies all the same.

A case is a board whose emulated devices live in a process of their own; its flight starts again and again,
each time with one fault that strace injects into one call of the main thread. Half of the faults are drawn
from all calls, most of which read modules; half from those after the configuration was opened. This campaign
stands for the service manager: a process that ends is started again without the fault, unless its status is
2. Then the board is grounded for good, which must not happen.
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
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flight.app.accepted_config import sum_file
from flight.app.kept_configs import FlownConfig
from flight.gnc.errors import UsageError
from tests.hal.guardian.live_flight import ROOT, devices_running, write_config
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary

CALLS = ("open", "openat", "read", "getdents64", "fsync", "rename", "bind", "ioctl")
ERRORS = ("EIO", "ENOSPC", "ENOENT", "EACCES")
FAULTS = 10
"""Of one board."""

_LONGEST_S = 120.0
_CONFIG = "flight.yaml"
_MOST_RESTARTS = 5


def cases(runs: int, seed: int) -> list[Case]:
    """Return boards that come to `runs` faults together."""
    sizes = [min(FAULTS, runs - done) for done in range(0, runs, FAULTS)]
    return [Case(str(number), (seed, number), {"faults": size}) for number, size in enumerate(sizes)]


def run(case: Case) -> Result:
    """Start one board's flight with one fault after the other."""
    if shutil.which("strace") is None:
        raise UsageError("the campaign start needs strace")
    rng = np.random.default_rng(case.seed)
    # The socket's name must be short.
    with tempfile.TemporaryDirectory(prefix="kc-") as name:
        place = Path(name)
        (place / "devices").mkdir()
        with devices_running(place / "devices") as facts:
            board = _Board(place, facts)
            counts, before = board.trace()
            faults = [_fault(board, rng, counts, before) for _ in range(case.parameters["faults"])]
            board.close()
    return {"faults": faults}


def _fault(board: _Board, rng: np.random.Generator, counts: Counter[str], before: Counter[str]) -> Result:
    """Draw one fault and start the board with it."""
    first = before if rng.random() < 0.5 else Counter[str]()
    drawn = {call: counts[call] - first[call] for call in CALLS if counts[call] > first[call]}
    # A kind of call is as likely as the square root of its number: else nearly all would be of `read`.
    weights = np.sqrt(np.array(list(drawn.values()), float))
    call = str(rng.choice(list(drawn), p=weights / weights.sum()))
    number = int(rng.integers(first[call], counts[call])) + 1
    error = str(rng.choice(ERRORS))
    return {"fault": f"{call} {number}: {error}"} | board.start(f"{call}:error={error}:when={number}")


class _Board:
    """A board with its configuration, state and archive, and the service manager's end of its line."""

    def __init__(self, place: Path, devices: Path) -> None:
        config, state = write_config(place), place / "state"
        state.mkdir()
        with config.open("a", encoding="utf-8") as file:
            file.write(f"\ncommands: {{socket: {place / 'commands'}, udp: '127.0.0.1:0'}}\n")
            file.write(f"\nstate: {{folder: {state}}}\nmodes: {{crash_limit: 16}}\n")
        data = config.read_bytes()
        sum_file(config).write_text(f"{hashlib.sha256(data).hexdigest()}  {_CONFIG}\n", encoding="ascii")
        FlownConfig(data.decode(), state).keep()
        self._place = place
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._line.bind(str(place / "notify"))
        self._line.settimeout(0.1)
        self._words = [sys.executable, "-m", "flight", "run", str(config), "--realtime"]
        self._words += ["--archive", str(place / "runs"), "--devices", str(devices)]
        self._environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(place / "notify"),
            "WATCHDOG_USEC": "2000000",
            "STATE_DIRECTORY": str(state),
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def trace(self) -> tuple[Counter[str], Counter[str]]:
        """Return how often each call is made in a start, and how often before the configuration is opened."""
        path = self._place / "trace"
        strace = ["strace", "-o", str(path), "-e", f"trace={','.join(CALLS)}"]
        begun = self._begin(strace)
        if not self._ready(begun):
            raise UsageError("a board does not fly even without a fault")
        self._end(begun)
        calls = re.findall(r"^(\w+)\((.*)", path.read_text(errors="replace"), re.MULTILINE)
        opened = next(at for at, (_, words) in enumerate(calls) if f'/{_CONFIG}"' in words)
        return Counter(name for name, _ in calls), Counter(name for name, _ in calls[:opened])

    def start(self, fault: str) -> Result:
        """Start with a fault, and again without it after an end; return how it went."""
        strace = ["strace", "-o", "/dev/null", "-e", "trace=none", "-e", f"inject={fault}"]
        begun_s = time.monotonic()
        restarts, flies, status, said = 0, False, 0, ""
        while not flies and status != 2 and restarts <= _MOST_RESTARTS:
            begun = self._begin([] if restarts else strace)
            flies = self._ready(begun)
            said += self._end(begun)
            status = begun.returncode
            restarts += not flies
        return {
            "flies": flies,
            "restarts": restarts,
            "waited": "cannot begin yet" in said,
            "status": None if flies else status,
            "said": said[-600:],
            "took_s": time.monotonic() - begun_s,
        }

    def close(self) -> None:
        """Close the line."""
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
        """End a flight, its own guardian being the last; return what it wrote on standard error."""
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
    """Count how the starts went; name each that did not fly."""
    faults = [fault for result in results for fault in result["faults"]]
    flew = [fault for fault in faults if fault["flies"]]
    at_once = sum(not fault["waited"] and not fault["restarts"] for fault in flew)
    waited = sum(fault["waited"] and not fault["restarts"] for fault in flew)
    grounded = [fault for fault in faults if not fault["flies"]]
    by_call = Counter(fault["fault"].partition(" ")[0] for fault in faults)
    lines = [
        f"starts with one call that fails: {len(faults)}",
        f"  of {', '.join(f'{call} {count}' for call, count in sorted(by_call.items()))}",
        f"flew at once {at_once}, waited and flew {waited}, ended and were started again "
        f"{len(flew) - at_once - waited}",
        f"never flew: {len(grounded)}",
    ]
    lines += [f"  {fault['fault']}: status {fault['status']}: {fault['said']}" for fault in grounded]
    facts = {
        "starts": len(faults),
        "at_once": at_once,
        "waited": waited,
        "started_again": len(flew) - at_once - waited,
        "grounded": len(grounded),
        "longest_s": max((fault["took_s"] for fault in flew), default=0.0),
    }
    return Summary("\n".join(lines) + "\n", facts)


START = Campaign(
    "start",
    "every system call of a board's start fails once: it flies, or waits and flies",
    cases,
    run,
    summarise,
    400,
)
