"""Tests with damaged copies of the stored state, and with damaged worker messages of valid checksum."""

from __future__ import annotations

import mmap
import struct
import types
import zlib
from random import Random

import numpy as np
from hypothesis import given

from flight.loop.state import Learned, StoredState, UncleanShutdown, decode, encode
from flight.loop.worker import message_length, pack_values, unpack_values
from knightcube.errors import KnightCubeError
from tests.support.damaged import Files, chances, line_and_crc, offer

STATES = (
    StoredState(),
    StoredState(boot_count=7, operated=1e5, running=True, mode="point", utc="2026-11-24T00:00:00Z"),
    StoredState(
        boot_count=9,
        unclean=(UncleanShutdown(3, 12.5, ""), UncleanShutdown(8, 400.0, "x")),
        learned={"plant": Learned.of(np.array([1.0, 2.0]), np.diag([1e-4, 2e-3]))},
    ),
)
HEAD = struct.Struct("<QQI")
"""Lengths of the two sections of a worker message, and the CRC-32 of the message."""


@given(chances())
def test_a_damaged_state_is_refused_or_can_be_stored_again(chance: Random) -> None:
    examples = [{"a": encode(number + 1, state)} for number, state in enumerate(STATES)]

    def read(files: Files, whole: bool) -> None:
        copy = decode(files["a"])
        assert not whole or copy.state in STATES
        decode(encode(copy.generation, copy.state))

    offer(chance, examples, read, (ValueError,), line_and_crc)


@given(chances())
def test_a_resealed_message_of_a_worker_brings_nothing_to_call(chance: Random) -> None:
    """A damaged worker message with a valid checksum never decodes to a function.

    The decoder must not end the control process.
    """
    slab = mmap.mmap(-1, 1 << 16)
    values: tuple[object, ...] = (
        {"path": np.linspace(0.0, 1.0, 50), "cost": 1.5},
        [(1, "two", None)],
        (np.float64(2.0), np.arange(6, dtype=np.int16).reshape(2, 3), True),
    )

    def read(files: Files, _: bool) -> None:
        length = message_length(files["message"])
        if length is not None and length <= len(files["message"]):
            value = unpack_values(files["message"][:length], slab)
            assert not isinstance(value, types.FunctionType | types.BuiltinFunctionType | types.MethodType)

    def reseal(message: bytes) -> bytes:
        head, body = HEAD.unpack(message[: HEAD.size].ljust(HEAD.size, b"\0"))[0], message[HEAD.size :]
        head = min(head, len(body))
        return HEAD.pack(head, len(body) - head, zlib.crc32(body)) + body

    offer(chance, [{"message": pack_values(one, slab)} for one in values], read, (KnightCubeError,), reseal)
