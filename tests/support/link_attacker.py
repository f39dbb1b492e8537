"""An attacker between ground and satellite, who knows every frame and everything except the keys."""

from __future__ import annotations

import tempfile
from pathlib import Path
from random import Random

from flight.link.frames import TELECOMMAND_HEADER, TELECOMMAND_MASK, TelecommandHeader, close_frame
from flight.link.process.station import parser_of
from flight.link.security import COMMAND_SPIS, OVERHEAD_BYTES, Gate, RefusedError, Sealer, Vault
from flight.link.telemetry.packets import CRC_BYTES
from ground.link.terminal import make_keys
from tests.support.damaged import damage

_SPACECRAFT = 0x1A5
_KEPT = 64
_HEADERS = TELECOMMAND_HEADER.size + 14


class LinkAttacker:
    """Both ends of a link, and an attacker who replays, reorders, mutates, splices and forges frames.

    Attributes:
        sent: data that the ground sent, by SPI and counter.
        highest: highest counter admitted for each SPI.
    """

    def __init__(self, folder: Path) -> None:
        satellite, ground = make_keys(folder / "keys")
        self._vault, sender = Vault(satellite), Vault(ground)
        self._sealers = {spi: Sealer(sender, spi, TELECOMMAND_MASK, 1 << 20) for spi in COMMAND_SPIS}
        self.sent: dict[tuple[int, int], bytes] = {}
        self.highest = dict.fromkeys(COMMAND_SPIS, -1)
        self._seen: list[bytes] = []
        self._held: list[bytes] = []
        self.gate = self.restarted()

    def restarted(self) -> Gate:
        """Return a new frame gate with the satellite's stored keys and counters, as after a restart."""
        return Gate(self._vault, COMMAND_SPIS, parser_of(_SPACECRAFT), TELECOMMAND_MASK)

    def attack(self, chance: Random) -> None:
        """Send one frame, and assert that the gate admits only new authentic frames."""
        kind, frame = self.frame(chance)
        if chance.random() < 0.02:
            self.gate = self.restarted()
        try:
            admitted = self.gate.admit(frame)
        except RefusedError as error:
            if kind == "fresh":
                raise AssertionError(f"a new genuine frame was refused: {error}") from error
            return
        assert self.sent.get((admitted.spi, admitted.counter)) == admitted.data, f"{kind} frame admitted"
        assert admitted.counter > self.highest[admitted.spi], "a counter was admitted twice"
        self.highest[admitted.spi] = admitted.counter

    def frame(self, chance: Random) -> tuple[str, bytes]:
        """Return the type and the bytes of the next frame."""
        if not self._seen or chance.random() < 0.1:
            self._held.clear()  # the delayed frames are too old to be admitted
            return "fresh", self._new(chance)
        if chance.random() < 0.05:
            self._held.append(self._new(chance))
        if self._held and chance.random() < 0.15:
            return "reordered", self._held.pop(chance.randrange(len(self._held)))
        frames = self._seen + self._held
        one, other = chance.choice(frames), chance.choice(frames)
        attacks = {
            "replayed": one,
            "mutated": damage(chance, one),
            "mutated, right CRC": close_frame(damage(chance, one[:-CRC_BYTES])),
            "spliced": close_frame(one[:_HEADERS] + other[_HEADERS:-CRC_BYTES]),
            "forged": self._forged(chance),
        }
        kind = chance.choice(list(attacks))
        return kind, attacks[kind]

    def _new(self, chance: Random) -> bytes:
        spi = chance.choice(COMMAND_SPIS[:2])
        data = chance.randbytes(chance.randint(0, 200))
        body, counter = self._sealers[spi].seal(_header(len(data)), data)
        self.sent[spi, counter] = data
        frame = close_frame(body)
        self._seen = [*self._seen, frame][-_KEPT:]
        return frame

    def _forged(self, chance: Random) -> bytes:
        """Return a frame with the next counter and a random text and MAC."""
        size, spi = chance.randint(0, 100), chance.choice(COMMAND_SPIS[:2])
        counter = max(self.highest[spi] + chance.randint(0, 3), 0)
        body = spi.to_bytes(2, "big") + counter.to_bytes(12, "big") + chance.randbytes(size + 16)
        return close_frame(_header(size) + body)


def attackers_frames(count: int) -> list[bytes]:
    """Return random frames of an attacker: replayed, damaged and forged."""
    chance = Random(1)
    with tempfile.TemporaryDirectory() as folder:
        attacker = LinkAttacker(Path(folder))
        return [attacker.frame(chance)[1] for _ in range(count)]


def _header(size: int) -> bytes:
    length = TELECOMMAND_HEADER.size + OVERHEAD_BYTES + size + CRC_BYTES
    return TelecommandHeader(_SPACECRAFT, 0, 0).pack(length)
