"""Two CFDP entities and a lossy channel between them, on a manual clock."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from flight.link.files.store import FileError, Store
from flight.link.files.transfer import CRC32, GROUND, SATELLITE, Entity, Origin, Progress
from flight.link.files.units import Metadata

STEP_NS = 20_000_000
MOST = 1 << 24


def anything(_: Metadata) -> str:
    return ""


class Pair:
    """A satellite and a ground station.

    The channel loses data units in both directions with a given probability.
    """

    def __init__(self, place: Path, loss: float, seed: int = 1) -> None:
        self.place, self.loss = place, loss
        self.draw = np.random.default_rng(seed)
        self.now_ns = 0
        self.carried = 0
        self.ended: dict[int, list[Progress]] = {SATELLITE: [], GROUND: []}
        self.ends = {number: self.opened(number) for number in (SATELLITE, GROUND)}

    def store(self, number: int) -> Store:
        return Store(self.place / str(number))

    def opened(self, number: int) -> Entity:
        return Entity(number, self.store(number), anything, MOST, self.now_ns)

    def kill(self, number: int) -> None:
        """Discard the state of one end without closing it, and open a new one."""
        self.ends[number] = self.opened(number)

    def send(self, source: int, path: Path, name: str, kind: int = CRC32) -> Progress:
        to = GROUND if source == SATELLITE else SATELLITE
        return self.ends[source].send(path, name, to, kind, self.now_ns, self.now_ns, Origin())

    def turn(self, units: int = 20) -> None:
        """Send up to `units` data units from each end, and advance the clock."""
        for number, other in ((SATELLITE, GROUND), (GROUND, SATELLITE)):
            for _ in range(units):
                unit = self.ends[number].unit(self.now_ns)
                if unit is None:
                    break
                self.carried += 1
                if self.draw.random() >= self.loss:
                    self.ends[other].take(unit, self.now_ns)
            self.ends[number].work(self.now_ns)
            with suppress(FileError):  # `flight.link.process.filing` reports this error
                self.ends[number].keep(self.now_ns)
        for number, end in self.ends.items():
            while end.ended:
                self.ended[number].append(end.ended.popleft())
        self.now_ns += STEP_NS

    def until_closed(self, seconds: float = 3600.0) -> None:
        """Run both ends until no transfer is open. Raises TimeoutError."""
        until = self.now_ns + round(seconds * 1e9)
        while any(end.transfers() for end in self.ends.values()):
            self.turn()
            if self.now_ns > until:
                raise TimeoutError(f"open: {[end.transfers() for end in self.ends.values()]}")

    def received(self, number: int, name: str) -> bytes:
        return (self.store(number).received / name).read_bytes()
