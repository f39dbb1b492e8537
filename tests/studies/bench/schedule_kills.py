"""The link killed while scheduled commands fall due: python -m tests.studies.bench schedule_kills.

Each time commands are scheduled, and a link process that executes them is killed (SIGKILL) before or after
one of its calls that write to the disk or to the socket of the flight; some of the writes are cut in the
middle. Then another takes over, and at last one is not killed. Counted are commands that the flight got
twice, commands that it never got, of which each kill may cost one, and schedules with no good copy.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from flight.link.commands import DatagramChannel, Ping, open_unix, unpack
from flight.link.modes import Mode
from flight.link.process.commanding import ControlLine, Sent, Timetable
from flight.link.process.downlink import LogFollower
from flight.link.process.station import TURN_NS, Station, StationSettings
from flight.link.security import Vault
from flight.link.telemetry.definitions import MODE
from flight.link.telemetry.packets import Packer
from ground.link.terminal import make_keys
from tests.flight.link.process.both_ends import SETTINGS
from tests.manual_clock import ManualClock
from tests.studies.bench.link_kills import Way, killed

_AT_ONCE = 3
_POINTS = 5 * _AT_ONCE + 8
"""Calls that write: of each command two copies with two calls each and a send; then telemetry's counters."""
_RATE = 1e6


@dataclass
class Findings:
    """What came of the kills.

    Attributes:
        kills: of the link.
        scheduled: commands.
        lost: schedules of which no copy was good.
        got: how often the flight got each command.
    """

    kills: int = 0
    scheduled: int = 0
    lost: int = 0
    got: Counter[int] = field(default_factory=Counter)

    @property
    def twice(self) -> int:
        """Commands that the flight got more than once."""
        return sum(count > 1 for count in self.got.values())

    @property
    def never(self) -> int:
        """Commands that the flight never got."""
        return self.scheduled - len(self.got)


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill, count, print; return 0 when nothing came twice, and a kill cost one command at most."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000, metavar="N", help="default 1000")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        found = measure(Path(place), options.kills, options.seed)
    facts = {"kills": found.kills, "scheduled": found.scheduled, "got": len(found.got)}
    facts |= {"twice": found.twice, "never": found.never, "schedules_lost": found.lost}
    sys.stdout.write(json.dumps(facts) + "\n")
    return int(found.twice + found.lost > 0 or found.never > found.kills or not found.got)


def measure(place: Path, kills: int, seed: int) -> Findings:
    """Schedule three commands and kill the link that executes them, again and again."""
    make_keys(place / "keys")
    run = place / "run-000001"
    run.mkdir()
    fields = {"before": 0, "mode": int(Mode.HOLD), "trigger": "start", "reason": "", "target_q2": 0.0}
    (run / "flight-0001.ccsds").write_bytes(Packer().pack(MODE, 1, fields))
    folder, flight = Vault(place / "keys" / "satellite").folder, open_unix(place / "commands")
    draw, found = np.random.default_rng(seed), Findings()
    due_ns = ManualClock().utc_ns() + 2 * TURN_NS
    for _ in range(kills):
        table = Timetable(folder)
        found.lost += table.lost
        for _ in range(_AT_ONCE):
            table.add(due_ns, 1, 0, f"ping {found.scheduled}")
            found.scheduled += 1
        killed(partial(_serve, place), int(draw.integers(0, _POINTS)), bool(draw.integers(2)))
        found.kills += 1
        _count(flight, found)
        killed(partial(_serve, place), sys.maxsize, torn=False)
        _count(flight, found)
    flight.close()
    return found


def _count(flight: DatagramChannel, found: Findings) -> None:
    while got := flight.poll():
        commands = [unpack(data) for data, _ in got]
        found.got.update(command.number for command in commands if isinstance(command, Ping))


def _serve(place: Path, way: Way) -> None:
    """Serve as the link for a moment, in which the commands fall due."""
    control: ControlLine[Sent] = ControlLine(place / "commands", place)
    clock = ManualClock()
    settings = StationSettings(SETTINGS.spacecraft, SETTINGS.frame_bytes, _RATE)
    vault = Vault(place / "keys" / "satellite")
    station = Station(settings, vault, [], control, LogFollower(place), clock)
    for _ in range(6):
        station.turn()
        clock.advance(TURN_NS)


if __name__ == "__main__":
    raise SystemExit(main())
