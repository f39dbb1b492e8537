"""Both ends of a link with their files, on a manual clock and a line that loses frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flight.link.files.store import Store
from flight.link.files.transfer import Progress
from flight.link.process.commanding import Report
from flight.link.process.directives import Directive
from flight.link.process.station import TURN_NS
from ground.link.commanding import FileSession, failed
from tests.flight.link.process.both_ends import BothEnds

_MOST_S = 7200.0


class FiledEnds(BothEnds):
    """A satellite and a ground station that transfer files.

    Attributes:
        ended: transfers that have ended at the ground.
        seconds: time (s) of the clock until all transfers were closed.
    """

    def __init__(
        self, place: Path, rate: float = 1e6, loss: float = 0.0, up_rate: float = 1e5, seed: int = 1
    ) -> None:
        self.loss, self.up_rate = loss, up_rate
        self.draw = np.random.default_rng(seed)
        self.ended: list[Progress] = []
        super().__init__(place, rate)

    def restart(self) -> None:
        """Replace link process, terminal and file session by new instances, as after kills."""
        super().restart()
        store = Store(self.place / "ground-files")
        self.session = FileSession(self.terminal, store, 1, self.up_rate, self.clock.now_ns())

    def ask(self, directive: Directive) -> None:
        """Send a directive by the file session."""
        self.session.ask(directive, self.clock.now_ns())

    def turn(self, seconds: float = 0.5, answer: object = None) -> None:
        """Advance the clock in steps of one link cycle."""
        del answer
        until = self.clock.now_ns() + round(seconds * 1e9)
        while self.clock.now_ns() < until:
            self.wire.up = self._left(self.wire.up)
            super().turn(TURN_NS * 1e-9)

    def collect(self) -> None:
        """Process the received telemetry, and pass it to the file session."""
        now_ns = self.clock.now_ns()
        self.wire.down = self._left(self.wire.down)
        packets = list(self.terminal.take())
        self.packets += packets
        self.session.take(packets, now_ns)
        self.session.transmit(now_ns)
        while self.session.entity.ended:
            self.ended.append(self.session.entity.ended.popleft())

    def until_closed(self) -> None:
        """Advance the clock until the ground has no open transfer. Raises TimeoutError."""
        until = self.clock.now_ns() + round(_MOST_S * 1e9)
        self.turn(0.5)
        while self.session.entity.transfers() or self.station.transfers:
            if self.clock.now_ns() > until:
                raise TimeoutError(f"open: {self.session.entity.transfers()}")
            self.turn(0.5)

    def command(self, directive: Directive) -> str:
        """Send a command; return the reason of its failure, or its last verification stage."""
        self.session.reports()
        self.ask(directive)
        reports: list[Report] = []
        until = self.clock.now_ns() + round(_MOST_S * 1e9)
        while not reports or not reports[-1].stage.final:
            assert self.clock.now_ns() < until
            self.turn(0.5)
            reports += self.session.reports()
        return failed(reports) or reports[-1].stage.name.lower()

    def _left(self, frames: list[bytes]) -> list[bytes]:
        """Return the frames that the line does not lose."""
        return [frame for frame in frames if self.draw.random() >= self.loss]
