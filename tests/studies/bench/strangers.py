"""Commands and lateness under attack by strangers.

In each round the step demonstration flies twice in real time on its emulated devices beside its link process:
without and with an attack. The attackers share one core. They send 30,000 datagrams a second from an address
that the link does not accept. They also open 200 TCP connections a second from an accepted address, and send
bytes that form no frame. With `--forged N` they also send N forged frames a second from an accepted address:
replayed, damaged and without the key. The link must examine these frames, so commands by UDP may be lost. In
both flights the operator sends 40 commands, alternately by UDP, by a persistent TCP connection and by a new
TCP connection. The benchmark prints the executed commands, the rates of the attackers, and the lateness of
the control cycles. The exit status is 1 if a command was not executed, or if the attack more than doubles the
99 % quantile of the lateness (medians over the rounds).
"""

from __future__ import annotations

import multiprocessing
import os
import random
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from flight.app.run import utc_ns
from flight.link.commands import CommandPacker, Ping
from ground.link.commanding import failed, obeyed
from ground.link.terminal import open_terminal
from knightcube.errors import KnightCubeError
from tests.studies.command import command, say, scratch
from tests.support.flooded_flight import lateness, process, wait_for
from tests.support.link_attacker import attackers_frames
from tests.support.linked_board import free_ports, write_linked_config

DATAGRAMS, CONNECTIONS, COMMANDS = 30_000, 200, 40
"""Datagrams a second, TCP connections a second, and commands of the operator in each flight."""
WITHIN = 2.0
_PEER, _STRANGER = "127.0.0.1", "127.0.0.2"
_BURST_S = 0.01
_KINDS = 500
_START_S, _ANSWER_S, _PAUSE_S = 12.0, 5.0, 1.0


@command
def main(
    *,
    rounds: Annotated[int, "of two flights"] = 3,
    commands: Annotated[int, "in each flight"] = COMMANDS,
    forged: Annotated[int, "forged frames a second from a peer's address"] = 0,
) -> int:
    """Fly all rounds, print, and return the exit status."""
    p99: dict[str, list[float]] = {"quiet": [], "attacked": []}
    missing = 0
    for _ in range(rounds):
        for name, late in p99.items():
            with scratch() as place:
                facts = measure(place, commands, attacked=name == "attacked", forged=forged)
            late.append(facts["lateness_ms"]["p99"])
            missing += len(facts["failures"])
            say(flight=name, **facts)
    ratio = median(p99["attacked"]) / median(p99["quiet"])
    say(p99_over_quiet=round(ratio, 2), commands_missing=missing)
    return int(missing > 0 or ratio > WITHIN)


def measure(place: Path, commands: int, *, attacked: bool, forged: int = 0) -> dict[str, Any]:
    """Run one flight. Returns the executed commands, the lateness (ms), and the rates of the attackers."""
    udp, tcp = free_ports([socket.SOCK_DGRAM, socket.SOCK_STREAM])
    with ExitStack() as stack:
        lines: dict[str, Any] = {"udp": f"{_PEER}:{udp}", "tcp": f"{_PEER}:{tcp}", "peers": [f"{_PEER}/32"]}
        config, run = write_linked_config(place, **lines, rate=1e5), place / "run"
        flight = stack.enter_context(process("run", config, "--realtime", "--out", run))
        wait_for(run / "flight-0001.ccsds")
        link = stack.enter_context(process("link", config, "--log", run))
        wait_for(place / "commands")
        _wait_for_port(tcp)
        rates = stack.enter_context(_strangers(udp, tcp, forged)) if attacked else dict
        time.sleep(_START_S / 2.0)
        failures = _command(commands, udp, tcp, place / "keys" / "ground")
        found = rates()
        assert (flight.poll(), link.poll()) == (None, None), "the flight or the link has ended by itself"
        flight.terminate()
        flight.wait()
    done = commands - len(failures)
    return {"obeyed": done, "commands": commands, "failures": failures, **found, **lateness(run)}


def _wait_for_port(tcp: int) -> None:
    """Wait until a link listens on the port. Raises TimeoutError if none does in time."""
    until = time.monotonic() + 2.0 * _START_S
    while time.monotonic() < until:
        with suppress(OSError):
            socket.create_connection((_PEER, tcp)).close()
            return
        time.sleep(0.1)
    raise TimeoutError(f"no link listens on port {tcp}")


def _command(count: int, udp: int, tcp: int, keys: Path) -> list[str]:
    """Send commands over three connections in turn; return number and reason of each unexecuted command."""
    packer, failures = CommandPacker(), list[str]()
    ways = (f"{_PEER}:{udp}", f"tcp:{_PEER}:{tcp}", f"tcp:{_PEER}:{tcp}")
    with ExitStack() as stack:
        lasting = [stack.enter_context(closing(open_terminal(way, keys))) for way in ways[:2]]
        for terminal in lasting:  # The gateway and the console also keep such connections open.
            terminal.send(packer.pack(Ping(), utc_ns()))
        for number in range(count):
            try:
                with ExitStack() as fresh:
                    if (turn := number % len(ways)) < len(lasting):
                        terminal = lasting[turn]
                    else:
                        terminal = fresh.enter_context(closing(open_terminal(ways[turn], keys)))
                    counter = terminal.send(packer.pack(Ping(number), utc_ns()))
                    reports = list(terminal.follow(counter, 1, _ANSWER_S))
                    if not obeyed(reports):
                        failures.append(f"{number}: {failed(reports) or 'no answer'}")
            except KnightCubeError as error:
                failures.append(f"{number}: {error}")
            time.sleep(_PAUSE_S)
    return failures


@contextmanager
def _strangers(udp: int, tcp: int, forged: int) -> Iterator[Callable[[], dict[str, float]]]:
    """Run all floods on one core; yield a function that returns their mean rates so far."""
    context = multiprocessing.get_context("fork")
    counts = {name: context.Value("Q", 0) for name in ("datagrams", "connections", "forged")}
    attacks: list[tuple[Callable[..., None], tuple[Any, ...]]] = [
        (_send, (udp, _STRANGER, [bytes(64)], DATAGRAMS, counts["datagrams"])),
        (_connect, (tcp, counts["connections"])),
    ]
    if forged:
        attacks.append((_send, (udp, _PEER, attackers_frames(_KINDS), forged, counts["forged"])))
    floods = [context.Process(target=attack, args=args, daemon=True) for attack, args in attacks]
    for one in floods:
        one.start()
    begun = time.monotonic()

    def rates() -> dict[str, float]:
        seconds = time.monotonic() - begun
        return {f"{name}_a_second": round(count.value / seconds) for name, count in counts.items()}

    try:
        yield rates
    finally:
        for one in floods:
            one.terminate()
            one.join()


def _send(port: int, source: str, datagrams: Sequence[bytes], a_second: int, count: Any) -> None:
    """Send randomly chosen `datagrams` to the port, from the address `source`."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    burst = round(a_second * _BURST_S)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind((source, 0))
        line.connect((_PEER, port))
        for _ in _grid(_BURST_S):
            for datagram in random.choices(datagrams, k=burst):
                with suppress(OSError):
                    line.send(datagram)
            count.value += burst


def _connect(port: int, count: Any) -> None:
    """Open connections from an accepted address, and leave each open until the link closes it."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    lines: list[socket.socket] = []
    for _ in _grid(1.0 / CONNECTIONS):
        with suppress(OSError):
            lines.append(socket.create_connection((_PEER, port), timeout=1.0))
            count.value += 1
            lines[-1].sendall(b"GET / HTTP/1.1\r\n\r\n" * 8)
        while len(lines) > CONNECTIONS:
            lines.pop(0).close()


def _grid(period: float) -> Iterator[None]:
    """Yield once per period (s). Missed periods are yielded immediately."""
    due = time.monotonic()
    while True:
        yield
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
