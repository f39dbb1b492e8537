"""File transfer with killed processes.

The link process and the ground's `flight files` run as separate processes on loopback. In each of N
transfers, alternately downlink and uplink, each process receives one SIGKILL at a random time and is
restarted. The benchmark counts the transfers whose file arrived complete (SHA-256) and which are closed at
both ends.
"""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import numpy as np

from tests.studies.command import Seed, command, say, scratch
from tests.support.flooded_flight import free_port
from tests.support.linked_board import write_linked_config
from tests.support.linked_flight import service

_RATE = 1.5e5
_START_S, _LATEST_S = 1.0, 3.0
"""Time (s) that a process needs to start, and time (s) after the start within which it is killed."""
_PATIENCE_S = 120.0


@command
def main(
    *,
    kills: Annotated[int, "of each side"] = 20,
    megabytes: Annotated[float, "of the file"] = 1.0,
    seed: Seed = 1,
) -> int:
    """Run and print all transfers. Returns 0 if all files arrived complete and all transfers were closed."""
    draw, facts = np.random.default_rng(seed), list[dict[str, int]]()
    with scratch() as place:
        bench = _Bench(place, draw.bytes(round(megabytes * 1e6)), draw)
        for number in range(kills):
            facts.append(bench.transfer(number))
            say(transfer=number, **facts[-1])
    sums = {name: sum(fact[name] for fact in facts) for name in ("in_the_middle", "whole", "closed")}
    say(transfers=len(facts), kills=2 * len(facts), **sums)
    return int(not len(facts) == sums["whole"] == sums["closed"])


class _Bench:
    """The link of a satellite and a ground station, with a file at each end."""

    def __init__(self, place: Path, data: bytes, draw: np.random.Generator) -> None:
        self._place, self._data, self._draw = place, data, draw
        self._address = f"127.0.0.1:{free_port()}"
        self._config = write_linked_config(place, udp=self._address, rate=_RATE)
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
        asked = ["files", "--link", self._address, "--keys", self._place / "keys" / "ground"]
        asked += ["--folder", ground, "--rate", f"{_RATE:g}", "--timeout", f"{_PATIENCE_S:g}", *words]
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
