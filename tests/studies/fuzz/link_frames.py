"""Mutated, replayed, reordered and forged frames through the gate of the link.

Accepted corruption is: data that the ground never sent under that counter; a counter that was let in before,
also before a restart; one that is behind another.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from pathlib import Path

import numpy as np

from flight.link.frames import TELECOMMAND_HEADER, TELECOMMAND_MASK, TelecommandHeader, close_frame
from flight.link.process.station import parser_of
from flight.link.security import COMMAND_SPIS, OVERHEAD_BYTES, Gate, RefusedError, Sealer, Vault
from flight.link.telemetry.packets import CRC_BYTES
from ground.link.terminal import make_keys
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer

_SPACECRAFT = 0x1A5
_KEPT = 64
_HEADERS = TELECOMMAND_HEADER.size + 14


class LinkFrames:
    """The target: both ends, with an attacker between them who has seen every frame."""

    def __init__(self) -> None:
        folder = Path(tempfile.mkdtemp(prefix="knightcube-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        satellite, ground = make_keys(folder / "keys")
        self._sky = Vault(satellite)
        at = Vault(ground)
        self._sealers = {spi: Sealer(at, spi, TELECOMMAND_MASK, 1 << 20) for spi in COMMAND_SPIS}
        self._gate = self._opened()
        self._sent: dict[tuple[int, int], bytes] = {}
        self._seen: list[bytes] = []
        self._held: list[bytes] = []
        self._highest = dict.fromkeys(COMMAND_SPIS, -1)
        self._last = b""

    def last(self) -> str:
        """Return the last frame."""
        return self._last.hex()

    def attempt(self, draw: np.random.Generator) -> Counter[str]:
        """Let the attacker or the ground send one frame. Raises Finding."""
        kind, frame = self.frame(draw)
        self._last = frame
        if chance(draw, 0.002):
            self._gate = self._opened()
        try:
            admitted = self._gate.admit(frame)
        except RefusedError as error:
            if kind == "fresh":
                raise Finding(f"an authentic new frame was refused: {error}") from error
            return Counter([kind, error.cause.name.lower()])
        if self._sent.get((admitted.spi, admitted.counter)) != admitted.data:
            raise Finding("a forged frame was let in")
        if admitted.counter <= self._highest[admitted.spi]:
            raise Finding("a counter was let in again, or behind another")
        self._highest[admitted.spi] = admitted.counter
        return Counter([kind, "admitted", *(["damaged"] if frame not in self._seen else [])])

    def _opened(self) -> Gate:
        return Gate(self._sky, COMMAND_SPIS, parser_of(_SPACECRAFT), TELECOMMAND_MASK)

    def frame(self, draw: Draw) -> tuple[str, bytes]:
        """Return the kind and the bytes of the next frame."""
        if not self._seen or chance(draw, 0.1):
            self._held.clear()  # what was held back is now old
            return "fresh", self._new(draw)
        if chance(draw, 0.05):
            self._held.append(self._new(draw))
        if self._held and chance(draw, 0.15):
            return "reordered", self._held.pop(integer(draw, 0, len(self._held) - 1))
        one, other = self._any(draw), self._any(draw)
        attacks = {
            "replayed": one,
            "mutated": damage(draw, one),
            "mutated, right CRC": close_frame(damage(draw, one[:-CRC_BYTES])),
            "spliced": close_frame(one[:_HEADERS] + other[_HEADERS:-CRC_BYTES]),
            "forged": self._forged(draw),
        }
        kind = list(attacks)[integer(draw, 0, len(attacks) - 1)]
        return kind, attacks[kind]

    def _any(self, draw: Draw) -> bytes:
        frames = self._seen + self._held
        return frames[integer(draw, 0, len(frames) - 1)]

    def _new(self, draw: Draw) -> bytes:
        spi = COMMAND_SPIS[integer(draw, 0, 1)]
        data = draw.bytes(integer(draw, 0, 200))
        body, counter = self._sealers[spi].seal(_header(len(data)), data)
        self._sent[spi, counter] = data
        frame = close_frame(body)
        self._seen = [*self._seen, frame][-_KEPT:]
        return frame

    def _forged(self, draw: Draw) -> bytes:
        """Return a frame with the next counter and a random text and MAC."""
        size = integer(draw, 0, 100)
        spi = COMMAND_SPIS[integer(draw, 0, 1)]
        counter = self._highest[spi] + integer(draw, 0, 3)
        iv = max(counter, 0).to_bytes(12, "big")
        return close_frame(_header(size) + spi.to_bytes(2, "big") + iv + draw.bytes(size + 16))


def _header(size: int) -> bytes:
    length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + size + CRC_BYTES
    return TelecommandHeader(_SPACECRAFT, 0, 0).pack(length)
