"""Messages between the control process and its workers: a value, its large arrays in shared memory.

A worker trusts what the control process sends and unpickles it. What comes back is read as `values`: it may
build dataclasses, enumerations and arrays of numbers, and call or import nothing. A worker whose memory is
damaged can send a wrong value, never run code in the control process or end it.
"""

from __future__ import annotations

import mmap
import pickle
import struct
import zlib
from collections.abc import Sequence
from typing import Any

from flight.loop.executive import values
from knightcube.errors import FlightError

SLAB_BYTES = 64 * 1024 * 1024
"""Shared memory for a job's arrays: only address space until used."""
LONGEST_BYTES = 16 * 1024 * 1024
"""A message without its arrays that claims to be longer is damaged."""

_HEADER = struct.Struct("<QQI")
"""Lengths of the arrays' sizes and of the body, and the CRC-32 of both."""


def pack_trusted(value: Any, slab: mmap.mmap) -> bytes:
    """Pickle a value: its large buffers go into the slab, the rest is returned with its length in front.

    Raises FlightError where the slab is too small.
    """
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return _framed(body, [buffer.raw() for buffer in buffers], slab)


def unpack_trusted(message: bytes, slab: mmap.mmap) -> Any:
    """Undo `pack_trusted` of a process that is trusted, copying the buffers out of the slab."""
    body, buffers = _parts(message, slab)
    return pickle.loads(body, buffers=buffers)


def pack_values(value: Any, slab: mmap.mmap) -> bytes:
    """Do as `pack_trusted` for a reader who does not trust. Raises FlightError for what is no plain value."""
    body, arrays = values.encode(value)
    return _framed(body, [array.reshape(-1).view("u1").data for array in arrays], slab)


def unpack_values(message: bytes, slab: mmap.mmap) -> Any:
    """Undo `pack_values` of a worker. Raises FlightError for damage."""
    try:
        return values.decode(*_parts(message, slab))
    except FlightError:
        raise
    except Exception as error:  # a damaged stream fails in any way
        raise FlightError(f"unreadable: {type(error).__name__}: {str(error)!r}") from error


def message_length(data: bytes | bytearray) -> int | None:
    """Return the length of the message that `data` begins with, None before the header is complete.

    Raises FlightError for a length that no message has.
    """
    if len(data) < _HEADER.size:
        return None
    head_length, body_length, _ = _HEADER.unpack_from(data)
    if (length := _HEADER.size + int(head_length) + int(body_length)) > LONGEST_BYTES:
        raise FlightError(f"a message of {length} bytes is damaged")
    return length


def _framed(body: bytes, views: Sequence[memoryview], slab: mmap.mmap) -> bytes:
    if sum(view.nbytes for view in views) > len(slab):
        raise FlightError(f"a job's arrays exceed the {len(slab)} bytes that a worker's memory holds")
    offset = 0
    for view in views:
        slab[offset : offset + view.nbytes] = view
        offset += view.nbytes
    head = struct.pack(f"<{len(views)}Q", *(view.nbytes for view in views))
    return _HEADER.pack(len(head), len(body), zlib.crc32(body, zlib.crc32(head))) + head + body


def _parts(message: bytes, slab: mmap.mmap) -> tuple[bytes, list[bytearray]]:
    head_length, body_length, crc = _HEADER.unpack_from(message)
    head_end = _HEADER.size + head_length
    if zlib.crc32(message[_HEADER.size : head_end + body_length]) != crc:
        raise FlightError("a message with a wrong checksum is damaged")
    buffers = []
    offset = 0
    with memoryview(slab) as view:
        for (size,) in struct.iter_unpack("<Q", message[_HEADER.size : head_end]):
            buffers.append(bytearray(view[offset : offset + size]))
            offset += size
    return message[head_end : head_end + body_length], buffers
