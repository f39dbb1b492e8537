"""Tests that worker messages preserve every permitted value, and never create other types from bytes."""

from __future__ import annotations

import os
import struct
import subprocess
import zlib
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.loop.worker import (
    decode_values,
    encode_values,
    message_length,
    pack_values,
    unpack_values,
)
from knightcube.errors import KnightCubeError
from knightcube.vision.camera.lens import Lens
from knightcube.vision.startracker.detect import Quality
from knightcube.vision.streaks.streak_result import StreakStatus
from tests.flight.loop.passing import passed, slab

LENS = Lens(1024, 768, 500.0, (511.5, 383.5))


class Pair(NamedTuple):
    """A pair of numbers, one of the types that a worker message may contain."""

    first: int
    second: float


VALUES: tuple[Any, ...] = (
    None, True, -(2**63), 2**64 - 1, 0.1, float("inf"), "é\n", b"\0\xff", 1 + 2j, [], (), {}, set(),
    [(1, [2.5])], {"a": {1: None}, (1, 2): "b"},
    frozenset({1, 2}), StreakStatus.BLACK, Quality(5), LENS, Pair(1, 2.0),
)  # fmt: skip


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_arrives_as_it_was_of_its_own_type(value: Any) -> None:
    assert passed(value) == value
    assert type(passed(value)) is type(value)


@pytest.mark.parametrize("dtype", ["?", "i1", "u2", "i4", "u8", "f4", "f8", "c16"])
@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 0), (2, 3, 4)])
def test_arrays_and_their_scalars_arrive_to_the_bit_and_may_be_written(
    dtype: str, shape: tuple[int, ...]
) -> None:
    array = np.asarray(np.random.default_rng(1).integers(0, 2, shape) * 1.1).astype(dtype)
    twice, fortran, scalar = passed((array, array.copy(order="F"), np.ones(1, dtype)[0]))
    for found in (twice, fortran):
        assert (found.dtype, found.shape) == (array.dtype, shape)
        np.testing.assert_array_equal(found, array)
        assert found.flags.writeable
    assert type(scalar) is np.dtype(dtype).type
    assert scalar == 1


def test_a_value_that_is_not_a_number_arrives() -> None:
    assert np.isnan(passed(float("nan")))
    assert np.isnan(passed(np.array([np.nan]))[0])


@pytest.mark.parametrize(
    "value",
    [
        os.getpid,
        subprocess.Popen,
        object(),
        {"deep": [np.fromfile]},
        np.array([os.getpid]),
        np.array(["a"]),
    ],
    ids=["function", "class", "object", "deep", "objects", "texts"],
)
def test_values_of_other_classes_are_not_sent(value: Any) -> None:
    with pytest.raises(KnightCubeError, match="a worker cannot send"):
        pack_values(value, slab())


HARMFUL: tuple[Any, ...] = (
    ["fields", "subprocess:Popen", ["true"]],
    ["fields", "builtins:eval", ["1"]],
    ["fields", "os:system", ["true"]],
    ["fields", "knightcube.vision.camera.lens:Lens", [1]],
    ["fields", "no.such.module:Thing", []],
    ["enum", "knightcube.vision.camera.lens:Lens", "x"],
    ["enum", "knightcube.vision.streaks.streak_result:StreakStatus", "NONE_OF_THEM"],
    ["enum", "knightcube.vision.startracker.detect:Quality", 1],
    ["flag", "knightcube.vision.streaks.streak_result:StreakStatus", 1],
    ["array", "|O", [1]], ["array", "<f8", [1 << 62, 1 << 62]], ["array", "<f8", [-1]], ["array", "<f8", [2]],
    ["array", "<f8", [1] * 33], ["array", "<f8", [1.0]], ["array", "|b1", [8]], ["scalar", "<f8", [1]],
    ["array", "<M8[ns]", [1]], ["list", 1], ["dict", [[1]]], ["set", [["list", []]]], ["what"], [], {"a": 1},
)  # fmt: skip


@pytest.mark.parametrize("tree", HARMFUL, ids=repr)
def test_bytes_that_do_not_encode_a_permitted_value_are_refused(tree: Any) -> None:
    body = msgspec.msgpack.encode(tree)
    head = (8).to_bytes(8, "little")
    slab()[:8] = b"\xff" * 8
    message = struct.pack("<QQI", 8, len(body), zlib.crc32(head + body)) + head + body
    with pytest.raises(KnightCubeError) as refusal:
        unpack_values(message, slab())
    assert "\n" not in str(refusal.value)


def test_a_class_is_built_without_a_call_of_its_own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    data, _ = encode_values(LENS)

    def never(*_: object) -> None:
        raise AssertionError("it was called")

    for name in ("__init__", "__post_init__", "__setattr__"):
        monkeypatch.setattr(Lens, name, never, raising=False)
    assert decode_values(data, []) == LENS


@given(st.binary(max_size=200), st.integers(0, 400))
def test_a_damaged_message_is_refused_or_read_and_nothing_else(noise: bytes, place: int) -> None:
    message = bytearray(pack_values(("done", LENS, np.arange(9.0), 7), slab()))
    message[place : place + len(noise)] = noise
    with suppress(KnightCubeError):
        length = message_length(message)
        if length is not None:
            unpack_values(bytes(message[:length]), slab())
