"""Packets with artificial contents for tests."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from flight.link.telemetry.definitions import CYCLE_TIMING, Field, Packet
from flight.link.telemetry.packets import Packer

_BITS = {"u1": 8, "u2": 16, "u4": 32, "u8": 64, "i8": 64}


def timing_packets(count: int, packer: Packer | None = None) -> list[bytes]:
    """Return `count` small numbered packets at intervals of 25 ms."""
    packer = packer or Packer()
    return [
        packer.pack(CYCLE_TIMING, 25_000_000 * i, cycle=i, lateness=1e-5 * i, execution=5e-4)
        for i in range(count)
    ]


def values_of(field: Field) -> st.SearchStrategy[object]:
    """Return a hypothesis strategy for the values of a field."""
    one: st.SearchStrategy[object]
    if field.kind.startswith("S"):
        return st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")).map(
            lambda text: cut(text, int(field.kind[1:]))
        )
    if field.kind.startswith("f"):
        one = st.floats(width=64 if field.kind == "f8" else 32)
    else:
        bits = _BITS[field.kind]
        low = -(2 ** (bits - 1)) if field.kind.startswith("i") else 0
        one = st.integers(low, low + 2**bits - 1)
    return one if field.count == 1 else st.lists(one, min_size=field.count, max_size=field.count)


def cut(text: str, size: int) -> str:
    """Return the longest prefix of `text` that has at most `size` bytes of UTF-8 and contains no NUL."""
    while len(text.encode()) >= size:
        text = text[:-1]
    return text


def contents(packet: Packet) -> st.SearchStrategy[dict[str, object]]:
    """Return a hypothesis strategy for the contents of a packet."""
    return st.fixed_dictionaries({field.name: values_of(field) for field in packet.fields})


def plain_contents(packet: Packet) -> dict[str, object]:
    """Return simple contents that are valid for a packet."""
    plain: dict[str, object] = {}
    for field in packet.fields:
        if field.kind.startswith("S"):
            plain[field.name] = "text"
        else:
            plain[field.name] = 1 if field.count == 1 else np.arange(field.count)
    return plain
