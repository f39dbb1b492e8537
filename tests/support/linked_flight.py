"""A real-time flight with its link and a gateway, as separate processes on loopback."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from ground.link.terminal import make_keys

_START_S, _END_S = 120.0, 30.0
_RATE = 1_000_000
"""Data rate (bytes/s) of the link, high enough that no packet is dropped and the archive equals the log."""


@dataclass(frozen=True, slots=True)
class LinkedFlight:
    """Folder of a flight, address and keys of its gateway, and its processes by name, `flight` last."""

    run: Path
    gateway: str
    keys: Path
    processes: dict[str, subprocess.Popen[bytes]]
    _start: list[str]
    _log: Path

    def start(self) -> None:
        """Start the flight, and wait for its log."""
        self.processes["flight"] = _started(self._start, self._log)
        _wait((self.run / "flight-0001.ccsds").exists, "the flight", self._log)

    def end(self) -> None:
        """End the flight. Link and gateway keep running and transmit the rest of its log."""
        end(self.processes["flight"])

    def stop(self) -> None:
        """End all processes."""
        for process in reversed(self.processes.values()):
            end(process)


def free_port() -> int:
    """Return an unused TCP port of loopback."""
    with socket.create_server(("127.0.0.1", 0)) as line:
        return int(line.getsockname()[1])


@contextmanager
def linked_flight(place: Path, text: str, *words: str) -> Iterator[LinkedFlight]:
    """Open link and gateway of a flight with the configuration `text`. The method `start` starts the flight.

    All processes are ended at the end of the `with` block.
    """
    place.mkdir(parents=True)
    make_keys(place / "keys")
    link, gateway = (f"127.0.0.1:{free_port()}" for _ in range(2))
    section = {"keys": str(place / "keys" / "satellite"), "tcp": link, "rate": _RATE}
    config, run, log = place / "flight.yaml", place / "run", place / "log"
    commands = {"socket": str(place / "commands")}
    config.write_text(f"{text}\ncommands: {json.dumps(commands)}\nlink: {json.dumps(section)}\n")
    flight = [sys.executable, "-m", "flight"]
    begin = [*flight, "run", str(config), "--realtime", "--out", str(run), *words]
    processes: dict[str, subprocess.Popen[bytes]] = {}
    found = LinkedFlight(run, gateway, place / "keys" / "ground", processes, begin, log)
    with ExitStack() as stack:
        stack.callback(found.stop)
        processes["link"] = _started([*flight, "link", str(config), "--log", str(run)], log)
        _wait(lambda: "link open" in log.read_text(), "the link", log)
        way = ["--link", f"tcp:{link}", "--keys", str(found.keys), "--serve", gateway]
        processes["gateway"] = _started([*flight, "gateway", *way], log)
        _wait(lambda: "packets on" in log.read_text(), "the gateway", log)
        yield found


@contextmanager
def service(log: Path, ready: str, *words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run `python -m flight WORDS` during a `with` block.

    The block begins when the output contains `ready`.
    """
    process = _started([sys.executable, "-m", "flight", *map(str, words)], log)
    try:
        _wait(lambda: ready in log.read_text(), str(words[0]), log)
        yield process
    finally:
        end(process)


def _started(words: list[str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("ab") as out:
        return subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT)


def _wait(done: Callable[[], bool], name: str, log: Path) -> None:
    until = time.monotonic() + _START_S
    while not done():
        if time.monotonic() > until:
            raise RuntimeError(f"{name} did not start:\n{log.read_text()[-2000:]}")
        time.sleep(0.1)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process, and kill it if it does not end."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
