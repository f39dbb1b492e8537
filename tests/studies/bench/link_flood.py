"""Lateness of the loop while its link is flooded.

The step demonstration flies in real time on its emulated devices beside its link process. It flies first
without a flood. In the second flight the link receives 10,000 forged frames a second. Meanwhile it plays back
the archive and sends a file of 50 MB, at a total of a megabyte per second. The benchmark prints the lateness
of the control cycles, the counts of link and ground, and the received part of the file.
"""

from __future__ import annotations

import subprocess
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flight.app.run import utc_ns
from flight.link.files.store import Store
from flight.link.process import directives
from flight.link.process.directives import Play, SendFile
from flight.link.telemetry.definitions import LINK
from flight.link.telemetry.packets import LAYOUTS
from ground.link.commanding import FileSession
from ground.link.terminal import open_terminal
from tests.studies.command import command, say, scratch
from tests.support.flooded_flight import flood, free_port, lateness, process, wait_for
from tests.support.link_attacker import attackers_frames
from tests.support.linked_board import write_linked_config

_FRAMES_A_SECOND = 10_000
_KINDS = 500
_FILE, _FILE_BYTES = "dump.bin", 50_000_000
_UP_RATE = 20_000.0


@command
def main(*, seconds: Annotated[float, "of each flight"] = 60.0) -> int:
    """Run both flights, and print the measured values."""
    for name in ("alone", "flooded"):
        with scratch() as place:
            say(flight=name, **measure(place, seconds, flooded=name == "flooded"))
    return 0


def measure(place: Path, seconds: float, *, flooded: bool) -> dict[str, Any]:
    """Run one flight. Returns quantiles of the lateness (ms), the number of cycles, and the link's counts."""
    frames = attackers_frames(_KINDS) if flooded else []
    with ExitStack() as stack:
        port = free_port()
        config = write_linked_config(place, udp=f"127.0.0.1:{port}", rate=1e6)
        run = place / "run"
        flight = stack.enter_context(
            process("run", config, "--realtime", "--out", run, "--duration", seconds, "--json")
        )
        wait_for(run / "flight-0001.ccsds")
        link = stack.enter_context(process("link", config, "--log", run))
        ended, forged = threading.Event(), list[int]()
        stack.callback(ended.set)
        if flooded:
            wait_for(place / "commands")
            own = (port, frames, _FRAMES_A_SECOND, ended, forged)
            threading.Thread(target=flood, args=own).start()
        counts = _listen(port, place, flight, flooded)
        ended.set()
        assert link.poll() is None, "the link has ended by itself"
    return {**lateness(run), "forged": sum(forged), **counts}


def _listen(port: int, place: Path, flight: subprocess.Popen[bytes], play: bool) -> dict[str, int]:
    """Receive telemetry and request playbacks until the flight ends; return the counts."""
    keys = place / "keys" / "ground"
    terminal = open_terminal(f"127.0.0.1:{port}", keys)
    store, now_ns = Store(place / "ground-files"), time.monotonic_ns()
    session = FileSession(terminal, store, 2, _UP_RATE, now_ns)
    if play:
        (place / "run" / _FILE).write_bytes(np.random.default_rng(1).bytes(_FILE_BYTES))
        session.ask(SendFile(f"log/{_FILE}"), now_ns)
    newest, packets, asked = b"", 0, 0.0
    while flight.poll() is None:
        if time.monotonic() - asked > 1.0:
            asked = time.monotonic()
            stretch = Play(0, 0.0, 1e4 if play else 0.0)
            terminal.send(directives.pack(stretch, utc_ns()))
        for channel, packet in terminal.packets(0.2):
            packets += 1
            session.take([(channel, packet)], time.monotonic_ns())
            if packet[:2] == LAYOUTS[LINK.name].identifier.to_bytes(2, "big"):
                newest = packet
        session.transmit(time.monotonic_ns())
    file_bytes = sum(one.done for one in (*session.entity.transfers(), *session.entity.ended))
    session.close(time.monotonic_ns())
    terminal.close()
    (row,) = LAYOUTS[LINK.name].array(newest)
    names = ("received", "admitted", "refused_crc", "refused_mac", "refused_repeated", "sent")
    counts = {name: int(row[name]) for name in names}
    return {**counts, "packets_on_ground": packets, "file_bytes": file_bytes}
