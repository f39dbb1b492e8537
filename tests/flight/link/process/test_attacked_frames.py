"""Tests with altered, repeated and reordered telecommand frames near the limits of the frame counter.

The attacker sends 1,000 frames in portions to a link process whose next counter is near a limit: genuine
frames in another order, repetitions, damaged frames with a wrong or a correct CRC, joined parts of two
frames, and authentic frames whose IV of 96 bits is near a limit. The link must not execute a command twice,
nor a command that the ground did not send. No frame may end the process, and the link must execute the next
genuine command.
"""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.commands import CommandPacker, Ping, unpack
from flight.link.frames import close_frame
from flight.link.security import HIGHEST_COUNTER, WINDOW, Gate, Refusal
from tests.flight.link.process.both_ends import BothEnds
from tests.flight.link.vaults import frame_with

FRAMES, PORTION, GENUINE, LAST = 1000, 50, 30, 9999
EDGES = (0, 2**41, 2**48, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1, 2**64, 2**95, 2**96 - 1)
"""IV values (96 bits) near limits; the lowest 64 bits are the counter."""
STARTS = (0, 2**31 - 5, 2**32 - 5, 2**63 - WINDOW - 1000, 2**63 - 20)
KINDS = ("repeated", "flipped", "flipped, CRC right", "cut", "joined", "edge", "noise")


SEED = 35


@pytest.mark.parametrize("number", range(len(STARTS)))
def test_no_frame_is_obeyed_twice_and_none_ends_the_process(number: int, tmp_path: Path) -> None:
    """Near its highest value, the counter permits few more commands."""
    found = attacked(tmp_path, STARTS[number], (SEED, number))
    assert sum(found["kinds"].values()) == FRAMES
    assert set(found["kinds"]) == {*KINDS, "genuine"}
    assert (found["twice"], found["strange"], found["deaf"], found["ended"]) == (0, 0, False, "")
    assert found["obeyed"] >= (2 if STARTS[number] == max(STARTS) else 10)
    causes = ("CRC", "HEADER", "SPI", "MAC", "REPEATED", "BEYOND")
    assert min(found["refused"][cause] for cause in causes) > 2


def test_a_gate_that_forgets_what_it_accepted_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    admit = Gate._admit

    def forgetful(self: Gate, frame: bytes) -> Any:
        before = dict(self._open)
        admitted = admit(self, frame)
        self._open.update(before)
        return admitted

    monkeypatch.setattr(Gate, "_admit", forgetful)
    assert attacked(tmp_path, STARTS[0], (SEED, 0))["twice"] > 0


def attacked(place: Path, start: int, seed: tuple[int, ...]) -> dict[str, Any]:
    """Attack a link process whose next counter is `start`, and return what it did."""
    with closing(BothEnds(place)) as link:
        return _attack(link, start, seed)


def _attack(link: BothEnds, start: int, seed: tuple[int, ...]) -> dict[str, Any]:
    draw = np.random.default_rng(seed)
    entry = link.sky.read(1)
    assert entry is not None
    link.sky.write(replace(entry, unused=start))
    link.restart()
    packer = CommandPacker()
    genuine = [frame_with(link.ground, start + i, packer.pack(Ping(i), 1)) for i in range(GENUINE)]
    waiting = list(genuine)
    edges = {GENUINE + i: edge for i, edge in enumerate(EDGES)}
    forged = [frame_with(link.ground, edge, packer.pack(Ping(number), 1)) for number, edge in edges.items()]
    kinds: Counter[str] = Counter()
    ended, possible_last = "", False
    try:
        while sum(kinds.values()) < FRAMES:
            for _ in range(PORTION):
                kind = KINDS[draw.integers(len(KINDS))] if draw.random() > 0.04 or not waiting else "genuine"
                kinds[kind] += 1
                if kind == "genuine":  # the next genuine frame is one of the first three that wait
                    link.wire.up.append(waiting.pop(int(draw.integers(min(3, len(waiting))))))
                else:
                    past = genuine[: max(GENUINE - len(waiting), 1)]
                    link.wire.up.append(_frame(kind, past, forged, draw))
            link.turn(0.02)
        entry = link.sky.read(1)
        assert entry is not None
        possible_last = entry.unused < HIGHEST_COUNTER
        last = frame_with(link.ground, entry.unused, packer.pack(Ping(LAST), 1))
        link.wire.up.append(last)
        link.turn(1.1)
    except Exception as error:  # noqa: BLE001 - what ends the process is what is looked for
        ended = repr(error)
    numbers = [command.number for command in map(unpack, link.obeyed) if isinstance(command, Ping)]
    possible = {GENUINE + i for i, edge in enumerate(EDGES) if edge % 2**64 < HIGHEST_COUNTER}
    return {
        "kinds": dict(kinds),
        "ended": ended,
        "obeyed": len(numbers),
        "twice": sum(count - 1 for count in Counter(numbers).values()),
        "strange": sum(number not in possible | {*range(GENUINE), LAST} for number in numbers),
        "deaf": possible_last and LAST not in numbers,
        "refused": {cause.name: link.station._gate.refused[cause] for cause in Refusal},
    }


def _frame(kind: str, past: list[bytes], forged: list[bytes], draw: np.random.Generator) -> bytes:
    """Return a frame of one kind that an attacker sends.

    It is made from recorded frames `past`, authentic frames `forged`, or random bytes.
    """
    known = forged if kind == "edge" else past
    some = known[draw.integers(len(known))]
    match kind:
        case "repeated" | "edge":
            return some
        case "flipped":
            return _flipped(some, draw)
        case "flipped, CRC right":
            return close_frame(_flipped(some[:-2], draw))
        case "cut":
            part = some[: int(draw.integers(len(some)))]
            return close_frame(part) if draw.random() < 0.5 else part
        case "joined":
            at = int(draw.integers(1, len(some)))
            return close_frame((some[:at] + forged[draw.integers(len(forged))][at:])[:-2])
        case _:
            return draw.bytes(int(draw.integers(0, 1100)))


def _flipped(data: bytes, draw: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(draw.integers(1, 4))):
        changed[draw.integers(len(changed))] ^= 1 << int(draw.integers(8))
    return bytes(changed)
