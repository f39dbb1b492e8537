"""The command socket under a flood.

The step demonstration runs in real time with a UDP command port, in three cases: without a flood, with 20,000
datagrams a second that are not commands, and with 20,000 a second that begin like commands. An authorised
sender sends twenty pings, each once. The benchmark prints the lateness of the control cycles and the number
of answered pings.
"""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from ground.link.commanding import exchange
from knightcube.errors import FlightError
from tests.studies.command import command, say, scratch
from tests.support.flights import CONFIG
from tests.support.flooded_flight import flood, free_port, lateness, process, wait_for

PINGS = 20
_DATAGRAMS_A_SECOND = 20_000
_KINDS = 500
_ANSWER_S = 2.0
_AFTER_START_S = 5.0
FLOODS = ("none", "no commands", "begin as commands")


@command
def main(*, seconds: Annotated[float, "of each flight"] = 60.0) -> int:
    """Run all cases, and print the measured values.

    Returns 1 if a ping was lost without a flood or under datagrams that are not commands.
    """
    answered = {}
    for kind in FLOODS:
        with scratch() as place:
            facts = measure(place, seconds, kind)
        answered[kind] = facts["answered"]
        say(flood=kind, **facts)
    return int(min(answered[kind] for kind in FLOODS[:2]) < PINGS)


def measure(place: Path, seconds: float, kind: str) -> dict[str, Any]:
    """Run one case. Returns the lateness and the numbers of flood datagrams and of acknowledged pings."""
    port, run, config = free_port(), place / "run", place / "flight.yaml"
    commands = json.dumps({"udp": f"127.0.0.1:{port}"})
    config.write_text(f"{CONFIG.read_text(encoding='utf-8')}\ncommands: {commands}\n", encoding="utf-8")
    ended, sent = threading.Event(), list[int]()
    with ExitStack() as stack:
        words = ("run", config, "--realtime", "--out", run, "--duration", seconds, "--json")
        flight = stack.enter_context(process(*words))
        wait_for(run / "flight-0001.ccsds")
        stack.callback(ended.set)
        ended.wait(_AFTER_START_S)
        if kind != FLOODS[0]:
            own = (port, _datagrams(kind), _DATAGRAMS_A_SECOND, ended, sent)
            threading.Thread(target=flood, args=own, daemon=True).start()
        pause = max(0.0, seconds - 2.0 * _AFTER_START_S) / PINGS
        answered = 0
        for number in range(PINGS):
            answered += _is_answered(port, number)
            ended.wait(pause)
        flight.wait()
    return {**lateness(run), "sent_by_strangers": sum(sent), "pings": PINGS, "answered": answered}


def _datagrams(kind: str) -> list[bytes]:
    """Return flood datagrams: random bytes, or the start of a valid command followed by random bytes."""
    draw = np.random.default_rng(2)
    sizes = draw.integers(16, 200, _KINDS).tolist()
    found = [draw.bytes(size) for size in sizes]
    if kind == FLOODS[1]:
        return found
    begins = CommandPacker().pack(Ping(0), utc_ns())[:2]
    return [begins + data[2:] for data in found]


def _is_answered(port: int, number: int) -> bool:
    """Send a ping once, and return whether its reply arrived."""
    try:
        return bool(exchange(f"127.0.0.1:{port}", CommandPacker().pack(Ping(number), utc_ns()), _ANSWER_S))
    except FlightError:
        return False
