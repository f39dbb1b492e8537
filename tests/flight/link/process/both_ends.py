"""Both ends of a link in one process on a manual clock: a link process, its flight, and a ground terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from flight.link.coding import LinkCodes
from flight.link.commands import open_unix
from flight.link.events import Mode
from flight.link.process.commanding import ControlLine, Report, Sent
from flight.link.process.downlink import LogFollower
from flight.link.process.filing import STATUS
from flight.link.process.station import TURN_NS, Station, StationSettings
from flight.link.security import Vault
from flight.link.telemetry.definitions import COMMAND, LINK, MODE, VERIFICATION
from flight.link.telemetry.log import SegmentStore
from flight.link.telemetry.packets import LAYOUTS, Packer, PacketArray
from ground.link.terminal import Terminal, TerminalSettings, make_keys, report_of
from knightcube.errors import UsageError
from tests.manual_clock import ManualClock

SETTINGS = TerminalSettings(frame_bytes=512)


class Wire:
    """One end of a line, which stores the sent frames."""

    name = "wire"

    def __init__(self) -> None:
        self.up: list[bytes] = []
        self.down: list[bytes] = []
        self.takes: int | None = None  # most frames that the line accepts in one call, or None for no limit
        self.listened = True

    def receive(self) -> list[tuple[bytes, Any]]:
        taken, self.up = self.up, []
        return [(frame, None) for frame in taken]

    def trust(self, sender: Any, now_ns: int) -> None:
        pass

    def send(self, frames: Sequence[bytes], now_ns: int) -> int | None:
        taken = len(frames) if self.takes is None else min(self.takes, len(frames))
        self.down += frames[:taken]
        return taken if self.listened else None

    def close(self) -> None:
        pass

    def ground(self) -> GroundWire:
        """Return the ground's end of this line."""
        return GroundWire(self)


class GroundWire:
    """The ground's end of a line."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire

    def fileno(self) -> int:
        raise UsageError("a wire of this test is not waited for")

    def receive(self) -> list[bytes]:
        taken, self.wire.down = self.wire.down, []
        return taken

    def send(self, frame: bytes) -> None:
        self.wire.up.append(frame)

    def close(self) -> None:
        pass


class StreamWire(Wire):
    """A line on which both ends send streams of bytes, which `noise` damages."""

    def __init__(self, codes: LinkCodes, noise: Callable[[bytes], bytes], kiss: bool = False) -> None:
        super().__init__()
        self.noise, self.board, self.far = noise, codes.on_board(kiss), codes.on_ground(kiss)
        self.received, self.collected = self.board.stream(), self.far.stream()

    def receive(self) -> list[tuple[bytes, Any]]:
        return [(frame, None) for data, _ in super().receive() for frame in self.received.add(data)]

    def send(self, frames: Sequence[bytes], now_ns: int) -> int | None:
        return super().send([self.noise(self.board.wrap(frame)) for frame in frames], now_ns)

    def ground(self) -> GroundWire:
        return GroundStream(self)


class GroundStream(GroundWire):
    """The ground's end of a stream."""

    def __init__(self, wire: StreamWire) -> None:
        super().__init__(wire)
        self.stream = wire

    def receive(self) -> list[bytes]:
        return [frame for data in super().receive() for frame in self.stream.collected.add(data)]

    def send(self, frame: bytes) -> None:
        super().send(self.stream.noise(self.stream.far.wrap(frame)))


class BothEnds:
    """A satellite in orbit and its ground station.

    `renewal` is the status file of the privileged update program.
    """

    renewal = STATUS

    def __init__(
        self,
        place: Path,
        rate: float = 1e6,
        settings: TerminalSettings = SETTINGS,
        idle_rate: float = 0.0,
        codes: LinkCodes | None = None,
        noise: Callable[[bytes], bytes] = bytes,
    ) -> None:
        """Make keys and an empty run in the folder `place`.

        If `codes` is given, the line is a noisy byte stream.
        """
        make_keys(place / "keys")
        self.place, self.rate, self.clock = place, rate, ManualClock()
        self.settings, self.idle_rate, self.codes = settings, idle_rate, codes or LinkCodes()
        self.wire = Wire() if codes is None else StreamWire(codes, noise)
        run = place / "runs" / "run-000001"
        run.mkdir(parents=True)
        self.log = SegmentStore(run, "flight", 1 << 16, 1 << 24)
        self.packer = Packer()
        self.flight = open_unix(place / "commands")
        self.obeyed: list[bytes] = []
        self.mode = Mode.HOLD
        self.packets: list[tuple[int, bytes]] = []
        self.restart()

    def restart(self) -> None:
        """Replace the link process and the terminal by new instances."""
        given = self.settings
        settings = StationSettings(
            given.spacecraft,
            given.frame_bytes,
            self.rate,
            idle_rate=self.idle_rate,
            encrypted=given.encrypted,
            codes=self.codes,
            renewal=self.renewal,
        )
        control: ControlLine[Sent] = ControlLine(self.place / "commands", self.place)
        self.sky = Vault(self.place / "keys" / "satellite")
        follower = LogFollower(self.place / "runs")
        self.station = Station(settings, self.sky, [self.wire], control, follower, self.clock)
        self.ground = Vault(self.place / "keys" / "ground")
        self.terminal = Terminal(self.wire.ground(), self.ground, given, self.codes)

    def record(self, *packets: bytes) -> None:
        """Write packets into the flight log."""
        self.log.append(list(packets))

    def mode_packet(self, mode: Mode, trigger: str) -> bytes:
        """Return the packet of a mode change at the present time."""
        fields = {"before": 0, "mode": int(mode), "trigger": trigger, "reason": "", "target_q2": 0.0}
        return self.packer.pack(MODE, self.clock.now_ns(), fields)

    def turn(self, seconds: float = 0.5, answer: Callable[[bytes], bool] | None = None) -> None:
        """Advance the clock.

        The flight executes received commands; if `answer` is given, this function decides whether a command
        is executed.
        """
        until = self.clock.now_ns() + round(seconds * 1e9)
        while self.clock.now_ns() < until:
            self.station.turn()
            for data, sender in self.flight.poll():
                good = answer is None or answer(data)
                if good:
                    self.obeyed.append(data)
                fields = {"obeyed": int(good), "name": "x", "source": "socket", "count": 1}
                fields |= {"mode": int(self.mode), "text": "as commanded"}
                self.flight.answer(self.packer.pack(COMMAND, self.clock.now_ns(), fields), sender)
            self.clock.advance(TURN_NS)
        self.collect()

    def collect(self) -> None:
        """Process the received telemetry."""
        self.packets += self.terminal.take()

    def stages(self, counter: int, spi: int = 1) -> list[str]:
        """Return the verification stages that the ground has received for a command."""
        return [r.stage.name.lower() for r in self.reports() if (r.counter, r.spi) == (counter, spi)]

    def reports(self) -> list[Report]:
        """Return all received reports."""
        return list(filter(None, map(report_of, self.of(VERIFICATION.name))))

    def of(self, name: str) -> list[bytes]:
        """Return the received packets with a name."""
        identifier = LAYOUTS[name].identifier.to_bytes(2, "big")
        return [packet for _, packet in self.packets if packet[:2] == identifier]

    def status(self) -> PacketArray:
        """Return the newest status packet of the link."""
        (row,) = LAYOUTS[LINK.name].array(self.of(LINK.name)[-1])
        return row

    def close(self) -> None:
        """Close the open files and sockets."""
        self.flight.close()
        self.log.close()
