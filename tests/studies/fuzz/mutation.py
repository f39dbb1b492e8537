"""Ways in which bytes and texts go wrong."""

from __future__ import annotations

import numpy as np

Draw = np.random.Generator


def chance(draw: Draw, probability: float) -> bool:
    """Return True with a probability."""
    return bool(draw.random() < probability)


def integer(draw: Draw, low: int, high: int) -> int:
    """Return a whole number from `low` to `high`, both possible."""
    return int(draw.integers(low, high + 1))


def damage(draw: Draw, data: bytes) -> bytes:
    """Return bytes with one thing wrong: flipped, overwritten, lost, doubled, inserted, cut, zeroed."""
    if not data:
        return draw.bytes(integer(draw, 1, 8))
    size = len(data)
    start = integer(draw, 0, size - 1)
    stop = min(size, start + integer(draw, 1, 1 + size // 4))
    kind = integer(draw, 0, 7)
    if kind == 0:
        flipped = bytearray(data)
        for bit in draw.integers(0, 8 * size, integer(draw, 1, 4)).tolist():
            flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped)
    if kind == 7:
        return data[:start]
    middle = (
        data[start:stop],
        draw.bytes(stop - start),
        b"",
        data[start:stop] * 2,
        draw.bytes(integer(draw, 1, 40)) + data[start:stop],
        bytes(stop - start),
        b"\xff" * (stop - start),
    )
    return data[:start] + middle[kind] + data[stop:]
