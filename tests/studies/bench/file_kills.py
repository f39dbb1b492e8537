"""File transfer with killed processes: `python -m tests.studies.bench file_kills [--kills N] [--seed S]`.

The link process and the ground's `flight files` run as separate processes on loopback. In each of N
transfers, alternately downlink and uplink, each process receives one SIGKILL at a random time and is
restarted. The benchmark counts the transfers whose file arrived complete (SHA-256) and which are closed at
both ends.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ground.link.terminal import make_keys
from tests.support.flights import CONFIG
from tests.support.flooded_flight import free_port
from tests.support.linked_flight import service

_RATE = 1.5e5
_START_S, _LATEST_S = 1.0, 3.0
"""Time (s) that a process needs to start, and time (s) after the start within which it is killed."""
_PATIENCE_S = 120.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print all transfers. Returns 0 if all files arrived complete and all transfers were closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, metavar="N", help="of each side (default 20)")
    parser.add_argument("--megabytes", type=float, default=1.0, metavar="M", help="of the file (default 1)")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    options = parser.parse_args(arguments)
    draw = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory(prefix="knightcube-") as folder:
        place = Path(folder)
        bench = _Bench(place, draw.bytes(round(options.megabytes * 1e6)), draw)
        facts = []
        for number in range(options.kills):
            facts.append(bench.transfer(number))
            sys.stdout.write(json.dumps({"transfer": number, **facts[-1]}) + "\n")
            sys.stdout.flush()
    whole, closed = (sum(fact[name] for fact in facts) for name in ("whole", "closed"))
    middle = sum(fact["in_the_middle"] for fact in facts)
    found = {"transfers": len(facts), "kills": 2 * len(facts), "in_the_middle": middle}
    sys.stdout.write(json.dumps({**found, "whole": whole, "closed": closed}) + "\n")
    return int(not len(facts) == whole == closed)


class _Bench:
    """The link of a satellite and a ground station, with a file at each end."""

    def __init__(self, place: Path, data: bytes, draw: np.random.Generator) -> None:
        self._place, self._data, self._draw = place, data, draw
        satellite, self._keys = make_keys(place / "keys")
        self._address = f"127.0.0.1:{free_port()}"
        link = {"keys": str(satellite), "udp": self._address, "rate": _RATE}
        commands = json.dumps({"socket": str(place / "commands")})
        self._config = place / "flight.yaml"
        self._config.write_text(f"{CONFIG.read_text()}\ncommands: {commands}\nlink: {json.dumps(link)}\n")
        self._run = place / "runs" / "run-000001"
        self._run.mkdir(parents=True)

    def transfer(self, number: int) -> dict[str, int]:
        """Transfer a file under a new name, and kill the process at each end once."""
        name = f"{number}.bin"
        files, ground = self._place / "keys" / "files", self._place / "ground"
        if number % 2:
            (self._place / name).write_bytes(self._data)
            words, arrived = ["put", "release", self._place / name], files / "received" / "release" / name
        else:
            (self._run / name).write_bytes(self._data)
            full = f"log/run-000001/{name}"
            words, arrived = ["get", full], ground / "received" / full
        asked = ["files", "--link", self._address, "--keys", self._keys, "--folder", ground]
        asked += ["--rate", f"{_RATE:g}", "--timeout", f"{_PATIENCE_S:g}", *words]
        middle = 0
        with ExitStack() as stack:
            link = self._link(stack)
            user = self._user(stack, asked)
            for victim in self._draw.permutation(2).tolist():
                time.sleep(_START_S + float(self._draw.uniform(0.0, _LATEST_S)))
                middle += not arrived.exists()
                killed = link if victim else user
                killed.send_signal(signal.SIGKILL)
                killed.wait()
                link = self._link(stack) if victim else link
                user = user if victim else self._user(stack, asked)
            done = user.wait(_PATIENCE_S + 60.0) == 0
            until = time.monotonic() + _PATIENCE_S
            while (left := self._open()) and time.monotonic() < until:
                time.sleep(0.2)
        came = arrived.read_bytes() if arrived.exists() else b""
        whole = hashlib.sha256(came).digest() == hashlib.sha256(self._data).digest()
        return {"whole": int(whole), "closed": int(done and not left), "in_the_middle": middle}

    def _link(self, stack: ExitStack) -> subprocess.Popen[bytes]:
        log = self._place / "log"
        log.unlink(missing_ok=True)
        words = ("link", self._config, "--log", self._place / "runs")
        return stack.enter_context(service(log, "link open", *words))

    def _user(self, stack: ExitStack, words: list[object]) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "flight", *map(str, words)]
        with (self._place / "user").open("ab") as out:
            return stack.enter_context(subprocess.Popen(line, stdout=out, stderr=out))

    def _open(self) -> list[str]:
        """Return the records of open transfers of both ends."""
        ends = (self._place / "keys" / "files", self._place / "ground")
        return [path.name for end in ends for path in (end / "transfers").glob("*-*.json")]


if __name__ == "__main__":
    raise SystemExit(main())
